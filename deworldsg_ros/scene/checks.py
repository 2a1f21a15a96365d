"""Checks of arrays: those of a frame, and those of a file.

Each raises ValueError with the name, the value and what was expected. They run once, where data
comes in. Kernels get only arrays that have passed them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from deworldsg_ros.scene import limits
from deworldsg_ros.scene.arrays import Float32, Float64, Int64

# --- What the graphs of a frame must fulfil before a stage works with them, checked once.
#
# Each check is one pass of numpy over all objects, because a frame is checked in every node. An
# array passes if its largest absolute value is below a limit; NaN and infinity do not.

# Distributions of messages may be written with six decimals. Maps keep them as they came.
SUM_TOLERANCE = 1.1e-5


def check_shape(name: str, array: NDArray[Any], shape: tuple[int, ...]) -> None:
    """Check the shape of an array."""
    if array.shape != shape:
        raise ValueError(f"{name} have shape {array.shape}: expected {shape}")


def check_array(name: str, array: NDArray[Any], shape: tuple[int, ...], limit: float) -> None:
    """Check the shape of an array, and that no value exceeds a limit."""
    check_shape(name, array, shape)
    if array.size and not np.abs(array).max() <= limit:
        worst = np.nanargmax(np.where(np.isfinite(array), np.abs(array), np.inf))
        raise ValueError(
            f"{name} contain {array.flat[worst]:.6g}: expected finite values up to {limit:g}"
        )


def check_probabilities(name: str, array: Float64, shape: tuple[int, ...]) -> None:
    """Check that all values are from 0 to 1."""
    check_array(name, array, shape, 1.0 + 1e-9)
    if array.size and array.min() < 0.0:
        raise ValueError(f"{name} contain {array.min():.6g}: expected 0 to 1")


def check_distributions(name: str, array: Float64, shape: tuple[int, ...]) -> None:
    """Check that all rows are probabilities that sum to one."""
    check_probabilities(name, array, shape)
    if not len(array):
        return
    sums = array.sum(axis=1)
    errors = np.abs(sums - 1.0)
    if errors.max() > SUM_TOLERANCE:
        raise ValueError(f"{name} sum to {sums[errors.argmax()]:.6f}: expected 1")


def check_boxes(boxes_xyxy: Float64, count: int) -> None:
    """Check boxes (n, 4): x1 <= x2 and y1 <= y2."""
    check_array("boxes", boxes_xyxy, (count, 4), limits.MAX_SIDE_PX)
    if count and (boxes_xyxy[:, :2] > boxes_xyxy[:, 2:]).any():
        row = int((boxes_xyxy[:, :2] > boxes_xyxy[:, 2:]).any(axis=1).argmax())
        raise ValueError(
            f"box {boxes_xyxy[row].tolist()} of row {row} is inverted: expected x1 <= x2, y1 <= y2"
        )


def check_covariances(covariances: Float64, count: int) -> None:
    """Check covariances (n, 3, 3): symmetric, positive definite, and not nearly singular."""
    check_array("covariances", covariances, (count, 3, 3), limits.MAX_VARIANCE_M2)
    if not count:
        return
    apart = np.abs(covariances - covariances.swapaxes(1, 2))
    if apart.any() and (apart > 1e-9 * np.abs(covariances)).any():
        row = int((apart > 1e-9 * np.abs(covariances)).any(axis=(1, 2)).argmax())
        raise ValueError(f"covariance {covariances[row].tolist()} of row {row} is not symmetric")
    variances = np.linalg.eigvalsh(covariances)
    least = np.maximum(limits.MIN_VARIANCE_RATIO * variances[:, 2], limits.MIN_VARIANCE_M2)
    if not (variances[:, 0] >= least).all():
        row = int((variances[:, 0] < least).argmax())
        raise ValueError(
            f"covariance {covariances[row].tolist()} of row {row} is not positive definite: its "
            f"smallest variance is {variances[row, 0]:.3g}, expected at least {least[row]:.3g}"
        )


def check_instance_ids(instance_ids: Int64, count: int) -> None:
    """Check ids (n,): each from 1 on, and only once."""
    check_array("instance ids", instance_ids, (count,), limits.MAX_INSTANCE)
    if count and instance_ids.min() < 1:
        raise ValueError(f"an instance id is {instance_ids.min()}: expected >= 1")
    if len(set(instance_ids.tolist())) < count:
        raise ValueError(f"instance ids {instance_ids.tolist()} contain an id twice")


def check_counts(name: str, counts: Int64, count: int) -> None:
    """Check numbers (n,): 1 or more."""
    check_array(name, counts, (count,), limits.MAX_SIDE_PX**2)
    if count and counts.min() < 1:
        raise ValueError(f"{name} contain {counts.min()}: expected >= 1")


def check_colours(colours_lab: Float32 | None, count: int) -> None:
    """Check CIELAB colours (n, 3), if there are any: inside the range, or a row of NaN."""
    if colours_lab is None:
        return
    check_shape("colours", colours_lab, (count, 3))
    known = colours_lab[~np.isnan(colours_lab).all(axis=1)]
    check_array("colours", known, known.shape, limits.MAX_LAB)
    if known.size and known[:, 0].min() < 0.0:
        raise ValueError(f"a colour has the lightness {known[:, 0].min():.6g}: expected >= 0")


def check_depths(depths_m: Float64, count: int) -> None:
    """Check depths (n,): in front of the camera."""
    check_array("depths", depths_m, (count,), limits.MAX_COORDINATE_M)
    if count and depths_m.min() < 0.0:
        raise ValueError(f"a depth is {depths_m.min():.6g} m: expected >= 0")


def check_surfaces(surfaces: Sequence[Float32], count: int) -> None:
    """Check sets of surface points, (k, 3) each."""
    if len(surfaces) != count:
        raise ValueError(f"{len(surfaces)} point sets for {count} objects")
    for row, points in enumerate(surfaces):
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(
                f"surface points of object {row} have shape {points.shape}: expected (k, 3)"
            )
    if count:
        points = np.concatenate(surfaces)
        check_array("surface points", points, points.shape, limits.MAX_COORDINATE_M)


def check_pairs(name: str, pairs: Int64, count: int, rows: int) -> None:
    """Check pairs (m, 2) of different rows, from 0 to `rows` - 1."""
    check_array(name, pairs, (count, 2), limits.MAX_INT)
    if not count:
        return
    if pairs.min() < 0 or pairs.max() >= rows:
        raise ValueError(
            f"{name} name objects {pairs.min()} to {pairs.max()}: expected 0 to {rows - 1}"
        )
    if (pairs[:, 0] == pairs[:, 1]).any():
        raise ValueError(f"{name}: an object cannot be paired with itself")


# --- Checks of saved arrays: each raises ValueError with the name, the value and what was
# expected.
#
# They run once, where a file is read. Kernels get only arrays that have passed them.

# Means and products of the distributions of frames have their errors, and those of rounding.
MAX_SUM_ERROR = 1.01 * SUM_TOLERANCE


def checked(
    arrays: Mapping[str, NDArray[Any]], name: str, dtype: DTypeLike, *shape: int | None
) -> NDArray[Any]:
    """The array of a name, C-contiguous; ValueError unless it has this dtype and shape.

    Args:
        arrays: by name.
        name: of the array.
        dtype: expected.
        shape: expected; None = any length.
    """
    if name not in arrays:
        raise ValueError(f"there is no '{name}' in it")
    array = arrays[name]
    fits = array.ndim == len(shape) and all(
        side is None or side == found for side, found in zip(shape, array.shape)
    )
    if array.dtype != np.dtype(dtype) or not fits:
        expected = ", ".join("n" if side is None else str(side) for side in shape)
        raise ValueError(
            f"{name} is {array.dtype} of shape {array.shape}: expected {np.dtype(dtype)} of shape "
            f"({expected})"
        )
    return np.ascontiguousarray(array)


def within(name: str, values: NDArray[Any], low: float, high: float) -> None:
    """ValueError unless all values are finite numbers from low to high."""
    # The negated comparisons also catch NaN, which is the minimum of an array that has one.
    if values.size and not low <= values.min() <= values.max() <= high:
        wrong = ~((values >= low) & (values <= high))
        refuse(name, values[wrong][0], f"{low:g} to {high:g}")


def holds(name: str, condition: bool | np.bool_, expected: str) -> None:
    """ValueError with the name and the expectation if a condition does not hold."""
    if not condition:
        raise ValueError(f"{name}: expected {expected}")


def refuse(name: str, seen: Any, expected: str) -> None:
    """Raise ValueError with the value seen and the value expected."""
    raise ValueError(f"{name} contains {seen}: expected {expected}")


def distinct(name: str, rows: NDArray[Any]) -> None:
    """ValueError if two rows, (n,) or (n, k), are equal."""
    columns = np.atleast_2d(rows.T)
    # `np.unique` of rows compares them as bytes, which takes ten times as long.
    ordered = columns[:, np.lexsort(columns)]
    if (ordered[:, 1:] == ordered[:, :-1]).all(axis=0).any():
        raise ValueError(f"{name} contains a value twice: expected each once")


def distributions(name: str, rows: NDArray[Any]) -> None:
    """ValueError unless each row has numbers from 0 to 1 that sum to one, as those of frames."""
    within(name, rows, 0.0, 1.0 + MAX_SUM_ERROR)
    sums = rows.sum(axis=1)
    if rows.size and np.abs(sums - 1.0).max() > MAX_SUM_ERROR:
        refuse(name, f"a row with the sum {sums[np.abs(sums - 1.0).argmax()]:g}", "1")


def lengths(name: str, counts: Int64, total: int) -> None:
    """ValueError unless the lengths are not negative and sum to the number of rows they divide."""
    within(name, counts, 0, total)  # first: the sum of int64 could overflow
    if len(counts) and sum(counts.tolist()) != total or not len(counts) and total:
        refuse(name, f"lengths with the sum {sum(counts.tolist())}", str(total))


def contained(name: str, ids: Int64, known: Int64) -> None:
    """ValueError unless each id is one of the known ones."""
    missing = ~np.isin(ids, known)
    if missing.any():
        refuse(name, f"the id {ids[missing].flat[0]}", "the id of a node")


def acyclic(name: str, links: Int64) -> None:
    """ValueError if following the links (n, 2) from an id to another one ever returns to an id.

    The first column is distinct. A path of n links has at most n steps, and each round doubles
    the number of steps that are followed: log2(n) rounds end all paths, or there is a circle.
    """
    order = np.argsort(links[:, 0])
    sources, targets = links[order, 0], links[order, 1]
    # Row of the next link of a path; -1 = its end.
    at = np.searchsorted(sources, targets)
    at = np.where((at < len(sources)) & (np.append(sources, -1)[at] == targets), at, -1)
    for _ in range(len(links).bit_length() + 1):
        at = np.where(at >= 0, at[at], -1)
    if (at >= 0).any():
        refuse(name, f"the id {sources[at >= 0][0]}, which succeeds itself", "no circle")

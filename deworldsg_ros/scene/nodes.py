"""The nodes of the global graph as parallel, contiguous arrays.

Row r of every array belongs to the node `ids[r]`. Rows are compact: when a node goes, the last
row takes its place, so rows move and ids do not. The public arrays are views of the live rows;
they are replaced when a node is added or removed, so do not keep them across such a change.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.kernels import kernel
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64, UInt64
from deworldsg_ros.scene.gaussian import eigenvalue_bound, log_determinant
from deworldsg_ros.scene.surface import add_points

_FIRST_CAPACITY = 64


class NodeTable:
    """n nodes with distributions over C classes.

    Attributes:
        ids: (n,) int64, stable, from 1.
        means: (n, 3) float64, metres, world frame.
        covariances: (n, 3, 3) float64, square metres, positive definite.
        class_probabilities: (n, C) float64, rows sum to one.
        weights: (n,) float64, the w of Eq. 7: number of observations, or a rule's own weight.
        observations: (n,) int64, frames in which it was observed; class distributions average
            with these.
        confirmed: (n,) bool, whether the node is sure to be an object; others are tentative.
        log_determinants: (n,) float64, of the covariances.
        eigenvalue_bounds: (n,) float64, no smaller than the covariance's largest eigenvalue.
        first_seen_ns, last_seen_ns: (n,) int64.
        revisions: (n,) int64, graph revision at which the node last changed.
        surface_hashes: (n, K) uint64, and
        surface_points_world: (n, K, 3) float32, metres: a sample of each node's surface points, of
        surface_counts: (n,) int64 points; see `surface`.
    """

    ids: Int64
    means: Float64
    covariances: Float64
    class_probabilities: Float64
    weights: Float64
    observations: Int64
    confirmed: Bool
    log_determinants: Float64
    eigenvalue_bounds: Float64
    first_seen_ns: Int64
    last_seen_ns: Int64
    revisions: Int64
    surface_hashes: UInt64
    surface_points_world: Float32
    surface_counts: Int64

    def __init__(self, class_count: int, surface_point_capacity: int = 0) -> None:
        self._rows: dict[int, int] = {}
        capacity = _FIRST_CAPACITY
        self._storage: dict[str, NDArray[Any]] = {
            "ids": np.zeros(capacity, np.int64),
            "means": np.zeros((capacity, 3)),
            "covariances": np.zeros((capacity, 3, 3)),
            "class_probabilities": np.zeros((capacity, class_count)),
            "weights": np.zeros(capacity),
            "observations": np.zeros(capacity, np.int64),
            "confirmed": np.zeros(capacity, np.bool_),
            "log_determinants": np.zeros(capacity),
            "eigenvalue_bounds": np.zeros(capacity),
            "first_seen_ns": np.zeros(capacity, np.int64),
            "last_seen_ns": np.zeros(capacity, np.int64),
            "revisions": np.zeros(capacity, np.int64),
            "surface_hashes": np.zeros((capacity, surface_point_capacity), np.uint64),
            "surface_points_world": np.zeros((capacity, surface_point_capacity, 3), np.float32),
            "surface_counts": np.zeros(capacity, np.int64),
        }
        self._show(0)

    def __len__(self) -> int:
        return len(self._rows)

    def __contains__(self, node_id: object) -> bool:
        return node_id in self._rows

    def row(self, node_id: int) -> int:
        """Present row of a live node; KeyError where it is not in the graph."""
        try:
            return self._rows[node_id]
        except KeyError:
            raise KeyError(f"node {node_id} is not in the graph") from None

    def append(self, node_id: int) -> int:
        """Add an empty row for a new node and return it; `put` fills it."""
        row = len(self._rows)
        if row == len(self._storage["ids"]):
            for name, column in self._storage.items():
                self._storage[name] = np.concatenate((column, np.zeros_like(column)))
        self._rows[node_id] = row
        self._show(row + 1)
        self.ids[row] = node_id
        self.surface_counts[row] = 0
        return row

    def put(
        self,
        row: int,
        mean_world: Float64,
        covariance_world: Float64,
        class_probabilities: Float64,
        weight: float,
        observations: int,
    ) -> None:
        """Replace a row's Gaussian, classes and counts, and what is cached of its covariance.

        Raises:
            ValueError: where the covariance is not positive definite.
        """
        self.log_determinants[row] = log_determinant(covariance_world)
        self.eigenvalue_bounds[row] = eigenvalue_bound(covariance_world)
        self.means[row] = mean_world
        self.covariances[row] = covariance_world
        self.class_probabilities[row] = class_probabilities
        self.weights[row] = weight
        self.observations[row] = observations

    def fuse(
        self,
        rows: list[int],
        means_world: Float64,
        covariances_world: Float64,
        class_probabilities: Float64,
        weights: Float64,
        observations: Int64,
    ) -> None:
        """Fuse a Gaussian, classes and counts into each of n different rows (Eq. 7).

        Raises:
            ValueError: where a covariance is not positive definite; rows before it were fused.
        """
        refused = _fuse(
            np.array(rows, np.int64),
            self.means,
            self.covariances,
            self.class_probabilities,
            self.weights,
            self.observations,
            self.log_determinants,
            self.eigenvalue_bounds,
            means_world,
            covariances_world,
            class_probabilities,
            weights,
            observations,
        )
        if refused >= 0:
            raise ValueError(
                f"covariance {covariances_world[refused].tolist()}, fused into node "
                f"{self.ids[rows[refused]]}, gives one that is not positive definite"
            )

    def surface(self, row: int) -> Float32:
        """The surface points (k, 3) of a row, metres; a view."""
        return self.surface_points_world[row, : self.surface_counts[row]]

    def set_surface(self, row: int, points_world: Float32) -> None:
        """Replace the surface points of a row by a sample of these (k, 3)."""
        self.surface_counts[row] = 0
        self.add_surfaces([row], [points_world])

    def add_surfaces(self, rows: list[int], point_sets: Sequence[Float32]) -> None:
        """Take surface points (k, 3) into the sample of each of n different rows."""
        add_points(
            self.surface_hashes,
            self.surface_points_world,
            self.surface_counts,
            rows,
            point_sets,
        )

    def remove(self, node_id: int) -> None:
        """Remove a node; the last row takes its place."""
        row, last = self.row(node_id), len(self._rows) - 1
        moved = int(self.ids[last])
        for column in self._storage.values():
            column[row] = column[last]
        self._rows[moved] = row
        del self._rows[node_id]
        self._show(last)

    def _show(self, count: int) -> None:
        for name, column in self._storage.items():
            setattr(self, name, column[:count])


@kernel
def _fuse(
    rows: Int64,
    means: Float64,
    covariances: Float64,
    classes: Float64,
    weights: Float64,
    observations: Int64,
    log_determinants: Float64,
    eigenvalue_bounds: Float64,
    new_means: Float64,
    new_covariances: Float64,
    new_classes: Float64,
    new_weights: Float64,
    new_observations: Int64,
) -> int:
    """`scene.gaussian.fuse` with what is cached of the result; place that was refused, -1 = none.

    The operations are those of `fuse`, `log_determinant` and `eigenvalue_bound`, one by one.
    """
    c = np.empty((3, 3))
    for index in range(len(rows)):
        row = rows[index]
        known, weight = weights[row], new_weights[index]
        total = known + weight
        cross = known * weight / (total * total)
        squares = 0.0
        for i in range(3):
            for j in range(3):
                apart = (means[row, i] - new_means[index, i]) * (
                    means[row, j] - new_means[index, j]
                )
                mixed = known * covariances[row, i, j] + weight * new_covariances[index, i, j]
                c[i, j] = mixed / total + cross * apart
                squares += c[i, j] * c[i, j]
        pivot_1 = c[1, 1] - c[1, 0] / c[0, 0] * c[1, 0]
        rest = c[2, 1] - c[2, 0] / c[0, 0] * c[1, 0]
        pivot_2 = c[2, 2] - c[2, 0] / c[0, 0] * c[2, 0] - rest / pivot_1 * rest
        if not (c[0, 0] > 0.0 and pivot_1 > 0.0 and pivot_2 > 0.0):
            return index
        log_determinants[row] = math.log(c[0, 0] * pivot_1 * pivot_2)
        eigenvalue_bounds[row] = math.sqrt(squares)
        seen, seen_now = observations[row], new_observations[index]
        for i in range(3):
            means[row, i] = (known * means[row, i] + weight * new_means[index, i]) / total
            for j in range(3):
                covariances[row, i, j] = c[i, j]
        for label in range(classes.shape[1]):
            classes[row, label] = (
                seen * classes[row, label] + seen_now * new_classes[index, label]
            ) / (seen + seen_now)
        weights[row] = total
        observations[row] = seen + seen_now
    return -1

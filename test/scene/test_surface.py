"""The bounded sample of surface points."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from support.merging import seeds

from deworldsg_ros.scene.surface import _hash, add_points, drop_points


class Samples:
    """Some samples of surface points, as a table of nodes keeps them."""

    def __init__(self, count: int, capacity: int) -> None:
        self.points_world = np.zeros((count, capacity, 3), np.float32)
        self.keyframes = np.zeros((count, capacity), np.uint16)
        self.counts = np.zeros(count, np.int64)

    def add(self, rows: list[int], point_sets: list[np.ndarray]) -> None:
        keyframes = np.concatenate([keyframes_of(points) for points in point_sets])
        add_points(*self.arrays(), np.array(rows, np.int64), point_sets, keyframes)

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.points_world, self.keyframes, self.counts

    def of(self, row: int) -> tuple[list[int], list[list[float]]]:
        points = self.points(row)
        # A point keeps its keyframe beside it, wherever it goes.
        known = self.keyframes[row, : self.counts[row]]
        np.testing.assert_array_equal(known, keyframes_of(points))
        return [int(_hash(bits)) for bits in points.view(np.uint32)], points.tolist()

    def points(self, row: int) -> np.ndarray:
        return self.points_world[row, : self.counts[row]]


def keyframes_of(points: np.ndarray) -> np.ndarray:
    """A number (k,) that each point (k, 3) determines."""
    return np.abs(points @ [1e3, 1e2, 1e1]).astype(np.uint16)


def sample_of(points: np.ndarray, capacity: int) -> Samples:
    samples = Samples(1, capacity)
    samples.add([0], [points.astype(np.float32)])
    return samples


@given(seeds, st.integers(0, 20), st.integers(0, 60))
def test_it_is_bounded_and_depends_on_the_set_alone(seed: int, capacity: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    # A coarse grid: many points come more than once.
    points = rng.integers(0, 3, (count, 3)).astype(np.float32) / 7
    hashes, kept = sample_of(points, capacity).of(0)
    assert len(hashes) == min(capacity, len(np.unique(points, axis=0)))
    assert (np.diff(np.array(hashes, object)) > 0).all()
    # In any order, in parts, several samples at a time, and by way of merged parts.
    first, second, third = np.split(
        points[rng.permutation(count)], np.sort(rng.integers(0, count + 1, 2))
    )
    parts = Samples(4, capacity)
    parts.add([2, 0], [third, first])
    parts.add([0, 1], [second, second])
    parts.add([0], [third])
    parts.add([3, 1], [parts.points(2), parts.points(2)])
    parts.add([3], [parts.points(1)])
    parts.add([3], [first])
    parts.add([0], [parts.points(0)])
    assert parts.of(0) == parts.of(3) == (hashes, kept)


def test_the_draw_is_uniform_over_the_surface() -> None:
    grid = np.stack(np.meshgrid(np.arange(100), np.arange(100), [0]), -1).reshape(-1, 3)
    kept = sample_of(grid * 0.01, 1000).points(0)
    quarters = np.histogram2d(kept[:, 0], kept[:, 1], bins=2)[0]
    assert (np.abs(quarters - 250) < 60).all()


def test_dropped_points_leave_a_sample_that_goes_on() -> None:
    points = np.random.default_rng(0).normal(size=(60, 3)).astype(np.float32)
    samples = Samples(2, 40)
    samples.add([0, 1], [points, points])
    whole = samples.of(0)
    dropped = np.zeros((2, 40), bool)
    dropped[0, ::3] = True
    kept = samples.points(0)[~dropped[0]]
    drop_points(*samples.arrays(), np.arange(2), dropped)
    np.testing.assert_array_equal(samples.points(0), kept)
    assert samples.of(1) == whole
    # The same points give the same sample again.
    samples.add([0], [points])
    assert samples.of(0) == whole
    # But never as a whole.
    for count, left in ((len(whole[0]), len(whole[0])), (len(whole[0]) - 1, 1)):
        drop_points(*samples.arrays(), np.array([1]), np.arange(40)[None] < count)
        assert len(samples.points(1)) == left

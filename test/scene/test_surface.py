"""The bounded sample of surface points."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from support.merging import seeds

from deworldsg_ros.scene.surface import _hash, add_flat, add_points, drop_points, greatest_hashes


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


def test_moved_points_are_not_pushed_out_by_the_next_ones() -> None:
    rng = np.random.default_rng(1)
    # 20 views of a whole surface; then it moves, and 2 views show its right half.
    views = rng.random((20, 100, 3)).astype(np.float32)
    later = (rng.random((200, 3)) * [0.5, 1, 1] + [5.5, 0, 0]).astype(np.float32)
    left = {}
    for keeps in (True, False):
        samples = Samples(1, 100)
        for view in views:
            samples.add([0], [view])
        row, old = np.zeros(1, np.int64), samples.points(0).copy()
        greatest = greatest_hashes(samples.points_world, samples.counts, row)
        new = old + np.float32([5, 0, 0])
        samples.counts[0] = 0
        starts, keyframes = np.array([0, len(new)]), np.zeros(len(new), np.uint16)
        add_flat(samples.arrays(), row, new.copy(), keyframes, starts, greatest if keeps else None)
        moved = samples.points(0)
        order = [np.lexsort(np.round(points, 4).T) for points in (new, moved)]
        np.testing.assert_allclose(moved[order[1]], new[order[0]], atol=1e-4)
        add_points(*samples.arrays(), row, [later], np.zeros(len(later), np.uint16))
        left[keeps] = np.count_nonzero(samples.points(0)[:, 0] < 5.5)
    # As if it had been there always: about 2000 / 2200 of the sample are of the old views.
    assert left[True] > 35 and left[False] < 25


def test_the_hashes_of_moved_points_are_as_small_as_they_were() -> None:
    points = np.random.default_rng(2).random((800, 3))
    samples = sample_of(points, 100)
    row = np.zeros(1, np.int64)
    greatest = greatest_hashes(samples.points_world, samples.counts, row)
    assert greatest[0] == max(samples.of(0)[0])
    new, starts = samples.points(0) * np.float32(-2.0), np.array([0, 100])
    samples.counts[0] = 0
    add_flat(samples.arrays(), row, new, np.zeros(100, np.uint16), starts, greatest)
    hashes = [int(_hash(bits)) for bits in samples.points(0).view(np.uint32)]
    # One in eight is so small: 64 tries find such a one, nearly always.
    assert sum(one <= greatest[0] for one in hashes) >= 97
    # Uniform below it, so that the next points find their places among them.
    assert abs(np.median(np.array(hashes, float)) / float(greatest[0]) - 0.5) < 0.15

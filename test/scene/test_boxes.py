"""Areas and overlaps of boxes, against a raster."""

from __future__ import annotations

import numpy as np
import pytest

from deworldsg_ros.scene.arrays import areas, pairwise_iou, shared_areas


def raster(box: np.ndarray) -> np.ndarray:
    x1, y1, x2, y2 = box.astype(int)
    cells = np.zeros((12, 12), bool)
    cells[y1:y2, x1:x2] = True
    return cells


@pytest.mark.parametrize("count", [0, 1, 7])
def test_overlaps_equal_those_of_a_raster(count):
    rng = np.random.default_rng(count)
    a, b = (np.sort(rng.integers(0, 12, (n, 2, 2)), axis=1).reshape(n, 4) for n in (count, 5))
    a, b = a.astype(float), b.astype(float)
    shared = [[(raster(one) & raster(other)).sum() for other in b] for one in a]
    union = [[(raster(one) | raster(other)).sum() for other in b] for one in a]
    assert areas(a).tolist() == [raster(one).sum() for one in a]
    assert shared_areas(a, b).tolist() == shared and shared_areas(a, b).shape == (count, 5)
    expected = np.array(shared).reshape(count, 5) / np.maximum(np.reshape(union, (count, 5)), 1)
    np.testing.assert_allclose(pairwise_iou(a, b), expected, rtol=1e-14)


def test_an_inverted_box_is_empty():
    inverted, whole = np.array([[5.0, 5, 1, 1]]), np.array([[0.0, 0, 9, 9]])
    assert areas(inverted) == 0 and shared_areas(inverted, whole) == 0
    assert pairwise_iou(inverted, inverted) == 0

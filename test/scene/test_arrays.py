"""Areas and overlaps of boxes, against a raster; and a softmax with the bits of scipy's."""

import numpy as np
import pytest
from scipy import special

from deworldsg_ros.scene.arrays import areas, pairwise_iou, shared_areas, softmax


def raster(box: np.ndarray) -> np.ndarray:
    x1, y1, x2, y2 = box.astype(int)
    cells = np.zeros((12, 12), bool)
    cells[y1:y2, x1:x2] = True
    return cells


@pytest.mark.parametrize("count", [0, 1, 7])
def test_overlaps_equal_those_of_a_raster(count: int) -> None:
    rng = np.random.default_rng(count)
    a, b = (np.sort(rng.integers(0, 12, (n, 2, 2)), axis=1).reshape(n, 4) for n in (count, 5))
    a, b = a.astype(float), b.astype(float)
    shared = [[(raster(one) & raster(other)).sum() for other in b] for one in a]
    union = [[(raster(one) | raster(other)).sum() for other in b] for one in a]
    assert areas(a).tolist() == [raster(one).sum() for one in a]
    assert shared_areas(a, b).tolist() == shared and shared_areas(a, b).shape == (count, 5)
    expected = np.array(shared).reshape(count, 5) / np.maximum(np.reshape(union, (count, 5)), 1)
    np.testing.assert_allclose(pairwise_iou(a, b), expected, rtol=1e-14)
    inverted = np.array([[5.0, 5, 1, 1]])
    assert areas(inverted) == 0 and not shared_areas(inverted, b).any()


@pytest.mark.parametrize("shape", [(0, 4), (1,), (50,), (7, 1), (300, 80), (2, 3, 5)])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 800.0])
def test_the_softmax_is_that_of_scipy(shape: tuple[int, ...], scale: float) -> None:
    logits = np.random.default_rng(0).normal(0, scale, shape)
    np.testing.assert_array_equal(softmax(logits), special.softmax(logits, axis=-1))
    assert softmax(np.array([0.0, -np.inf, -1e4])).tolist() == [1.0, 0.0, 0.0]

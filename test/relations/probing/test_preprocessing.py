"""Stretching and normalising against a plain reference."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("transformers")
pytestmark = pytest.mark.models

from deworldsg_ros.checkpoints.cards import IMAGENET_MEAN, IMAGENET_STD  # noqa: E402
from deworldsg_ros.relations import clip_models  # noqa: E402
from deworldsg_ros.relations.clip_models import ClipGeometry, normalise, stretch  # noqa: E402


def triangle(x):
    return np.maximum(0, 1 - np.abs(x))


def keys_cubic(x, a=-0.5):
    x = np.abs(x)
    near = (a + 2) * x**3 - (a + 3) * x**2 + 1
    far = a * (x**3 - 5 * x**2 + 8 * x - 4)
    return np.where(x < 1, near, np.where(x < 2, far, 0))


def resize_matrix(before, after, kernel):
    """Weights (after, before): the kernel, as wide as a new pixel where that is wider."""
    scale = before / after
    centres = (np.arange(after)[:, None] + 0.5) * scale - 0.5
    weights = kernel((np.arange(before)[None] - centres) / max(scale, 1))
    return weights / weights.sum(axis=1, keepdims=True)


def reference(clip, geometry):
    kernel = triangle if geometry.interpolation == "bilinear" else keys_cubic
    rows = resize_matrix(clip.shape[1], geometry.edge, kernel)
    columns = resize_matrix(clip.shape[2], geometry.edge, kernel)
    return np.clip(np.einsum("yh,thwc,xw->tcyx", rows, clip.astype(np.float64), columns), 0, 255)


@pytest.mark.parametrize("interpolation", ["bilinear", "bicubic"])
@pytest.mark.parametrize("size", [(60, 80), (80, 60), (7, 25), (32, 32), (500, 300)])
def test_stretching_equals_the_plain_filter(interpolation, size):
    generator = np.random.default_rng(0)
    # Away from black and white: the cubic overshoots, and is cut off there between its two passes.
    clip = generator.integers(80, 176, (2, *size, 3)).astype(np.uint8)
    geometry = ClipGeometry(32, interpolation)
    stretched = stretch(clip, geometry)
    assert stretched.dtype == torch.uint8 and stretched.shape == (2, 3, 32, 32)
    # Each of two passes rounds to whole values, and the cubic's weights are fixed-point.
    np.testing.assert_allclose(stretched.numpy(), reference(clip, geometry), atol=2.5)


@pytest.mark.parametrize("size", [(40, 200), (200, 40)])
def test_both_ends_of_a_long_crop_are_in_view(size):
    """The two objects of a pair are at the sides of their crop."""
    clip = np.zeros((1, *size, 3), np.uint8)
    clip[:, :20, :20] = 200
    clip[:, -20:, -20:] = 100
    stretched = stretch(clip, ClipGeometry(32, "bilinear"))[0, 0]
    # A tenth of the long side, and half of the short one.
    assert (stretched == 200).sum() >= 2 * 15 and (stretched == 100).sum() >= 2 * 15


@pytest.mark.parametrize("size", [(1, 1), (1, 640), (480, 1)])
def test_any_crop_gives_a_whole_square(size):
    clip = np.full((2, *size, 3), 77, np.uint8)
    stretched = stretch(clip, clip_models.vjepa2_geometry(256))
    assert stretched.shape == (2, 3, 256, 256) and (stretched == 77).all()


def test_interpolation_is_that_of_the_published_processors():
    assert clip_models.vjepa2_geometry(384) == ClipGeometry(384, "bilinear")
    assert clip_models.dinov2_geometry(224) == ClipGeometry(224, "bicubic")


def test_normalisation_is_per_channel():
    images = torch.tensor([0, 128, 255], dtype=torch.uint8).reshape(1, 1, 3, 1, 1)
    values = normalise(images, torch.float32).flatten().numpy()
    expected = (np.array([0, 128, 255]) / 255 - IMAGENET_MEAN) / IMAGENET_STD
    np.testing.assert_allclose(values, expected, rtol=1e-5)

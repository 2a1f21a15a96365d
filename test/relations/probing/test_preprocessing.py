"""Resizing, cutting and normalising against a plain reference."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("transformers")
pytestmark = pytest.mark.models

from deworldsg_ros.checkpoints.card import IMAGENET_MEAN, IMAGENET_STD  # noqa: E402
from deworldsg_ros.relations.probing.preprocessing import (  # noqa: E402  after the guards
    ClipGeometry,
    normalise,
    resize_and_crop,
)
from deworldsg_ros.relations.world_models import dinov2, vjepa2  # noqa: E402


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
    height, width = clip.shape[1:3]
    short = min(height, width)
    new_height, new_width = (geometry.short_edge * edge // short for edge in (height, width))
    rows = resize_matrix(height, new_height, kernel)
    columns = resize_matrix(width, new_width, kernel)
    resized = np.einsum("yh,thwc,xw->tcyx", rows, clip.astype(np.float64), columns)
    top, left = round((new_height - geometry.crop) / 2), round((new_width - geometry.crop) / 2)
    middle = resized[:, :, top : top + geometry.crop, left : left + geometry.crop]
    return np.clip(middle, 0, 255)


@pytest.mark.parametrize("interpolation", ["bilinear", "bicubic"])
@pytest.mark.parametrize("size", [(60, 80), (80, 60), (7, 25), (36, 36), (500, 300)])
def test_resizing_equals_the_plain_filter(interpolation, size):
    generator = np.random.default_rng(0)
    # Away from black and white: the cubic overshoots, and is cut off there between its two passes.
    clip = generator.integers(80, 176, (2, *size, 3)).astype(np.uint8)
    geometry = ClipGeometry(36, 32, interpolation)
    resized = resize_and_crop(clip, geometry)
    assert resized.dtype == torch.uint8 and resized.shape == (2, 3, 32, 32)
    # Each of two passes rounds to whole values, and the cubic's weights are fixed-point.
    np.testing.assert_allclose(resized.numpy(), reference(clip, geometry), atol=2.5)


def test_the_middle_of_a_very_long_crop_is_used():
    clip = np.zeros((1, 4, 400, 3), np.uint8)
    clip[:, :, 198:202] = 200
    resized = resize_and_crop(clip, ClipGeometry(36, 32, "bilinear"))
    # 36 pixels for 4: the middle 32 are the middle 3.6, bright but for what bleeds in.
    assert resized.shape == (1, 3, 32, 32) and (resized > 150).all()
    assert (resized == resized.flip(-1)).all()


@pytest.mark.parametrize("size", [(1, 1), (1, 640), (480, 1)])
def test_any_crop_gives_a_whole_square(size):
    clip = np.full((2, *size, 3), 77, np.uint8)
    assert (resize_and_crop(clip, vjepa2.clip_geometry(256)) == 77).all()


def test_geometry_is_that_of_the_published_processors():
    assert vjepa2.clip_geometry(256) == ClipGeometry(292, 256, "bilinear")
    assert vjepa2.clip_geometry(384) == ClipGeometry(438, 384, "bilinear")
    assert dinov2.clip_geometry(224) == ClipGeometry(256, 224, "bicubic")


def test_normalisation_is_per_channel():
    images = torch.tensor([0, 128, 255], dtype=torch.uint8).reshape(1, 1, 3, 1, 1)
    values = normalise(images, torch.float32).flatten().numpy()
    expected = (np.array([0, 128, 255]) / 255 - IMAGENET_MEAN) / IMAGENET_STD
    np.testing.assert_allclose(values, expected, rtol=1e-5)

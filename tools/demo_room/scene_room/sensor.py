"""Noise of a real camera (exposure, grain, JPEG) and of a structured-light depth sensor."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .render import FOCAL_PX, RenderedFrame


@dataclass(frozen=True)
class DepthNoise:
    """Parameters of the depth sensor. The ground truth contains them under these names.

    The axial deviation is `sigma_base_m + sigma_quadratic (z − 0.4)²`. A matching window correlates
    it over a few pixels. Disparity has steps of `disparity_step_px` at `baseline_m`.
    """

    sigma_base_m: float = 0.0008
    sigma_quadratic: float = 0.0013
    correlation_px: float = 3.2
    white_share: float = 0.0
    baseline_m: float = 0.075
    disparity_step_px: float = 0.125
    edge_jitter_px: float = 0.4
    flying_share: float = 0.22
    edge_hole_share: float = 0.22
    min_cos_incidence: float = 0.20
    min_depth_m: float = 0.40
    max_depth_m: float = 4.6

    def as_dict(self) -> dict[str, float]:
        """The parameters by name."""
        return asdict(self)


def sense_depth(
    frame: RenderedFrame, noise: DepthNoise, rng: np.random.Generator
) -> NDArray[np.uint16]:
    """Noisy depth (H, W) uint16, millimetres; 0 = no value."""
    depth = frame.depth_m
    height, width = depth.shape
    jitter = [
        cv2.GaussianBlur(rng.normal(size=depth.shape).astype(np.float32), (0, 0), 2.0)
        for _ in range(2)
    ]
    jitter = [noise.edge_jitter_px * j / j.std() for j in jitter]
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    sampled = cv2.remap(
        depth, x + jitter[0], y + jitter[1], cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE
    )

    filled = np.where(sampled > 0, sampled, 20.0).astype(np.float32)
    near = cv2.erode(filled, np.ones((3, 3)))
    far = cv2.dilate(np.where(sampled > 0, sampled, 0).astype(np.float32), np.ones((3, 3)))
    edge = (far - near) > np.maximum(0.03, 0.03 * near)
    draw = _patches(rng, depth.shape, 1.4)
    fraction = rng.random(depth.shape) ** 1.5
    flying = edge & (draw < noise.flying_share)
    z = np.where(flying, near + fraction * (far - near), sampled)
    holes = edge & (draw > 1 - noise.edge_hole_share)

    grain = cv2.GaussianBlur(
        rng.normal(size=depth.shape).astype(np.float32), (0, 0), noise.correlation_px
    )
    grain = grain / grain.std() * np.sqrt(1 - noise.white_share**2)
    grain += noise.white_share * rng.normal(size=depth.shape)
    sigma = noise.sigma_base_m + noise.sigma_quadratic * np.maximum(z - 0.4, 0) ** 2
    z = z + sigma * grain
    with np.errstate(divide="ignore"):
        disparity = FOCAL_PX * noise.baseline_m / np.maximum(z, 1e-3)
    steps = np.maximum(np.round(disparity / noise.disparity_step_px), 1)
    z = FOCAL_PX * noise.baseline_m / (steps * noise.disparity_step_px)

    patchy = cv2.GaussianBlur(rng.normal(size=depth.shape).astype(np.float32), (0, 0), 4)
    patchy = 0.05 * patchy / patchy.std()
    holes |= frame.cos_incidence < noise.min_cos_incidence + patchy
    holes |= (sampled <= 0) | (z > noise.max_depth_m) | (z < noise.min_depth_m)
    return np.where(holes, 0, np.round(z * 1000)).astype(np.uint16)


def _patches(
    rng: np.random.Generator, shape: tuple[int, ...], size_px: float
) -> NDArray[np.float64]:
    """Smooth random field, uniformly distributed in [0, 1]."""
    field = cv2.GaussianBlur(rng.normal(size=shape).astype(np.float32), (0, 0), size_px)
    rank = np.empty(field.size)
    rank[np.argsort(field, axis=None)] = np.linspace(0, 1, field.size)
    return rank.reshape(shape)


def expose(
    radiance: NDArray[np.float32], gain: float, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """8-bit BGR picture with lens blur, vignetting, exposure, noise and a tone curve."""
    height, width = radiance.shape[:2]
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    r2 = ((x - width / 2) ** 2 + (y - height / 2) ** 2) / (width / 2) ** 2
    blurred = cv2.GaussianBlur(radiance, (0, 0), 0.45)
    light = blurred * gain * (1 - 0.10 * r2)[..., None]
    grain = rng.normal(size=light.shape).astype(np.float32)
    light = light + grain * np.sqrt(0.000045 * np.maximum(light, 0) + 0.0000018)
    light = np.maximum(light, 0)
    # A rational filmic curve, then the gamma of the display.
    curve = light * (2.51 * light + 0.03) / (light * (2.43 * light + 0.59) + 0.14)
    picture = np.clip(curve, 0, 1) ** (1 / 2.2) * 255
    return np.clip(np.round(picture), 0, 255).astype(np.uint8)[..., ::-1].copy()


def jpeg(picture_bgr: NDArray[np.uint8], quality: int) -> bytes:
    """The picture as JPEG. `quality` is 0 to 100."""
    ok, data = cv2.imencode(".jpg", picture_bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert ok
    return bytes(data.tobytes())

"""Depth cameras from good to bad: each room gets one."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .render import FOCAL_PX, Frame


@dataclass(frozen=True)
class DepthSensor:
    """Faults of a depth camera.

    Attributes:
        sigma_m, sigma_per_m2: axial deviation sigma_m + sigma_per_m2 (z − 0.4)².
        correlation_px: size of the grain; 0 = each pixel for itself.
        flying_px, flying_share: width of the band at depth edges, and its share of mixed pixels.
        edge_hole_share: share of that band without a value.
        bleed_px: the near side grows by this much at edges, as in a camera with a window.
        blur_px: smoothing across everything, edges too.
        min_cos: no value where the surface is seen at a more grazing angle.
        disparity_px: step of the disparity at a baseline of 7.5 cm; 0 = none.
        max_m: range.
    """

    sigma_m: float
    sigma_per_m2: float
    correlation_px: float
    flying_px: int
    flying_share: float
    edge_hole_share: float
    bleed_px: int
    blur_px: float
    min_cos: float
    disparity_px: float
    max_m: float

    def as_dict(self) -> dict[str, float]:
        """The parameters by name."""
        return asdict(self)


def draw_sensor(rng: np.random.Generator) -> DepthSensor:
    """A sensor between a good and a bad one."""
    s = rng.uniform(0.2, 1.3)
    return DepthSensor(
        sigma_m=0.0012 * s,
        sigma_per_m2=0.0019 * s,
        correlation_px=float(rng.choice([0.0, 0.0, 1.5, 3.0])),
        flying_px=int(rng.choice([1, 2, 2, 3])),
        flying_share=float(rng.uniform(0.1, 0.6)),
        edge_hole_share=float(rng.choice([0.0, rng.uniform(0.1, 0.4)])),
        bleed_px=int(rng.choice([0, 0, 1, 2])),
        blur_px=float(rng.choice([0.0, 0.0, 0.7, 1.2])),
        min_cos=float(rng.uniform(0.08, 0.26)),
        disparity_px=float(rng.choice([0.0, 0.0, 0.0625, 0.125])),
        max_m=float(rng.uniform(4.0, 6.0)),
    )


def sense(frame: Frame, sensor: DepthSensor, rng: np.random.Generator) -> NDArray[np.uint16]:
    """Depth (H, W) uint16 in millimetres as the sensor measures it; 0 = no value."""
    true = frame.depth_m
    filled = np.where(true > 0, true, 20.0).astype(np.float32)
    z = filled
    if sensor.bleed_px:
        grown = cv2.erode(z, np.ones((2 * sensor.bleed_px + 1,) * 2))
        ragged = cv2.GaussianBlur(rng.standard_normal(z.shape, np.float32), (0, 0), 2.0) > 0
        z = np.where(ragged, grown, z)
    window = np.ones((2 * sensor.flying_px + 1,) * 2)
    near, far = cv2.erode(z, window), cv2.dilate(np.where(z < 19, z, 0).astype(np.float32), window)
    # As in the other rooms: an edge is a bend of the depth, so that slanted surfaces are none.
    bend = np.abs(cv2.Laplacian(z, cv2.CV_32F)) > np.maximum(0.03, 0.02 * z)
    edge = cv2.dilate(bend.astype(np.uint8), window) > 0
    if sensor.blur_px:
        z = cv2.GaussianBlur(z, (0, 0), sensor.blur_px)
    draw = rng.random(z.shape)
    share = rng.random(z.shape, np.float32)
    z = np.where(edge & (draw < sensor.flying_share), near * share + far * (1 - share), z)
    holes = edge & (draw > 1 - sensor.edge_hole_share)
    grain = rng.standard_normal(z.shape, np.float32)
    if sensor.correlation_px:
        grain = cv2.GaussianBlur(grain, (0, 0), sensor.correlation_px)
        grain /= grain.std()
    z = z + (sensor.sigma_m + sensor.sigma_per_m2 * (z - 0.4) ** 2) * grain
    if sensor.disparity_px:
        disparity = FOCAL_PX * 0.075 / np.maximum(z, 0.05)
        steps = np.maximum(np.round(disparity / sensor.disparity_px), 1)
        z = FOCAL_PX * 0.075 / (steps * sensor.disparity_px)
    patchy = cv2.GaussianBlur(rng.standard_normal(z.shape, np.float32), (0, 0), 6)
    holes |= frame.cos_incidence < sensor.min_cos + 0.04 * patchy / patchy.std()
    holes |= (true <= 0) | (z > sensor.max_m) | (z < 0.25)
    return np.where(holes, 0, np.round(z * 1000)).astype(np.uint16)

"""Fixed values of the lifting stage."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LiftingConstants:
    """Values that no configuration changes; tests vary them.

    Attributes:
        epsilon_m: absolute tolerance to the local median, metres (Eq. 1). Printed in the paper.
        alpha: factor of the median depth step (Eq. 2). Printed in the paper.
        beta: factor of the reference depth (Eq. 2). Printed in the paper.
        min_pixels: an object with fewer valid pixels is dropped. Printed in the paper, which
            checks the mask; here it is checked after each refinement step too.
        surface_points: surface points sampled from an object in one frame. An object with a large
            surface gets up to `LARGE_SURFACE_FACTOR` times as many.
    """

    epsilon_m: float = 1e-3
    alpha: float = 10.0
    beta: float = 0.02
    min_pixels: int = 10
    surface_points: int = 200


# Every N-th pixel of the depth image is kept, in both directions, for the negative evidence of the
# merging stage: 4800 samples of a 640 x 480 image.
DEPTH_GRID_STRIDE_PX = 8
# A surface gets one point for each 30 cm², up to LARGE_SURFACE_FACTOR times the usual number. Two
# samples of a wardrobe then meet in the 3 cm cells of the merging stage, or in adjacent cells.
POINT_AREA_M2 = 0.003
LARGE_SURFACE_FACTOR = 4

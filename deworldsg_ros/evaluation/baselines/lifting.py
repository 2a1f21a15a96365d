"""What the baselines' lifting hands on, and the back-projection that they share."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.evaluation.baselines.graph import BaselineNode
from deworldsg_ros.scene.arrays import Float64, Int64
from deworldsg_ros.scene.camera import Intrinsics


@dataclass(frozen=True)
class Lifted:
    """Nodes of one frame.

    Attributes:
        nodes: what could be lifted.
        rows: the row of the frame graph that each came from.
        drops: objects left out, by reason.
    """

    nodes: list[BaselineNode]
    rows: list[int]
    drops: Counter[str]


def back_project(pixels: Int64, depths_m: NDArray[np.floating], intrinsics: Intrinsics) -> Float64:
    """Points (n, 3) in the camera frame of pixels (n, 2) column, row, at their depths (n,)."""
    depths = np.asarray(depths_m, np.float64)
    x = (pixels[:, 0] - intrinsics.cx) / intrinsics.fx * depths
    y = (pixels[:, 1] - intrinsics.cy) / intrinsics.fy * depths
    return np.stack([x, y, depths], axis=1)

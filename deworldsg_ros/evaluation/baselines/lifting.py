"""The output of a baseline's lifting, and the back-projection of the baselines."""

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
        nodes: lifted nodes.
        rows: row of the frame graph of each node.
        drops: number of objects left out, by reason.
    """

    nodes: list[BaselineNode]
    rows: list[int]
    drops: Counter[str]


def back_project(pixels: Int64, depths_m: NDArray[np.floating], intrinsics: Intrinsics) -> Float64:
    """Points (n, 3) in the camera frame of pixels (n, 2), column and row, with depths (n,)."""
    depths = np.asarray(depths_m, np.float64)
    x = (pixels[:, 0] - intrinsics.cx) / intrinsics.fx * depths
    y = (pixels[:, 1] - intrinsics.cy) / intrinsics.fy * depths
    return np.stack([x, y, depths], axis=1)

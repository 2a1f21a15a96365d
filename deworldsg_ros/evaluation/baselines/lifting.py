"""The output of a baseline's lifting."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from deworldsg_ros.evaluation.baselines.graph import BaselineNode


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

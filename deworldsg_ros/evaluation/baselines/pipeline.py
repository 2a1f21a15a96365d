"""A baseline with the interface of the pipeline: same input, a graph as output."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from deworldsg_ros.evaluation.baselines.graph import BaselineGraph, BaselineNode
from deworldsg_ros.evaluation.baselines.lifting import Lifted
from deworldsg_ros.pipeline import Perceiver, watch_parts
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Float32, Float64, UInt8
from deworldsg_ros.scene.camera import Intrinsics, RgbdFrame
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import FrameGraph, Relations
from deworldsg_ros.timing import Times, timed


class Baseline(Protocol):
    """Lifting and association of a baseline."""

    name: str

    def lift(
        self,
        frame_graph: FrameGraph,
        rgb: UInt8,
        depth_m: Float32,
        intrinsics: Intrinsics,
        T_world_camera: Float64,
    ) -> Lifted:
        """Nodes of one frame."""
        ...

    def choose(self, node: BaselineNode, others: Sequence[BaselineNode]) -> int | None:
        """Index of the node that absorbs `node`, or None."""
        ...

    def fuse(self, keeper: BaselineNode, other: BaselineNode) -> BaselineNode:
        """Both nodes in one."""
        ...


class BaselinePipeline:
    """perceive → lift → merge, one frame at a time.

    Args:
        baseline: lifts and merges.
        perceiver: source of detections and relations.

    Attributes:
        drops: number of objects left out so far, by reason.
        times_s: seconds of each stage, one entry per frame.
    """

    def __init__(self, baseline: Baseline, perceiver: Perceiver) -> None:
        self.drops: Counter[str] = Counter()
        self.times_s: dict[str, Times] = {
            name: Times() for name in ("perception", "lifting", "merging")
        }
        watch_parts(perceiver, self.times_s)
        self._baseline = baseline
        self._perceiver = perceiver
        self._graph: BaselineGraph | None = None

    def process(self, frame: RgbdFrame) -> list[int]:
        """Integrate a frame into the graph; returns the node id of each lifted object."""
        with timed(self.times_s["perception"]):
            perceived = self._perceiver.perceive(frame)
        frame_graph = perceived.frame_graph
        with timed(self.times_s["lifting"]):
            lifted = self._baseline.lift(
                frame_graph, frame.rgb, frame.depth_m, frame.intrinsics, frame.T_world_camera
            )
        if self._graph is None:
            self._graph = BaselineGraph(
                frame_graph.vocabulary, frame.frame_id, self._baseline.choose, self._baseline.fuse
            )
        with timed(self.times_s["merging"]):
            node_ids = self._graph.integrate(
                lifted.nodes, between(frame_graph.relations, lifted.rows), frame.stamp_ns
            )
        self.drops.update(perceived.drops)
        self.drops.update(lifted.drops)
        return node_ids

    def graph(self) -> wire.SceneGraphMessage:
        """The graph so far; raises RefusedInput ``no_frames`` before the first frame."""
        if self._graph is None:
            raise RefusedInput("no_frames", "no frame was processed: the graph does not exist yet")
        return self._graph.message()


def between(relations: Relations, rows: Sequence[int]) -> Relations:
    """Relations between these rows of the frame graph, with indices into `rows` as pairs."""
    index_of = {row: index for index, row in enumerate(rows)}
    kept = [
        number
        for number, (subject, object_) in enumerate(relations.pairs.tolist())
        if subject in index_of and object_ in index_of
    ]
    pairs = [[index_of[end] for end in pair] for pair in relations.pairs[kept].tolist()]
    return Relations(
        np.array(pairs, np.int64).reshape(-1, 2), relations.logits[kept], relations.scores[kept]
    )

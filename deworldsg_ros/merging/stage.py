"""The merging stage: each object of a frame matches a node of the global graph, or creates one."""

from __future__ import annotations

from collections.abc import Collection
from typing import Protocol

from deworldsg_ros.base.array_file import Arrays
from deworldsg_ros.config import MergingConfig
from deworldsg_ros.graph.edits import EditRequest
from deworldsg_ros.graph.floor_plan import FoundThings
from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.graph.nodes import NodeTable
from deworldsg_ros.merging.editing import EditReply
from deworldsg_ros.merging.paper_rule import PaperMerging
from deworldsg_ros.merging.surface_rule import SurfaceMerging
from deworldsg_ros.scene.arrays import Bool, Float64, Int64
from deworldsg_ros.scene.frame_graph import LocalGraph


class Merging(Protocol):
    """An association rule, with its state for one scene graph."""

    def warm_up(self) -> None:
        """Compile the kernels before the first frame."""
        ...

    def configure(self, config: MergingConfig) -> None:
        """Use other thresholds from the next frame on; the rule stays."""
        ...

    def publish_from(self, graph: GlobalGraph, min_existence: float) -> None:
        """Publish the nodes that are objects with at least this probability, and hide the others.

        The paper's rule publishes all nodes.
        """
        ...

    def merge(self, graph: GlobalGraph, local: LocalGraph) -> list[int]:
        """Merge one frame into the graph. All calls use the same graph.

        Returns:
            The node id of each row of the local graph, after all merges of this frame.

        Raises:
            RefusedInput: as `GlobalGraph.admit`.
        """
        ...

    def things(self) -> set[int]:
        """The nodes that were never detected: things that `add` has added."""
        ...

    def add(self, graph: GlobalGraph, found: FoundThings) -> None:
        """Make each thing that no detector fires at a node without a name.

        A thing of before keeps its node. It goes if its views were searched again, and it was not
        found. The paper's rule has no such nodes.
        """
        ...

    def hidden(self, graph: GlobalGraph) -> dict[int, str]:
        """The nodes that are not published, each with its reason, in words."""
        ...

    def shown(self, nodes: NodeTable, slots: Int64) -> Bool | None:
        """Which surface points (n, K) the images show as those of n nodes; None = not known."""
        ...

    def memory(self) -> Arrays:
        """The state besides the graph, as arrays by name, for `restore`."""
        ...

    def restore(self, graph: GlobalGraph, memory: Arrays) -> None:
        """Continue with a graph of an earlier run; call it before the first frame.

        Args:
            graph: may lack nodes that the memory contains.
            memory: of the rule that made the graph; it may be another rule.

        Raises:
            KeyError, ValueError, TypeError, IndexError: if this is no memory of a rule.
        """
        ...

    def edit(self, graph: GlobalGraph, request: EditRequest, stamp_ns: int) -> EditReply:
        """Make an operator's edit, or undo one; see `Editor.apply`.

        Raises:
            RefusedInput: ``invalid_request``, with the reason; nothing is changed then.
        """
        ...

    def move(
        self, graph: GlobalGraph, slots: Int64, T_new_old: Float64, due: Collection[int]
    ) -> Float64:
        """Move nodes as the keyframes that saw them have moved, and merge those that meet then.

        Args:
            graph: changed.
            slots: (n,) of the nodes.
            T_new_old: (k, 4, 4) by the number of the keyframe; see `NodeTable.move`.
            due: ids of nodes that have still to be moved: none of them is merged.

        Returns:
            (n, 4, 4), how most of each node has moved.
        """
        ...


def build_merging(config: MergingConfig, min_existence: float) -> Merging:
    """The configured association rule.

    Args:
        config: of the stage.
        min_existence: the surface rule publishes a node if it is an object with at least this
            probability. The paper's rule publishes all nodes.
    """
    if config.association == "paper":
        return PaperMerging(config)
    return SurfaceMerging(config, min_existence)

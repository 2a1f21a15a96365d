"""The merging stage: each object of a local graph joins the global node it is, or founds one."""

from __future__ import annotations

from typing import Protocol

from deworldsg_ros.config import MergingConfig
from deworldsg_ros.merging.local import Memory
from deworldsg_ros.merging.paper_rule import PaperMerging
from deworldsg_ros.merging.surface_rule import SurfaceMerging
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.frame_graph import LocalGraph
from deworldsg_ros.scene.graph import SceneGraph


class Merging(Protocol):
    """An association rule, with what it remembers of one scene graph."""

    def warm_up(self) -> None:
        """Compile now what would else be compiled during the first frame."""
        ...

    def merge(self, graph: SceneGraph, local: LocalGraph) -> list[int]:
        """Merge one frame into the graph, always the same one.

        Returns:
            The id of the node that each row became, after all merges of this frame.

        Raises:
            RefusedInput: ``vocabulary_mismatch`` or ``wrong_frame`` where the local graph
                does not speak of the same classes and predicates, or the same world frame.
        """
        ...

    def memory(self) -> Memory:
        """What it remembers beside the graph, for `restore`."""
        ...

    def restore(self, graph: SceneGraph, memory: Memory) -> None:
        """Go on with a graph of an earlier run; before the first frame.

        Args:
            graph: may lack nodes that are remembered.
            memory: of the rule that made it, which may have been another.

        Raises:
            KeyError, ValueError, TypeError, IndexError: where this is no memory.
        """
        ...

    def moved(self, graph: SceneGraph, node_ids: list[int], T_correction: Float64) -> None:
        """Follow nodes that a correction (4, 4) has moved in the graph."""
        ...


def build_merging(config: MergingConfig) -> Merging:
    """The configured association rule."""
    return SurfaceMerging(config) if config.association == "surface" else PaperMerging(config)

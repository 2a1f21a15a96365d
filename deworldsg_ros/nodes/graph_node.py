"""graph_node: local graphs and relation evidence → /scene_graph, its updates and its markers."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

from deworldsg_ros.ros.graph_keeper import GraphKeeper
from deworldsg_ros.ros.graph_services import GraphServices
from deworldsg_ros.ros.node import StageNode, run
from deworldsg_ros.ros.options import LIVE_GRAPH
from deworldsg_ros.view.markers import markers
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.codec import evidence_from_message, local_graph_from_message

# /diagnostics warns after this time without a local graph.
SILENCE_S = 2.0


class GraphNode(StageNode):
    """Stage c, and the fusion of stage d, as a node.

    Raises:
        ConfigurationError: for a map file that cannot be read or written.
    """

    LIVE = LIVE_GRAPH

    def __init__(self, **options: Any) -> None:
        super().__init__("graph_node", "graphs", **options)
        self.graph = GraphKeeper(
            self, markers, lambda _, latency_s: self.health.published(latency_s)
        )
        self._answers = GraphServices(self, self.graph)
        self._received_s = time.monotonic()
        self.listen_json(
            "deworldsg/local_graph", wire.LocalGraphMessage, self._integrate, 50, self._receive
        )
        self.listen_json(
            "deworldsg/relation_evidence",
            wire.RelationEvidenceMessage,
            self._add,
            50,
            self.graph.submit_evidence,
        )

    def configure(self) -> None:
        """Take changed parameters."""
        self.graph.submit(lambda: self.graph.configure(self.parameters))

    def close(self) -> None:
        """Write the map file."""
        self._answers.close()
        self.graph.close()
        super().close()

    def _receive(self, job: Callable[[], None]) -> None:
        self._received_s = time.monotonic()
        self.graph.submit(job)

    def _integrate(self, message: wire.LocalGraphMessage) -> None:
        self.graph.integrate(local_graph_from_message(message))

    def _add(self, message: wire.RelationEvidenceMessage) -> None:
        self.graph.add_evidence(evidence_from_message(message))

    def waiting_for(self, now_ns: int) -> list[str]:
        """The topic of the local graphs, if it is silent, and problems of the graph."""
        silence_s = now_ns / 1e9 - self._received_s
        topic = self.resolve_topic_name("deworldsg/local_graph")
        silent = [f"no local_graph on {topic} for {silence_s:.0f} s"]
        return [*(silent if silence_s > SILENCE_S else []), *self.graph.problems()]

    def more_values(self) -> dict[str, str]:
        """The size of the graph."""
        return self.graph.values()


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(GraphNode, args)


if __name__ == "__main__":
    sys.exit(main())

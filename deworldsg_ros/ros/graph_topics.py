"""A graph that is made as a whole, on topics like those of graph_node."""

from __future__ import annotations

from deworldsg_ros.ros.node import StageNode
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.change_log import ChangeLog

# The whole graph is for those who join late, as that of graph_node.
WHOLE_PERIOD_S = 1.0


class GraphTopics:
    """Publishes `PREFIX/scene_graph`, once a second, and `PREFIX/scene_graph/updates`, at once.

    A `SceneGraphClient` with the namespace ``/PREFIX`` follows them.

    Args:
        node: publishes.
        prefix: of the topics.

    Attributes:
        log: the graph that was published last.
    """

    def __init__(self, node: StageNode, prefix: str) -> None:
        self.log = ChangeLog()
        self._sequence = 0
        self._session: str | None = None
        self._publish_whole = node.text_publisher(f"{prefix}/scene_graph", 1, latched=True)
        self._whole: wire.SceneGraphMessage | None = None
        node.every(WHOLE_PERIOD_S, self._tell_whole)
        self._publish_update = node.json_publisher(f"{prefix}/scene_graph/updates", 50)

    def publish(self, graph: wire.SceneGraphMessage) -> None:
        """Publish a graph, if it has a new number."""
        self.log.set(graph)
        update = self.log.since(self._session, self._sequence)
        if update is None:
            return
        self._session, self._sequence = update.session or None, update.sequence
        self._publish_update(update)
        self._whole = graph

    def _tell_whole(self) -> None:
        graph, self._whole = self._whole, None
        if graph is not None:
            self._publish_whole(wire.encode(graph))

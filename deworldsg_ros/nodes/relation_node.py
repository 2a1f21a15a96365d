"""relation_node: local graphs and RGB → deworldsg/relation_evidence.

The evidence of a frame is published at once, the predictions of the world model when they are
ready. The published graph selects the pairs for the world model.
"""

from __future__ import annotations

import sys
from typing import Any

from std_msgs.msg import String

from deworldsg_ros.ros.inputs import listen_rgb
from deworldsg_ros.ros.joining import JoiningNode
from deworldsg_ros.ros.models import Relating
from deworldsg_ros.ros.node import run
from deworldsg_ros.ros.options import LIVE_RELATIONS
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.scene.frame_graph import RelationEvidence
from deworldsg_ros.streams.frames import PairingFrame, RelationAssembler
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.codec import evidence_to_message, local_graph_from_message


class RelationNode(JoiningNode[PairingFrame]):
    """Stage d as a node; the world model runs in its own thread, so that frames do not wait."""

    LIVE = LIVE_RELATIONS

    def __init__(self, **options: Any) -> None:
        super().__init__("relation_node", "evidence messages", **options)
        self._world_frame = ""
        self._publish = self.json_publisher("deworldsg/relation_evidence", 50)
        self._relating = Relating(self, self._deliver)
        self._graph = self._relating.graph
        self._snapshot_text = ""
        if self._relating.follows_graph:
            self._follow_graph()
        with_rgb = self._relating.needs_images
        frames = RelationAssembler(with_rgb=with_rgb, **self.assembler_options())
        self._frames = frames
        self.join(frames, self._relate)
        if with_rgb:
            listen_rgb(self, self.taking(frames.add_rgb), self.wants_rest)
        self.listen_json(
            "deworldsg/local_graph", wire.LocalGraphMessage, self.taking(self._add_local_graph), 50
        )

    def _follow_graph(self) -> None:
        self.listen_json(
            "scene_graph/updates", wire.SceneGraphUpdateMessage, self._update_graph, 50
        )
        self.create_subscription(
            String, "scene_graph", self.guarded(self._keep_snapshot), reliable(1, latched=True)
        )

    def _update_graph(self, update: wire.SceneGraphUpdateMessage) -> None:
        generation = self._graph.generation
        self._relating.apply(update)
        if self._graph.generation != generation:
            self._snapshot_text = ""  # a snapshot of the previous graph
        self._catch_up()

    def _keep_snapshot(self, message: Any) -> None:
        # The whole graph is published again and again. It is decoded only after a lost update.
        self._snapshot_text = message.data
        self._catch_up()

    def _catch_up(self) -> None:
        if self._snapshot_text and self._graph.wants_snapshot:
            self._relating.reset(wire.decode(self._snapshot_text, wire.SceneGraphMessage))

    def _add_local_graph(self, message: wire.LocalGraphMessage) -> None:
        self._frames.add_local_graph(local_graph_from_message(message))

    def _relate(self, frame: PairingFrame) -> None:
        self._world_frame = frame.local.frame_id
        self._relating.relate(frame)

    def _deliver(self, evidence: RelationEvidence) -> None:
        self._publish(evidence_to_message(evidence, self._world_frame))

    def configure(self) -> None:
        """Take changed parameters."""
        self._relating.configure(self.parameters.relations)

    def waiting_for(self, now_ns: int) -> list[str]:
        """Missing inputs, and a world model that fails or hangs, in words."""
        return [*super().waiting_for(now_ns), *self._relating.problems()]

    def hung(self) -> str:
        """A model that never returns, in words."""
        return self._relating.hung()

    def more_values(self) -> dict[str, str]:
        """Numbers of clips by their state."""
        return {**super().more_values(), **self._relating.values()}

    def close(self) -> None:
        """End the threads."""
        super().close()
        self._relating.close()


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(RelationNode, args)


if __name__ == "__main__":
    sys.exit(main())

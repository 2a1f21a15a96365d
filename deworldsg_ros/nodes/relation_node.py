"""relation_node: local graphs and RGB → deworldsg/relation_evidence.

The evidence of a frame is published at once, the predictions of the world model when they are
ready. The published graph selects the pairs for the world model.
"""

from __future__ import annotations

import sys
from typing import Any

from std_msgs.msg import String

from deworldsg_ros.checkpoints.card import graph_predicates
from deworldsg_ros.checkpoints.required import require_checkpoints
from deworldsg_ros.relations.graph_view import PublishedGraph
from deworldsg_ros.relations.stage import RelationReasoner
from deworldsg_ros.relations.worker import EvidenceWorker
from deworldsg_ros.relations.world_model import build_world_model, require_predicates
from deworldsg_ros.ros.inputs import listen_rgb
from deworldsg_ros.ros.joining import JoiningNode
from deworldsg_ros.ros.node import run
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.codec import evidence_to_message, local_graph_from_message
from deworldsg_ros.scene.frame_graph import RelationEvidence
from deworldsg_ros.streams.frame_assemblers import PairingFrame, RelationAssembler


class RelationNode(JoiningNode[PairingFrame]):
    """Stage d as a node; the world model runs in its own thread, so that frames do not wait."""

    def __init__(self, **options: Any) -> None:
        super().__init__("relation_node", "evidence messages", **options)
        config = self.parameters.relations
        report = self.get_logger().warning
        require_checkpoints(relations=config)
        world_model = build_world_model(config, self.parameters.perception.device)
        predicates = graph_predicates(self.parameters.perception)
        if predicates is not None:  # else the first local graph contains them
            require_predicates(world_model, predicates)
        self._reasoner = RelationReasoner(config, world_model, report)
        self._world_frame = ""
        self._newest_ns = 0
        self._publish = self.json_publisher("deworldsg/relation_evidence", 50)
        self._world_model = EvidenceWorker(self._reasoner, self._deliver, report)
        self._world_model.start()
        self._graph = PublishedGraph()
        self._snapshot_text = ""
        if world_model is not None and config.max_clips_per_s:
            self._watch_graph()
        # Only clips need images.
        with_rgb = world_model is not None
        frames = RelationAssembler(with_rgb=with_rgb, **self.assembler_options())
        self._frames = frames
        self.join(frames, self._relate)
        if with_rgb:
            listen_rgb(self, self.taking(frames.add_rgb))
        self.listen_json(
            "deworldsg/local_graph", wire.LocalGraphMessage, self.taking(self._add_local_graph), 50
        )

    def _watch_graph(self) -> None:
        self._reasoner.watch(self._graph)
        self.listen_json(
            "scene_graph/updates", wire.SceneGraphUpdateMessage, self._update_graph, 50
        )
        self.create_subscription(
            String, "scene_graph", self.guarded(self._keep_snapshot), reliable(1, latched=True)
        )

    def _update_graph(self, update: wire.SceneGraphUpdateMessage) -> None:
        generation = self._graph.generation
        self._world_model.learn(lambda: self._graph.apply(update))
        if self._graph.generation != generation:
            self._snapshot_text = ""  # a snapshot of the previous graph
        self._catch_up()

    def _keep_snapshot(self, message: Any) -> None:
        # Each change publishes the whole graph. It is decoded only after a lost update.
        self._snapshot_text = message.data
        self._catch_up()

    def _catch_up(self) -> None:
        if self._snapshot_text and self._graph.wants_snapshot:
            snapshot = wire.decode(self._snapshot_text, wire.SceneGraphMessage)
            self._world_model.learn(lambda: self._graph.reset(snapshot))

    def _add_local_graph(self, message: wire.LocalGraphMessage) -> None:
        self._frames.add_local_graph(local_graph_from_message(message))

    def _relate(self, frame: PairingFrame) -> None:
        if frame.local.stamp_ns < self._newest_ns:  # a recording was restarted
            self._reasoner.clear()
        self._newest_ns = frame.local.stamp_ns
        self._world_frame = frame.local.frame_id
        self._deliver(self._world_model.observe(frame.local, frame.rgb))

    def _deliver(self, evidence: RelationEvidence) -> None:
        self._publish(evidence_to_message(evidence, self._world_frame))

    def more_values(self) -> dict[str, str]:
        """Numbers of clips by their state."""
        counters = self._reasoner.counters()
        clips = {"queued": counters.queued, "encoded": counters.encoded}
        clips["pending"] = counters.ready
        clips["waiting"] = counters.pending - counters.ready
        clips.update((f"dropped {reason}", n) for reason, n in sorted(counters.dropped.items()))
        values = {f"clips {name}": str(count) for name, count in clips.items()}
        return {**super().more_values(), **values}

    def close(self) -> None:
        """End the threads."""
        super().close()
        self._world_model.stop()


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(RelationNode, args)


if __name__ == "__main__":
    sys.exit(main())

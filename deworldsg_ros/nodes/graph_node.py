"""graph_node: local graphs and relation evidence → /scene_graph, its updates and its markers."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from deworldsg_ros.files import write_atomically
from deworldsg_ros.graph_builder import GraphBuilder, warm_up
from deworldsg_ros.map_file import check_map_writable, read_map, write_map
from deworldsg_ros.ros.markers import marker_array
from deworldsg_ros.ros.node import StageNode, run
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.codec import evidence_from_message, local_graph_from_message
from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput
from deworldsg_ros.streams.pending import PendingEvidence
from deworldsg_ros.streams.poses import pose_from_message, stamp_ns_of
from deworldsg_ros.view.markers import markers

# /diagnostics warns after this time without a local graph.
SILENCE_S = 2.0
CORRECTION_TOPIC = "deworldsg/pose_correction"


class GraphNode(StageNode):
    """Stage c, and the fusion of stage d, as a node.

    Raises:
        ConfigurationError: for a map file that cannot be read or written.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("graph_node", "graphs", **options)
        warm_up(self.parameters)
        # None until a map or the first local graph gives the world frame and the vocabulary.
        self._builder: GraphBuilder | None = None
        map_path = self.parameters.node.map_path
        self._map_path = Path(map_path).absolute() if map_path else None
        self._pending = PendingEvidence()
        self._newest_ns = 0
        self._changed_s: float | None = None
        self._received_s = time.monotonic()
        self._publish_graph = self.json_publisher("/scene_graph", 1, latched=True)
        self._publish_update = self.json_publisher("/scene_graph/updates", 50)
        self._markers = self.create_publisher(
            MarkerArray, "/scene_graph/markers", reliable(1, latched=True)
        )
        self.create_service(Trigger, "~/save", self._save)
        self.listen_json("deworldsg/local_graph", wire.LocalGraphMessage, self._integrate, 50)
        self.listen_json(
            "deworldsg/relation_evidence", wire.RelationEvidenceMessage, self._add_evidence, 50
        )
        self._corrections = self._corrected_nodes = 0
        self.create_subscription(
            PoseStamped, CORRECTION_TOPIC, self.guarded(self._correct), reliable(10)
        )
        self.every(1.0 / self.parameters.output.rate_hz, self._publish)
        if self._map_path is not None:
            check_map_writable(self._map_path)
            if self._map_path.exists():
                self._continue_map(self._map_path)

    def _continue_map(self, path: Path) -> None:
        """Start with the graph of a map file; raises ConfigurationError if it contains none."""
        self._builder = read_map(self.parameters, path)
        graph = self._builder.graph
        self.get_logger().info(
            f"continuing map {path}: {len(graph)} nodes in frame '{graph.frame_id}'"
        )
        self._note_change()

    def close(self) -> None:
        """Write the map file."""
        if self._map_path is not None:
            written, message = self._save_map(self._map_path)
            if written:
                self.get_logger().info(message)
            else:
                self.get_logger().warning(message)
        super().close()

    def _integrate(self, message: wire.LocalGraphMessage) -> None:
        self._received_s = time.monotonic()
        local = local_graph_from_message(message)
        if self._builder is None:
            self._builder = GraphBuilder(self.parameters, local.vocabulary, local.frame_id)
        self._builder.integrate(local)
        self._newest_ns = local.stamp_ns
        self._note_change()
        for evidence in self._pending.take(local.stamp_ns):
            with self.refusing():
                self._builder.add_evidence(evidence)

    def _add_evidence(self, message: wire.RelationEvidenceMessage) -> None:
        evidence = evidence_from_message(message)
        if self._builder is None or evidence.stamp_ns > self._newest_ns:
            self._pending.add(evidence)
            return
        self._builder.add_evidence(evidence)
        self._note_change()

    def _correct(self, message: Any) -> None:
        """Move the nodes first observed at the stamp or later; the pose is the rigid transform."""
        self.health.received(CORRECTION_TOPIC)
        T_correction, frame_id = pose_from_message(message)
        if self._builder is None:
            raise RefusedInput(
                "no_graph", "pose correction before the first local graph: no node to correct"
            )
        if frame_id != self._builder.graph.frame_id:
            raise RefusedInput(
                "wrong_frame",
                f"pose correction is in frame '{frame_id}', expected "
                f"'{self._builder.graph.frame_id}'",
            )
        moved = self._builder.apply_correction(T_correction, stamp_ns_of(message))
        self._corrections += 1
        self._corrected_nodes += len(moved)
        self._note_change()

    def _note_change(self) -> None:
        if self._changed_s is None:
            self._changed_s = time.monotonic()

    def _publish(self) -> None:
        if self._builder is None or self._changed_s is None:
            return
        changed_s, self._changed_s = self._changed_s, None
        update = self._builder.update()
        if update is None:
            return
        snapshot = self._builder.snapshot()
        self._publish_update(update)
        self._publish_graph(snapshot)
        stamp = Time(sec=snapshot.stamp.sec, nanosec=snapshot.stamp.nanosec)
        self._markers.publish(marker_array(markers(snapshot), snapshot.frame_id, stamp))
        self.health.published(time.monotonic() - changed_s)

    def _save(self, request: Any, response: Any) -> Any:
        """Write the whole graph, with surface points, to `save_path`; and the map file."""
        response.message = "refused: see /diagnostics"
        with self.refusing():
            response.success, response.message = self._save_to(
                Path(self.parameters.node.save_path).absolute()
            )
            if response.success and self._map_path is not None:
                response.success, message = self._save_map(self._map_path)
                response.message += f"; {message}"
        return response

    def _save_map(self, path: Path) -> tuple[bool, str]:
        if self._builder is None:
            return False, "no map written: no local graph has arrived"
        try:
            write_map(self._builder, path)
        except ConfigurationError as error:
            return False, str(error)
        return True, f"map {path}: {self._builder.confirmed} nodes"

    def _save_to(self, path: Path) -> tuple[bool, str]:
        if self._builder is None:
            return False, "no graph yet: no local graph has arrived"
        message = self._builder.full()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, wire.encode(message).encode())
        except OSError as error:
            return False, f"{path}: {error}"
        return True, f"{path}: {len(message.nodes)} nodes, {len(message.edges)} edges"

    def waiting_for(self, now_ns: int) -> list[str]:
        """The topic of the local graphs, if it is silent."""
        silence_s = now_ns / 1e9 - self._received_s
        topic = self.resolve_topic_name("deworldsg/local_graph")
        return [f"no local_graph on {topic} for {silence_s:.0f} s"] if silence_s > SILENCE_S else []

    def more_values(self) -> dict[str, str]:
        """The size of the graph."""
        if self._builder is None:
            return {}
        snapshot = self._builder.snapshot()
        return {
            "nodes": str(len(snapshot.nodes)),
            **{f"hidden, {why}": str(count) for why, count in self._builder.hidden.items()},
            "edges": str(len(snapshot.edges)),
            "sequence": str(snapshot.sequence),
            "evidence waiting": str(len(self._pending)),
            "pose corrections": str(self._corrections),
            "nodes moved by corrections": str(self._corrected_nodes),
        }


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(GraphNode, args)


if __name__ == "__main__":
    sys.exit(main())

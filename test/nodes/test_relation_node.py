"""relation_node and the published graph: the pairs that the world model encodes."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
import rclpy
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image
from std_msgs.msg import String
from support.nodes_bench import Bench, changed, local_graph, rgb

from deworldsg_ros.checkpoints.cards import CheckpointCard, write_detector_card
from deworldsg_ros.nodes.relation_node import RelationNode
from deworldsg_ros.relations.world_model import FakeWorldModel
from deworldsg_ros.ros import models
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.wire import messages as wire

WORLD_MODEL = [
    Parameter("relations.world_model", value="fake"),
    Parameter("relations.clip_length", value=4),
]
TWO_CLASSES = {"classes": ["chair", "cup"], "predicates": ["on", "under", "near"]}


def two_objects(stamp_ns: int) -> wire.LocalGraphMessage:
    """A chair and a cup beside it."""
    message = changed(local_graph, **TWO_CLASSES)(stamp_ns)
    chair = message.objects[0]
    cup = msgspec.structs.replace(chair, instance=2, class_probabilities=[0.1, 0.9])
    message.objects = [chair, cup]
    return message


def send_two_objects(at: Bench) -> int:
    stamp_ns = at.next_stamp()
    at.send(rgb__image_raw=rgb(stamp_ns), deworldsg__local_graph=two_objects(stamp_ns))
    return stamp_ns


def test_the_published_graph_selects_the_pairs_of_the_world_model() -> None:
    """Lost updates and a restarted graph_node, too."""
    topics = {
        "rgb/image_raw": Image,
        "deworldsg/local_graph": String,
        "/scene_graph/updates": String,
        "/scene_graph": String,
    }
    at = Bench(RelationNode, topics, reliable(50, latched=True), parameter_overrides=WORLD_MODEL)
    graph = {"schema": None, "frame_id": "map", "edges": []}

    def nodes(observations: int) -> list[wire.NodeState]:
        return [
            wire.NodeState(
                id=node_id,
                label=label,
                classes=[wire.Belief(label, 1.0)],
                mean_m=[0.0, 0.0, 1.0],
                covariance_m2=np.eye(3).ravel().tolist(),
                observations=observations,
                first_seen=wire.Stamp(0, 0),
                last_seen=wire.Stamp(0, 0),
            )
            for node_id, label in ((1, "chair"), (2, "cup"))
        ]

    def publish(sequence: int, stamp_ns: int, observations: int) -> None:
        stamp = wire.stamp_from_ns(stamp_ns)
        common = {**graph, "stamp": stamp, "sequence": sequence, "nodes": nodes(observations)}
        update = wire.SceneGraphUpdateMessage(
            **{**common, "schema": wire.schema_of(wire.SceneGraphUpdateMessage)},
            removed_nodes=[],
            removed_edges=[],
            associations=[wire.Association(stamp, [1, 2])],
        )
        snapshot = wire.SceneGraphMessage(
            **{**common, "schema": wire.schema_of(wire.SceneGraphMessage)}
        )
        at.send(**{"/scene_graph/updates": update, "/scene_graph": snapshot})

    def clips(**expected: int) -> None:
        def reached() -> bool:
            values = at.node.more_values()
            return all(
                values.get(f"clips {name.replace('__', ' ')}", "0") == str(count)
                for name, count in expected.items()
            )

        at.expect(reached, f"clips {expected}, not {at.node.more_values()}")

    try:
        stamp_ns = send_two_objects(at)
        clips(encoded=1)  # without a graph, every pair is encoded
        publish(1, stamp_ns, 3)
        at.expect(lambda: at.node._graph.newest_ns == stamp_ns, "the update to come")
        stamp_ns = send_two_objects(at)
        clips(encoded=1, waiting=1)  # until the graph is updated
        publish(2, stamp_ns, 4)
        clips(encoded=2, waiting=0)
        publish(3, send_two_objects(at), 5)
        clips(encoded=2, dropped__already_encoded=1)
        publish(7, send_two_objects(at), 8)  # lost updates, and twice the observations
        clips(encoded=3, waiting=0)
        publish(1, send_two_objects(at), 3)  # another graph
        clips(encoded=4, waiting=0)
        assert "dropped internal_error" not in at.node.health.drops
    finally:
        at.close()


def test_a_restarted_recording_is_encoded_again() -> None:
    at = Bench(
        RelationNode,
        {"rgb/image_raw": Image, "deworldsg/local_graph": String},
        parameter_overrides=WORLD_MODEL,
    )

    def encoded() -> int:
        return int(at.node.more_values()["clips encoded"])

    try:
        at.peer.spin_for(0.5)
        started_ns = at.stamp_ns
        for count in range(1, 13):  # more than the buffer of eight holds
            send_two_objects(at)
            at.expect(lambda expected=count: encoded() == expected, f"{count} clips")
        at.stamp_ns = started_ns - 5 * 10**9
        # A clock that jumps back is believed when the next message confirms it.
        send_two_objects(at)
        send_two_objects(at)
        at.expect(lambda: encoded() == 14, "14 clips")
        assert at.node.more_values().get("clips dropped no_frame") is None
    finally:
        at.close()


def start(**overrides: str) -> RelationNode:
    """The node as it starts with a world model and parameters, named with __ for a dot."""
    parameters = [
        Parameter(name.replace("__", "."), value=value) for name, value in overrides.items()
    ]
    context = rclpy.Context()
    rclpy.init(context=context)
    try:
        node = RelationNode(context=context, parameter_overrides=[*WORLD_MODEL, *parameters])
        node.close()
        node.destroy_node()
    finally:
        rclpy.try_shutdown(context=context)
    return node


class Bound(FakeWorldModel):
    """A world model with fixed predicates, like one with a probe."""

    def require_predicates(self, predicates: tuple[str, ...]) -> None:
        if predicates != ("on", "under"):
            raise ConfigurationError(f"the probe was trained on others than {predicates}")


def test_predicates_of_an_imported_checkpoint_are_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The relation node runs no perception, and may run where its checkpoint is not."""
    monkeypatch.setattr(models, "build_world_model", lambda config, device: Bound(4))
    chosen = {"perception__predicate_set": "checkpoint"}
    for predicates in (("on", "under"), ("on", "near"), ()):
        write_detector_card(tmp_path / "deworldsg.json", CheckpointCard(predicates=predicates))
        if predicates == ("on", "under"):
            start(**chosen, perception__detector_path=str(tmp_path))
            continue
        message = "trained on others" if predicates else "names no predicates"
        with pytest.raises(ConfigurationError, match=message):
            start(**chosen, perception__detector_path=str(tmp_path))
    start(**chosen, perception__detector_path="somebody/elsewhere")
    with pytest.raises(ConfigurationError, match="trained on others"):
        start(perception__predicate_set="3dssg")

"""relation_node: predictions of the world model, and the pairs that it encodes."""

from contextlib import nullcontext

import pytest
from msgspec.structs import replace
from std_msgs.msg import String
from support.nodes_bench import PAIRING, Bench, alone, send_pair
from support.reference_updates import diff
from support.view import make_graph, make_node

from deworldsg_ros.checkpoints.cards import CheckpointCard, write_detector_card
from deworldsg_ros.nodes.relation_node import RelationNode
from deworldsg_ros.relations.world_model import FakeWorldModel
from deworldsg_ros.ros import models
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.wire import messages as wire

WORLD_MODEL = {"relations.world_model": "fake", "relations.clip_length": 4}


def clips_are(at: Bench, **expected: int) -> None:
    def reached() -> bool:
        values = at.node.more_values()
        return all(
            values.get(f"clips {name.replace('__', ' ')}", "0") == str(count)
            for name, count in expected.items()
        )

    at.expect(reached, f"clips {expected}, not {at.node.more_values()}")


def test_predictions_follow_the_pairs_of_a_frame():
    with Bench(RelationNode, PAIRING, parameters=WORLD_MODEL) as at:
        texts = at.peer.collect("deworldsg/relation_evidence")
        at.peer.spin_for(0.5)
        for _ in range(3):
            send_pair(at)
        at.expect(lambda: len(texts) >= 6, "three times the pairs, three times a prediction")
        messages = [wire.decode(text, wire.RelationEvidenceMessage) for text in texts]
        assert {(message.source, message.frame_id) for message in messages} == {("fake", "map")}
        predicted = [bool(pair.prediction) for message in messages for pair in message.pairs]
        assert sorted(predicted) == [False] * 6 + [True] * 6
        clips_are(at, encoded=3)


def test_the_published_graph_selects_the_pairs_of_the_world_model():
    """Lost updates and a restarted graph_node, too."""
    topics = {**PAIRING, "/scene_graph/updates": String, "/scene_graph": String}
    latched = reliable(50, latched=True)
    with Bench(RelationNode, topics, latched, parameters=WORLD_MODEL) as at:

        def publish(sequence: int, stamp_ns: int, observations: int) -> None:
            stamp, labels = wire.stamp_from_ns(stamp_ns), ("chair", "cup")
            nodes = [make_node(i, labels[i - 1], observations=observations) for i in (1, 2)]
            graph = replace(make_graph(nodes), stamp=stamp, sequence=sequence)
            before = replace(graph, sequence=sequence - 1, nodes=[])
            update = diff(before, graph, associations=[wire.Association(stamp, [1, 2])])
            at.send(**{"/scene_graph/updates": update, "/scene_graph": graph})

        stamp_ns = send_pair(at)
        clips_are(at, encoded=1)  # without a graph, every pair is encoded
        publish(1, stamp_ns, 3)
        at.expect(lambda: at.node._graph.newest_ns == stamp_ns, "the update to come")
        stamp_ns = send_pair(at)
        clips_are(at, encoded=1, waiting=1)  # until the graph is updated
        publish(2, stamp_ns, 4)
        clips_are(at, encoded=2, waiting=0)
        publish(3, send_pair(at), 5)
        clips_are(at, encoded=2, dropped__already_encoded=1)
        publish(7, send_pair(at), 8)  # lost updates, and twice the observations
        clips_are(at, encoded=3, waiting=0)
        publish(1, send_pair(at), 3)  # another graph
        clips_are(at, encoded=4, waiting=0)
        assert "internal_error" not in at.node.health.drops


def test_a_restarted_recording_is_encoded_again():
    with Bench(RelationNode, PAIRING, parameters=WORLD_MODEL) as at:
        at.peer.spin_for(0.5)
        started_ns = at.stamp_ns
        for count in range(1, 13):  # more than the buffer of eight holds
            send_pair(at)
            clips_are(at, encoded=count)
        at.stamp_ns = started_ns - 5 * 10**9
        # A clock that jumps back is believed when the next message confirms it.
        send_pair(at)
        send_pair(at)
        clips_are(at, encoded=14, dropped__no_frame=0)


class Bound(FakeWorldModel):
    """A world model with fixed predicates, like one with a probe."""

    def require_predicates(self, predicates: tuple[str, ...]) -> None:
        if predicates != ("on", "under"):
            raise ConfigurationError(f"the probe was trained on others than {predicates}")


@pytest.mark.parametrize(
    ("predicates", "parameters", "refused"),
    [
        (("on", "under"), {}, None),
        (("on", "near"), {}, "trained on others"),
        ((), {}, "names no predicates"),
        (("on", "near"), {"perception.detector_path": "somebody/elsewhere"}, None),
        (("on", "under"), {"perception.predicate_set": "3dssg"}, "trained on others"),
    ],
)
def test_predicates_of_an_imported_checkpoint_are_known(
    tmp_path, monkeypatch, predicates, parameters, refused
):
    """The relation node runs no perception, and may run where its checkpoint is not."""
    monkeypatch.setattr(models, "build_world_model", lambda config, device: Bound(4))
    write_detector_card(tmp_path / "deworldsg.json", CheckpointCard(predicates=predicates))
    chosen = {
        "perception.predicate_set": "checkpoint",
        "perception.detector_path": str(tmp_path),
        **WORLD_MODEL,
        **parameters,
    }
    check = pytest.raises(ConfigurationError, match=refused) if refused else nullcontext()
    with check, alone(RelationNode, chosen):
        pass

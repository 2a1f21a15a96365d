"""The messages of all topics, and graphs that get hostile but well-formed local graphs."""

import hashlib
import json
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import jsonschema
import msgspec
import numpy as np
from support.hostile import (
    STEPS_NS,
    VOCABULARY,
    check_published,
    hostile_evidence,
    hostile_local_graph,
    hostile_scene_graph,
    state_of,
)

from deworldsg_ros.client import ClientError, SceneGraph
from deworldsg_ros.client.export import FORMATS
from deworldsg_ros.client.questions import ask
from deworldsg_ros.config import Config, MergingConfig, RelationsConfig
from deworldsg_ros.fleet.fleet import Fleet
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.perception.source import DetectionSource
from deworldsg_ros.relations.clips import PublishedGraph
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import FrameGraph, LocalGraph, RelationEvidence
from deworldsg_ros.streams.detections import sent_detections
from deworldsg_ros.view import picture
from deworldsg_ros.view.colours import view_axes
from deworldsg_ros.view.live.state import LiveState, PageView
from deworldsg_ros.view.markers import markers
from deworldsg_ros.view.page import content_of
from deworldsg_ros.wire import codec
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import GraphReplica
from fuzz.target import Target

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = {
    "paper": Config(
        merging=MergingConfig(association="paper"),
        relations=RelationsConfig(edge_belief="paper", world_model="none"),
    ),
    "default": Config(),
}
FRAMES = 6
EXPORTS = ("graphml", "csv", "ply")


def _example(name: str) -> bytes:
    return (ROOT / "msg_schemas" / f"{name}.example.json").read_bytes()


SNAPSHOT = SceneGraph(wire.decode(_example("scene_graph"), wire.SceneGraphMessage))


def _message(name: str, use: Callable[[Any], object]) -> Target:
    """A kind of message. What `wire.decode` accepts has to fit the committed schema."""
    schema = json.loads((ROOT / "msg_schemas" / f"{name}.schema.json").read_text())
    validator = jsonschema.Draft202012Validator(schema)

    def read(path: Path) -> None:
        message = wire.decode(path.read_bytes(), wire.MESSAGES[name])
        validator.validate(json.loads(wire.encode(message)))
        use(message)

    write = partial(Path.write_bytes, data=_example(name))
    return Target(f"wire_{name}", write, read, "message.json", weight=6)


def _check_objects(graph: FrameGraph | LocalGraph) -> None:
    rows, boxes = graph.class_probabilities, graph.boxes_xyxy
    assert (rows >= 0).all() and np.allclose(rows.sum(axis=1), 1.0, atol=1e-4)
    assert (boxes[:, :2] <= boxes[:, 2:]).all()


def _use_detections(message: wire.DetectionsMessage) -> None:
    sent = sent_detections(message, 640, 480)
    source = DetectionSource()
    for _ in range(2):  # the second time, it compares
        found = source.take(sent, 0.0)
        assert len(found) <= len(sent) and len(found.classes or ()) >= 1
        sums = found.class_probabilities.sum(axis=1)
        assert (found.class_probabilities >= 0).all() and np.allclose(sums, 1.0)
        for mask in found.masks or ():
            height, width = mask.pixels.shape
            assert mask.top + height <= 480 and mask.left + width <= 640


def _use_frame_graph(message: wire.FrameGraphMessage) -> None:
    graph: FrameGraph = codec.frame_graph_from_message(message)
    _check_objects(graph)
    assert codec.frame_graph_to_message(graph) is not None


def _use_local_graph(message: wire.LocalGraphMessage) -> None:
    local: LocalGraph = codec.local_graph_from_message(message)
    _check_objects(local)
    assert len(set(local.instance_ids.tolist())) == len(local)
    assert local.pixel_counts.min(initial=1) >= 1
    rotation = local.T_world_camera[:3, :3]
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-2)
    for covariance in local.covariances_world:
        np.linalg.cholesky(covariance)
    assert (local.relations.pairs[:, 0] != local.relations.pairs[:, 1]).all()
    for config in CONFIGS.values():
        builder = GraphBuilder(config, local.vocabulary, local.frame_id)
        builder.integrate(local)
        check_published(builder, GraphReplica())


def _use_evidence(message: wire.RelationEvidenceMessage) -> None:
    evidence: RelationEvidence = codec.evidence_from_message(message)
    assert (evidence.pair_classes < len(evidence.vocabulary.classes)).all()
    assert (evidence.pairs[:, 0] != evidence.pairs[:, 1]).all()
    predictions = evidence.predictions[evidence.predicted]
    assert np.allclose(predictions.sum(axis=1), 1.0, atol=1e-2)
    builder = GraphBuilder(CONFIGS["default"], evidence.vocabulary, "map")
    classes = np.full(len(evidence.vocabulary.classes), 1.0)
    ids = [builder.graph.add_node(np.full(3, place), np.eye(3), classes, 1) for place in range(3)]
    builder.graph.remember_frame(evidence.stamp_ns, ids)
    builder.add_evidence(evidence)
    check_published(builder, GraphReplica())


def _use_snapshot(message: wire.SceneGraphMessage) -> None:
    replica, published = GraphReplica(), PublishedGraph()
    replica.reset(message)
    published.reset(message)
    for node in message.nodes:
        published.node(node.id)
    wire.encode(replica.message())
    for item in SceneGraph(message):
        item.to_dict()


def _ask_as_a_client(graph: SceneGraph) -> None:
    """Questions are answered, or refused in words."""
    for item in list(graph)[:2]:
        for method in (graph.goal_near, graph.explain, graph.neighbours):
            with suppress(ClientError):
                method(item)
        with suppress(ClientError):
            ask(graph, f"anything near {item.label}")
    graph.changes_since(SNAPSHOT)


def _combine(message: wire.SceneGraphMessage) -> None:
    """A fleet goes on whatever one of its robots sends."""
    fleet = Fleet()
    fleet.update("good", SNAPSHOT.message)
    fleet.combine()
    fleet.update("other", message)
    whole = fleet.combine()
    assert {node.label for node in SNAPSHOT} <= {node.label for node in whole.nodes}
    for part in (whole, *map(fleet.part_for, fleet.members)):
        if part is not None:
            wire.decode(wire.encode(part), wire.SceneGraphMessage)


def _use_update(message: wire.SceneGraphUpdateMessage) -> None:
    replica, published = GraphReplica(), PublishedGraph()
    published.apply(message)
    for association in message.associations:
        published.nodes_of_frame(wire.ns_from_stamp(association.stamp))
    # A new replica refuses any but the first update of a session.
    replica.apply(msgspec.structs.replace(message, sequence=1))
    wire.encode(replica.message())


def _seeded(name: str, use: Callable[[np.random.Generator, Path], object]) -> Target:
    """Something that gets random numbers; the content of the file is their seed."""

    def read(path: Path) -> None:
        digest = hashlib.sha256(path.read_bytes()).digest()
        use(np.random.default_rng(int.from_bytes(digest[:8], "little")), path.parent)

    return Target(name, partial(Path.write_bytes, data=b"hostile"), read, "seed")


def _use_hostile_frames(config: Config, rng: np.random.Generator, _: Path) -> None:
    builder, replica = GraphBuilder(config, VOCABULARY, "map"), GraphReplica()
    stamp_ns = 0
    for _ in range(FRAMES):
        stamp_ns = abs(stamp_ns + int(rng.choice([*STEPS_NS, -(10**9), -(10**12)])))
        stamp_ns = min(stamp_ns, 2**31 * 10**9 - 1)
        local = hostile_local_graph(rng, stamp_ns)
        before = state_of(builder)
        try:
            builder.integrate(local)
        except RefusedInput:
            assert state_of(builder) == before, "a refused local graph changed the graph"
            continue
        evidence = hostile_evidence(rng, local)
        while evidence.pairs.max(initial=0) >= max(len(local), 1):  # of pairs that it contains
            evidence = hostile_evidence(rng, local)
        builder.add_evidence(evidence)
        check_published(builder, replica)


def _use_hostile_graph(rng: np.random.Generator, folder: Path) -> None:
    """A graph of the worst allowed values, in everything that shows or writes graphs."""
    message = hostile_scene_graph(rng)
    _use_snapshot(message)
    _ask_as_a_client(SceneGraph(message))
    _combine(message)
    state = LiveState()
    state.reset(message)
    state.news(PageView(), 0.0)
    json.dumps(content_of(message, view_axes((0.0, 0.0, 1.0)), None), allow_nan=False)
    markers(message)
    graph = SceneGraph(message)
    for kind in EXPORTS:
        FORMATS[kind](graph)
    if rng.random() < 0.02:  # a picture takes a second
        picture.draw(message, folder / "graph.png")


TARGETS: list[Target] = [
    _message("detections", _use_detections),
    _message("frame_graph", _use_frame_graph),
    _message("local_graph", _use_local_graph),
    _message("relation_evidence", _use_evidence),
    _message("scene_graph", _use_snapshot),
    _message("scene_graph_updates", _use_update),
    *(
        _seeded(f"graph_{name}", partial(_use_hostile_frames, config))
        for name, config in CONFIGS.items()
    ),
    _seeded("clients", _use_hostile_graph),
]

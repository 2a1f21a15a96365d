"""Messages of a frame: both ways without the loss of a bit, and what is refused."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.merging import (
    VOCABULARY,
    random_classes,
    random_covariances,
    random_local_graphs,
    random_pose,
    seeds,
)

from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import (
    DepthGrid,
    FrameGraph,
    LocalGraph,
    RelationEvidence,
    Relations,
)
from deworldsg_ros.scene.limits import MAX_OBJECTS, MAX_POINTS
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.codec import (
    evidence_from_message,
    evidence_to_message,
    frame_graph_from_message,
    frame_graph_to_message,
    local_graph_from_message,
    local_graph_to_message,
)


def random_relations(rng: np.random.Generator, count: int) -> Relations:
    pairs = [(i, j) for i in range(count) for j in range(count) if i != j and rng.random() < 0.4]
    return Relations(
        np.array(pairs, np.int64).reshape(-1, 2),
        rng.normal(0, 10 ** rng.uniform(-6, 6), (len(pairs), 3)),
        rng.random(len(pairs)),
    )


def random_boxes(rng: np.random.Generator, count: int) -> np.ndarray:
    return np.sort(rng.uniform(0, 480, (count, 2, 2)), axis=1).reshape(count, 4)


def random_frame_graph(rng: np.random.Generator) -> FrameGraph:
    count = int(rng.integers(0, 5))
    return FrameGraph(
        stamp_ns=int(rng.integers(0, 2**31 * 10**9 - 1)),
        frame_id="camera",
        width=640,
        height=480,
        vocabulary=VOCABULARY,
        boxes_xyxy=random_boxes(rng, count),
        class_probabilities=random_classes(rng, count),
        scores=rng.random(count),
        relations=random_relations(rng, count),
    )


def random_depth_grid(rng: np.random.Generator) -> DepthGrid | None:
    stride_px = int(rng.integers(0, 100))
    if stride_px == 0:
        return None
    shape = [len(range(stride_px // 2, size, stride_px)) for size in (480, 640)]
    depth_mm = rng.integers(0, 2**16, shape).astype(np.uint16)
    instances = rng.integers(0, 5, shape).astype(np.uint16) if rng.random() < 0.5 else None
    intrinsics = Intrinsics(*rng.uniform(1, 900, 4).tolist(), 640, 480)
    return DepthGrid(depth_mm, stride_px, intrinsics, instances)


def random_local_graph(rng: np.random.Generator) -> LocalGraph:
    count = int(rng.integers(0, 5))
    return LocalGraph(
        stamp_ns=int(rng.integers(0, 2**31 * 10**9 - 1)),
        frame_id="map",
        width=640,
        height=480,
        T_world_camera=random_pose(rng),
        vocabulary=VOCABULARY,
        instance_ids=rng.permutation(np.arange(1, count + 1)),
        boxes_xyxy=random_boxes(rng, count),
        class_probabilities=random_classes(rng, count),
        scores=rng.random(count),
        means_world=rng.normal(0, 10 ** rng.uniform(-9, 3), (count, 3)),
        covariances_world=random_covariances(rng, count),
        depths_m=rng.random(count),
        pixel_counts=rng.integers(10, 10**6, count),
        surface_points_world=tuple(
            rng.normal(size=(rng.integers(0, 4), 3)).astype(np.float32) for _ in range(count)
        ),
        relations=random_relations(rng, count),
        drops={"too_few_pixels": 2},
        depth_grid=random_depth_grid(rng),
    )


def random_evidence(rng: np.random.Generator) -> RelationEvidence:
    count = int(rng.integers(0, 5))
    predictions = random_classes(rng, count, 3)
    predictions[rng.random(count) < 0.5] = np.nan
    return RelationEvidence(
        stamp_ns=int(rng.integers(0, 2**31 * 10**9 - 1)),
        vocabulary=VOCABULARY,
        pairs=rng.integers(0, 5, (count, 1)) + [0, 1],
        pair_classes=rng.integers(0, 4, (count, 2)),
        geo_costs=rng.random(count),
        predictions=predictions,
        source="fake",
    )


def assert_same(a: object, b: object) -> None:
    """Equal to the last bit, type by type."""
    assert type(a) is type(b)
    if isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        assert a.shape == b.shape
        assert a.tobytes() == b.tobytes()
    elif isinstance(a, tuple):
        assert len(a) == len(b)
        for one, other in zip(a, b):
            assert_same(one, other)
    elif hasattr(a, "__dataclass_fields__"):
        for item in fields(a):
            assert_same(getattr(a, item.name), getattr(b, item.name))
    else:
        assert a == b


@given(seeds)
def test_frame_graphs_survive_the_wire(seed: int) -> None:
    graph = random_frame_graph(np.random.default_rng(seed))
    text = wire.encode(frame_graph_to_message(graph))
    assert_same(frame_graph_from_message(wire.decode(text, wire.FrameGraphMessage)), graph)


@given(seeds)
def test_local_graphs_survive_the_wire(seed: int) -> None:
    graph = random_local_graph(np.random.default_rng(seed))
    text = wire.encode(local_graph_to_message(graph))
    assert_same(local_graph_from_message(wire.decode(text, wire.LocalGraphMessage)), graph)


@given(seeds)
def test_relation_evidence_survives_the_wire(seed: int) -> None:
    evidence = random_evidence(np.random.default_rng(seed))
    text = wire.encode(evidence_to_message(evidence, "map"))
    message = wire.decode(text, wire.RelationEvidenceMessage)
    assert message.frame_id == "map"
    assert_same(evidence_from_message(message), evidence)


@given(st.integers(0, 2**31 * 10**9 - 1))
def test_stamps_survive(stamp_ns: int) -> None:
    stamp = wire.stamp_from_ns(stamp_ns)
    assert wire.ns_from_stamp(stamp) == stamp_ns
    assert 0 <= stamp.nanosec < 10**9


def local_message() -> wire.LocalGraphMessage:
    local = next(
        graph
        for graph in random_local_graphs(np.random.default_rng(3), 20)
        if len(graph) > 1 and len(graph.relations.pairs)
    )
    return local_graph_to_message(local)


def _set(path: str, value: object) -> Callable[[dict], None]:
    """Set a value deep in a message, e.g. `objects.0.mean_m`."""

    def change(content: dict) -> None:
        *parents, last = [int(key) if key.isdigit() else key for key in path.split(".")]
        for key in parents:
            content = content[key]
        content[last] = value

    return change


def _base64(*numbers: float) -> str:
    """The numbers as float32."""
    return base64.b64encode(np.array(numbers, "<f4").tobytes()).decode()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (_set("objects.0.mean_m", [0.0, 1.0]), "invalid_message"),
        (_set("objects.0.mean_m", [0.0, 1.0, None]), "invalid_message"),
        (_set("objects.0.covariance_m2", [0.0] * 9), "invalid_message"),
        (_set("objects.0.covariance_m2", [1, 0.5, 0, 0, 1, 0, 0, 0, 1.0]), "invalid_message"),
        (_set("objects.0.class_probabilities", [1.0]), "invalid_message"),
        (_set("objects.0.class_probabilities", [1.0, 1.0, 0.0, 0.0]), "invalid_message"),
        (_set("relations.0.object", 99), "invalid_message"),
        (_set("relations.0.logits", [1.0]), "invalid_message"),
        (_set("relations.0.score", 2.0), "invalid_message"),
        (_set("stamp.nanosec", 10**9), "invalid_message"),
        (_set("stamp.sec", -1), "invalid_message"),
        (_set("objects.0.score", 1.5), "invalid_message"),
        (_set("objects.0.score", -0.1), "invalid_message"),
        (_set("objects.0.class_probabilities", [2.0, -1.0, 0.0, 0.0]), "invalid_message"),
        (_set("objects.0.box_xyxy", [9.0, 0.0, 1.0, 1.0]), "invalid_message"),
        (_set("objects.0.box_xyxy", [0.0, 9.0, 1.0, 1.0]), "invalid_message"),
        (_set("objects.0.box_xyxy", [0.0, 0.0, 1e300, 1.0]), "invalid_message"),
        (_set("objects.0.instance", 0), "invalid_message"),
        (_set("objects.0.instance", 2**16), "invalid_message"),
        (_set("objects.0.pixel_count", 0), "invalid_message"),
        (_set("objects.0.pixel_count", 10**40), "invalid_message"),
        (_set("objects.0.depth_m", -1.0), "invalid_message"),
        (_set("objects.0.mean_m", [0.0, 1.0, 1e300]), "invalid_message"),
        (_set("objects.0.surface_points_m", [[0.0, 1.0, 1e39]]), "invalid_message"),
        (_set("objects.0.surface", _base64(0.0, 1.0, np.nan)), "invalid_message"),
        (_set("objects.0.surface", _base64(0.0, 1.0, 1e38)), "invalid_message"),
        (_set("objects.0.surface", _base64(0.0, 1.0)), "invalid_message"),
        (_set("objects.0.surface", "AAAAAAAAAAAAAAA="), "invalid_message"),
        (_set("objects.0.surface", _base64(*[0.0] * 3 * (MAX_POINTS + 1))), "invalid_message"),
        (_set("objects.0.covariance_m2", [1e300, 0, 0, 0, 1, 0, 0, 0, 1.0]), "invalid_message"),
        (_set("objects.0.covariance_m2", [1.0, 0, 0, 0, 1, 0, 0, 0, 1e-300]), "invalid_message"),
        (_set("objects.0.covariance_m2", [1.0, 1, 0, 1, 1, 0, 0, 0, 1.0]), "invalid_message"),
        (_set("relations.0.logits", [1e308, 0.0, 0.0]), "invalid_message"),
        (_set("relations.0.object", -1), "invalid_message"),
        (_set("width", 10**40), "invalid_message"),
        (_set("height", 0), "invalid_message"),
        (_set("T_world_camera", [2.0, *np.eye(4).ravel().tolist()[1:]]), "invalid_message"),
        (_set("T_world_camera", (-np.eye(4)).ravel().tolist()), "invalid_message"),
        (_set("T_world_camera", np.diag([1.0, 1, 1, 2]).ravel().tolist()), "invalid_message"),
        (
            _set("T_world_camera", [*np.eye(4)[0, :3], 1e300, *np.eye(4).ravel()[4:]]),
            "invalid_message",
        ),
        (_set("classes", ["cup", "table", "chair", "bo\x1bok"]), "invalid_message"),
        (_set("classes", []), "invalid_message"),
        (_set("frame_id", "map\n[ERROR] forged"), "invalid_frame_id"),
        (_set("frame_id", "m" * 1000), "invalid_message"),
        (_set("drops", {"few": -1}), "invalid_message"),
        (_set("T_world_camera", [0.0] * 15), "invalid_message"),
        (_set("classes", "cup"), "invalid_message"),
        (_set("schema.name", "scene_graph"), "unknown_schema"),
        (_set("schema.version", 3), "unknown_schema"),
    ],
)
def test_inconsistent_messages_are_refused(change: Callable[[dict], None], reason: str) -> None:
    content = json.loads(wire.encode(local_message()))
    change(content)
    with pytest.raises(RefusedInput) as refused:
        local_graph_from_message(wire.decode(json.dumps(content), wire.LocalGraphMessage))
    assert refused.value.reason == reason


def test_a_local_graph_of_version_1_is_read() -> None:
    message = local_message()
    expected = local_graph_from_message(message)
    content = json.loads(wire.encode(message))
    content["schema"]["version"] = 1
    for item, points in zip(content["objects"], expected.surface_points_world):
        del item["surface"]
        item["surface_points_m"] = points.tolist()
    assert any(len(points) for points in expected.surface_points_world)
    read = wire.decode(json.dumps(content), wire.LocalGraphMessage)
    assert_same(local_graph_from_message(read), expected)


def test_points_of_another_version_are_refused() -> None:
    content = json.loads(wire.encode(local_message()))
    content["schema"]["version"] = 1
    assert refused_reason(content) == "invalid_message"
    content["schema"]["version"] = 2
    content["objects"][0]["surface_points_m"] = [[0.0, 1.0, 2.0]]
    assert refused_reason(content) == "invalid_message"


def refused_reason(content: dict) -> str:
    """The reason for which a local graph with this content is refused."""
    with pytest.raises(RefusedInput) as refused:
        local_graph_from_message(wire.decode(json.dumps(content), wire.LocalGraphMessage))
    return refused.value.reason


def test_an_object_is_named_once() -> None:
    content = json.loads(wire.encode(local_message()))
    content["objects"][1]["instance"] = content["objects"][0]["instance"]
    assert refused_reason(content) == "invalid_message"


def test_an_object_has_no_relation_to_itself() -> None:
    content = json.loads(wire.encode(local_message()))
    content["relations"][0]["object"] = content["relations"][0]["subject"]
    assert refused_reason(content) == "invalid_message"


def test_the_number_of_objects_has_a_limit() -> None:
    content = json.loads(wire.encode(local_message()))
    content["relations"] = []
    one = content["objects"][0]
    content["objects"] = [{**one, "instance": row + 1} for row in range(MAX_OBJECTS)]
    local_graph_from_message(wire.decode(json.dumps(content), wire.LocalGraphMessage))
    content["objects"].append({**one, "instance": MAX_OBJECTS + 1})
    assert refused_reason(content) == "invalid_message"


@pytest.mark.parametrize("kind", list(wire.MESSAGES.values()))
def test_a_message_that_is_too_long_is_not_read(kind: type[wire.Message]) -> None:
    with pytest.raises(RefusedInput) as refused:
        wire.decode(b" " * (wire.max_bytes(kind) + 1), kind)
    assert refused.value.reason == "message_too_large"


@pytest.mark.parametrize(
    "text",
    [
        '{"more": ' + "[" * 10**5 + "]" * 10**5 + "}",
        '{"more": ' + '{"a":' * 10**5 + "1" + "}" * 10**5 + "}",
        "[" * 10**6,
        b'{"frame_id": "\xff"}',
        '{"frame_id": "\ud800"}',
        '{"frame_id": "\\ud800"}',
        '{"stamp": {"sec": 1e400, "nanosec": 0}}',
        '{"stamp": {"sec": 1%s, "nanosec": 0}}' % ("0" * 5000),
    ],
    ids=lambda text: repr(text[:24]),
)
def test_hostile_text_is_refused(text: str | bytes) -> None:
    with pytest.raises(RefusedInput) as refused:
        wire.decode(text, wire.LocalGraphMessage)
    assert refused.value.reason == "invalid_message"


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (_set("pairs.0.object", 0), "invalid_message"),
        (_set("pairs.0.subject_class", 4), "invalid_message"),
        (_set("pairs.0.subject_class", 10**40), "invalid_message"),
        (_set("pairs.0.geo_cost", -1.0), "invalid_message"),
        (_set("pairs.0.prediction", [2.0, -1.0, 0.0]), "invalid_message"),
        (_set("pairs.0.prediction", [1.0]), "invalid_message"),
        (_set("pairs.0.prediction", [0.9, 0.9, 0.0]), "invalid_prediction"),
    ],
)
def test_evidence_that_the_schema_excludes_is_refused(
    change: Callable[[dict], None], reason: str
) -> None:
    evidence = RelationEvidence(
        stamp_ns=1,
        vocabulary=VOCABULARY,
        pairs=np.array([[0, 1]]),
        pair_classes=np.array([[0, 1]]),
        geo_costs=np.array([0.1]),
        predictions=np.array([[0.5, 0.5, 0.0]]),
        source="fake",
    )
    content = json.loads(wire.encode(evidence_to_message(evidence, "map")))
    change(content)
    with pytest.raises(RefusedInput) as refused:
        evidence_from_message(wire.decode(json.dumps(content), wire.RelationEvidenceMessage))
    assert refused.value.reason == reason


def test_the_table_of_predictions_has_a_limit() -> None:
    names = [f"p{index}" for index in range(8000)]
    pair = {"subject": 0, "object": 1, "subject_class": 0, "object_class": 0, "geo_cost": 0.0}
    message = {
        "schema": {"name": "relation_evidence"},
        "stamp": {"sec": 1, "nanosec": 0},
        "frame_id": "map",
        "classes": ["cup"],
        "predicates": names,
        "source": "fake",
        "pairs": [pair] * 65_280,
    }
    text = json.dumps(message)
    assert len(text) < wire.max_bytes(wire.RelationEvidenceMessage)
    with pytest.raises(RefusedInput, match="expected at most 4194304 predictions"):
        evidence_from_message(wire.decode(text, wire.RelationEvidenceMessage))


@pytest.mark.parametrize("name", ["scene_graph", "scene_graph_updates"])
@pytest.mark.parametrize(
    ("change", "says"),
    [
        (_set("nodes.0.mean_m", [1e9, 0, 0]), "nodes[0].mean_m"),
        (_set("nodes.0.covariance_m2", [1e308] * 9), "nodes[0].covariance_m2"),
        (_set("nodes.0.box.center_m", [0, 0, -1e9]), "nodes[0].box.center_m"),
        (_set("nodes.0.box.size_m", [1, 1, -1]), "nodes[0].box.size_m"),
        (_set("nodes.0.box.orientation_xyzw", [0, 0, 0, 0]), "orientation of node 1"),
        (_set("nodes.0.box.orientation_xyzw", [0, 0, 0, 1e308]), "orientation_xyzw"),
        (_set("nodes.0.surface_points_m", [[1e9, 0, 0]]), "surface_points_m"),
        (_set("nodes.0.label", "x" * 257), "nodes[0].label"),
        (_set("nodes.0.label", "cup\x1b[2J"), "control character"),
        (_set("nodes.0.classes.0.label", "cup\n"), "control character"),
        (_set("edges.0.predicate", "on\x07"), "control character"),
        (_set("edges.0.object", 1), "node 1 with itself"),
        (_set("up", [0, 0, 0]), "up is [0.0, 0.0, 0.0]"),
        (_set("up", [0, 0, 1e300]), ".up"),
        (lambda content: content["nodes"].append(content["nodes"][0]), "node 1 is there twice"),
        (lambda content: content["edges"].append(content["edges"][0]), "is there twice"),
    ],
)
def test_graphs_with_impossible_content_are_refused(
    root_dir: Path, name: str, change: Callable[[dict], None], says: str
) -> None:
    content = json.loads((root_dir / "msg_schemas" / f"{name}.example.json").read_text())
    kind = wire.MESSAGES[name]
    wire.decode(json.dumps(content), kind)
    change(content)
    with pytest.raises(RefusedInput) as refused:
        wire.decode(json.dumps(content), kind)
    assert refused.value.reason == "invalid_message"
    assert says in str(refused.value)


@pytest.mark.parametrize("text", ["", "{}", "[]", "null", '{"schema": 3}', "\x00"])
@pytest.mark.parametrize("kind", list(wire.MESSAGES.values()))
def test_text_that_is_no_message_is_refused(text: str, kind: type[wire.Message]) -> None:
    with pytest.raises(RefusedInput) as refused:
        wire.decode(text, kind)
    assert refused.value.reason == "invalid_message"
    assert kind.__name__ in str(refused.value)


def test_errors_name_the_field_and_its_row() -> None:
    rng = np.random.default_rng(5)
    graph = next(g for g in (random_frame_graph(rng) for _ in range(50)) if len(g) > 1)
    message = frame_graph_to_message(graph)
    message.objects[1].class_probabilities.pop()
    with pytest.raises(RefusedInput, match="row 1 have 3 values: expected 4"):
        frame_graph_from_message(message)
    evidence = next(e for e in (random_evidence(rng) for _ in range(50)) if len(e.pairs))
    told = evidence_to_message(evidence, "map")
    told.pairs[0].prediction = [1.0]
    with pytest.raises(RefusedInput, match="prediction of row 0 have 1 values: expected 3"):
        evidence_from_message(told)


def test_times_are_never_one_number() -> None:
    content = msgspec.json.decode(wire.encode(local_message()))
    assert set(content["stamp"]) == {"sec", "nanosec"}
    assert content["schema"] == {"name": "local_graph", "version": 2}

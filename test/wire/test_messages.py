"""Messages: both ways without the loss of a bit, as msg_schemas/ says; and what is refused."""

import base64
import importlib.util
import json
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.merging import (
    VOCABULARY,
    random_classes,
    random_colours,
    random_covariances,
    random_embeddings,
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
from deworldsg_ros.wire import codec
from deworldsg_ros.wire import messages as wire

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "msg_schemas"
NAMES = sorted(wire.MESSAGES)
# From messages to the nouns of the package, and back.
READERS: dict[str, Callable[[Any], Any]] = {
    "frame_graph": codec.frame_graph_from_message,
    "local_graph": codec.local_graph_from_message,
    "relation_evidence": codec.evidence_from_message,
}
WRITERS: dict[str, Callable[[Any], Any]] = {
    "frame_graph": codec.frame_graph_to_message,
    "local_graph": codec.local_graph_to_message,
    "relation_evidence": lambda evidence: codec.evidence_to_message(evidence, "map"),
}


def read(name: str, content: Any) -> Any:
    """What a message says, from its content or its text."""
    text = content if isinstance(content, (str, bytes)) else json.dumps(content)
    message = wire.decode(text, wire.MESSAGES[name])
    return READERS[name](message) if name in READERS else message


def refused(name: str, content: Any) -> tuple[str, str]:
    """The reason for which it is refused, and the words."""
    with pytest.raises(RefusedInput) as refusal:
        read(name, content)
    return refusal.value.reason, str(refusal.value)


# --- round trips ---------------------------------------------------------------------------------


def random_objects(rng: np.random.Generator, count: int) -> dict[str, Any]:
    """What frame graphs and local graphs have in common."""
    pairs = [(i, j) for i in range(count) for j in range(count) if i != j and rng.random() < 0.4]
    return {
        "stamp_ns": int(rng.integers(0, 2**31 * 10**9 - 1)),
        "width": 640,
        "height": 480,
        "vocabulary": VOCABULARY,
        "boxes_xyxy": np.sort(rng.uniform(0, 480, (count, 2, 2)), axis=1).reshape(count, 4),
        "class_probabilities": random_classes(rng, count),
        "scores": rng.random(count),
        "relations": Relations(
            np.array(pairs, np.int64).reshape(-1, 2),
            rng.normal(0, 10 ** rng.uniform(-6, 6), (len(pairs), 3)),
            rng.random(len(pairs)),
        ),
        "colours_lab": random_colours(rng.integers(0, 9, count), int(rng.integers(1000))),
        "embeddings": random_embeddings(count, int(rng.integers(1000))),
    }


def random_frame_graph(rng: np.random.Generator) -> FrameGraph:
    return FrameGraph(frame_id="camera", **random_objects(rng, int(rng.integers(0, 5))))


def random_depth_grid(rng: np.random.Generator) -> DepthGrid | None:
    stride_px = int(rng.integers(0, 100))
    if stride_px == 0:
        return None
    shape = [len(range(stride_px // 2, size, stride_px)) for size in (480, 640)]
    depth_mm = rng.integers(0, 2**16, shape).astype(np.uint16)
    instances = rng.integers(0, 5, shape).astype(np.uint16) if rng.random() < 0.5 else None
    intrinsics = Intrinsics(*rng.uniform(1, 900, 4).tolist(), 640, 480)
    rgb = rng.integers(0, 256, (*shape, 3)).astype(np.uint8) if rng.random() < 0.5 else None
    return DepthGrid(depth_mm, stride_px, intrinsics, instances, rgb)


def random_local_graph(rng: np.random.Generator) -> LocalGraph:
    count = int(rng.integers(0, 5))
    return LocalGraph(
        frame_id="map",
        T_world_camera=random_pose(rng),
        instance_ids=rng.permutation(np.arange(1, count + 1)),
        means_world=rng.normal(0, 10 ** rng.uniform(-9, 3), (count, 3)),
        covariances_world=random_covariances(rng, count),
        depths_m=rng.random(count),
        pixel_counts=rng.integers(10, 10**6, count),
        surface_points_world=tuple(
            rng.normal(size=(rng.integers(0, 4), 3)).astype(np.float32) for _ in range(count)
        ),
        drops={"too_few_pixels": 2},
        depth_grid=random_depth_grid(rng),
        **random_objects(rng, count),
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
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
    elif isinstance(a, tuple):
        assert len(a) == len(b)
        for one, other in zip(a, b):
            assert_same(one, other)
    elif hasattr(a, "__dataclass_fields__"):
        for item in fields(a):
            assert_same(getattr(a, item.name), getattr(b, item.name))
    else:
        assert a == b


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("frame_graph", random_frame_graph),
        ("local_graph", random_local_graph),
        ("relation_evidence", random_evidence),
    ],
)
@given(seed=seeds)
def test_what_a_frame_says_survives_the_wire(name: str, make, seed: int) -> None:
    noun = make(np.random.default_rng(seed))
    assert_same(read(name, wire.encode(WRITERS[name](noun))), noun)


@given(st.integers(0, 2**31 * 10**9 - 1))
def test_stamps_survive(stamp_ns: int) -> None:
    stamp = wire.stamp_from_ns(stamp_ns)
    assert wire.ns_from_stamp(stamp) == stamp_ns
    assert 0 <= stamp.nanosec < 10**9


# --- schemas and examples ------------------------------------------------------------------------


def example(name: str) -> dict[str, Any]:
    return json.loads((FOLDER / f"{name}.example.json").read_text(encoding="utf-8"))


def validator(name: str) -> jsonschema.Draft202012Validator:
    schema = json.loads((FOLDER / f"{name}.schema.json").read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def test_committed_files_are_the_generated_ones() -> None:
    spec = importlib.util.spec_from_file_location("make_schemas", ROOT / "tools/make_schemas.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    committed = {path.name: path.read_text(encoding="utf-8") for path in FOLDER.glob("*.json")}
    assert committed == module.files(), "run tools/make_schemas.py"
    # No number of 64 bits stands for a time.
    assert not [name for name, text in committed.items() if "stamp_ns" in text]


@pytest.mark.parametrize("name", NAMES)
def test_examples_fit_and_are_read(name: str) -> None:
    content = example(name)
    validator(name).validate(content)
    message = wire.decode(json.dumps(content), wire.MESSAGES[name])
    assert json.loads(wire.encode(message)) == content
    if name in ("frame_graph", "local_graph"):
        again = WRITERS[name](read(name, content))
        assert WRITERS[name](READERS[name](again)) == again and len(again.objects) == 2
    empty = {
        key: [] if isinstance(value, list) and key not in ("classes", "predicates") else value
        for key, value in content.items()
        if key not in ("drops", "up")
    }
    if "T_world_camera" in empty:
        empty["T_world_camera"] = np.eye(4).ravel().tolist()
    validator(name).validate(empty)
    wire.decode(json.dumps(empty), wire.MESSAGES[name])


def test_a_local_graph_of_version_1_is_read() -> None:
    content = example("local_graph")
    expected = read("local_graph", content)
    content["schema"]["version"] = 1
    assert refused("local_graph", content)[0] == "invalid_message"  # points of version 2
    for item, points in zip(content["objects"], expected.surface_points_world):
        del item["surface"]
        item["surface_points_m"] = points.tolist()
    assert_same(read("local_graph", content), expected)
    content["schema"]["version"] = 2
    assert refused("local_graph", content)[0] == "invalid_message"


# --- refusals ------------------------------------------------------------------------------------

DELETED = object()
COUNT_OF_POINTS = 3 * (MAX_POINTS + 1)


def base64_of(*numbers: float) -> str:
    """The numbers as float32."""
    return base64.b64encode(np.array(numbers, "<f4").tobytes()).decode()


def half(*numbers: float) -> str:
    """The numbers as float16."""
    return base64.b64encode(np.array(numbers, "<f2").tobytes()).decode()


def changed(name: str, path: str, value: object) -> dict[str, Any]:
    """An example with a value deep in it, e.g. at `objects.0.mean_m`; DELETED removes it."""
    content: Any = example(name)
    *parents, last = [int(key) if key.isdigit() else key for key in path.split(".")]
    place = content
    for key in parents:
        place = place[key]
    if value is DELETED:
        del place[last]
    elif callable(value):
        value(place[last])
    else:
        place[last] = value
    return content


def twice(rows: list[Any]) -> None:
    rows.append(rows[0])


# What the schema excludes, too: message, path, value.
BY_SCHEMA: list[tuple[str, str, object]] = [
    *((name, "stamp", 12.3) for name in NAMES),
    *((name, "stamp.nanosec", 10**9) for name in NAMES),
    *((name, "stamp.sec", -1) for name in NAMES),
    *((name, "frame_id", None) for name in NAMES),
    *((name, "frame_id", DELETED) for name in NAMES),
    *((name, "schema.name", "something_else") for name in NAMES),
    *((name, "schema.version", wire.schema_of(kind).version + 1)
      for name, kind in wire.MESSAGES.items()),
    *((name, "schema", DELETED) for name in NAMES),
    ("frame_graph", "objects.0.box_xyxy", [1.0, 2.0, 3.0]),
    ("frame_graph", "relations.0.score", 1.5),
    ("frame_graph", "width", -640),
    ("local_graph", "T_world_camera", [1.0] * 12),
    ("frame_graph", "objects.0.colour_lab", [500.0, 0.0, 0.0]),
    ("scene_graph", "nodes.0.colour_lab", [50.0, 0.0]),
    ("embeddings", "nodes.0.vector", 3),
    ("local_graph", "objects.0.instance", 0),
    ("local_graph", "objects.0.instance", 2**16),
    ("local_graph", "objects.0.score", 1.5),
    ("local_graph", "objects.0.pixel_count", 0),
    ("local_graph", "objects.0.depth_m", -1.0),
    ("local_graph", "objects.1.covariance_m2", [1.0] * 6),
    ("local_graph", "objects.0.mean_m.1", "0.1"),
    ("local_graph", "classes", "cup"),
    ("local_graph", "drops.few_mask_pixels", "many"),
    ("local_graph", "drops.few_mask_pixels", -1),
    ("local_graph", "depth_grid.stride_px", 0),
    ("relation_evidence", "pairs.0.geo_cost", None),
    ("relation_evidence", "pairs.0.geo_cost", -1.0),
    ("relation_evidence", "source", DELETED),
    ("scene_graph", "nodes.0.id", 0),
    ("scene_graph", "nodes.0.observations", 0),
    ("scene_graph", "nodes.0.classes.0.probability", -0.1),
    ("scene_graph", "edges.0.provenance", "guess"),
    ("scene_graph", "edges.0.entropy_nats", -1.0),
    ("scene_graph", "sequence", 1.5),
    ("scene_graph_updates", "sequence", 0),
    ("scene_graph_updates", "removed_nodes.0.merged_into", "2"),
]  # fmt: skip
# What no schema can say of a frame's messages; of a frame_id, and of a prediction, with a reason of
# its own.
BY_READER: list[tuple[str, str, object]] = [
    ("local_graph", "objects.0.covariance_m2", [0.0] * 9),
    ("local_graph", "objects.0.covariance_m2", [1, 0.5, 0, 0, 1, 0, 0, 0, 1.0]),
    ("local_graph", "objects.0.covariance_m2", [1.0, 0, 0, 0, 1, 0, 0, 0, 1e-300]),
    ("local_graph", "objects.0.covariance_m2", [1.0, 1, 0, 1, 1, 0, 0, 0, 1.0]),
    ("local_graph", "objects.0.class_probabilities", [1.0]),
    ("local_graph", "objects.0.class_probabilities", [1.0, 1.0, 0.0]),
    ("local_graph", "objects.0.class_probabilities", [2.0, -1.0, 0.0]),
    ("local_graph", "objects.0.box_xyxy", [9.0, 0.0, 1.0, 1.0]),
    ("local_graph", "objects.0.box_xyxy", [0.0, 0.0, 1e300, 1.0]),
    ("local_graph", "objects.0.surface", base64_of(0.0, 1.0, np.nan)),
    ("local_graph", "objects.0.surface", base64_of(0.0, 1.0, 1e38)),
    ("local_graph", "objects.0.surface", base64_of(0.0, 1.0)),
    ("local_graph", "objects.0.surface", "AAAAAAAAAAAAAAA="),
    ("local_graph", "objects.0.surface", base64_of(*[0.0] * COUNT_OF_POINTS)),
    ("local_graph", "objects.1.instance", 1),  # an object is named once
    ("local_graph", "relations.0.object", 0),  # has no relation to itself
    ("local_graph", "relations.0.object", 99),
    ("local_graph", "relations.0.logits", [1.0]),
    ("local_graph", "relations.0.logits", [1e308, 0.0, 0.0]),
    ("local_graph", "width", 10**40),
    ("local_graph", "T_world_camera", [2.0, *np.eye(4).ravel().tolist()[1:]]),
    ("local_graph", "T_world_camera", np.diag([1.0, 1, 1, 2]).ravel().tolist()),
    ("local_graph", "T_world_camera.3", 1e300),
    ("local_graph", "classes", ["cup", "table", "bo\x1bok"]),
    ("local_graph", "objects.0.colour_lab", [-3.0, 0.0, 0.0]),
    ("local_graph", "objects.0.embedding", half(1.0, np.nan, 0.0, 0.0)),
    ("local_graph", "objects.0.embedding", half(3.0, 0.0, 0.0, 0.0)),
    ("local_graph", "objects.0.embedding", half(1.0, 0.0)),  # shorter than the other one
    ("local_graph", "objects.0.embedding", "AAAA"),
    ("local_graph", "embedding_model", DELETED),
    ("frame_graph", "embedding_model", "a\x1b[2J"),
    ("embeddings", "model", "a\x1b[2J"),
    ("embeddings", "nodes", twice),
    ("local_graph", "classes", []),
    ("local_graph", "frame_id", "m" * 1000),
    ("local_graph", "frame_id", "map\n[ERROR] forged"),
    ("relation_evidence", "pairs.0.object", 0),
    ("relation_evidence", "pairs.0.subject_class", 4),
    ("relation_evidence", "pairs.0.prediction", [2.0, -1.0, 0.0]),
    ("relation_evidence", "pairs.0.prediction", [1.0]),
    ("relation_evidence", "pairs.0.prediction", [0.9, 0.9, 0.0]),
]
# Of graphs; the last column is in the words.
OF_GRAPHS: list[tuple[str, object, str]] = [
    ("nodes.0.mean_m", [1e9, 0, 0], "nodes[0].mean_m"),
    ("nodes.0.covariance_m2", [1e308] * 9, "nodes[0].covariance_m2"),
    ("nodes.0.box.center_m", [0, 0, -1e9], "nodes[0].box.center_m"),
    ("nodes.0.box.size_m", [1, 1, -1], "nodes[0].box.size_m"),
    ("nodes.0.box.orientation_xyzw", [0, 0, 0, 0], "node 1"),
    ("nodes.0.box.orientation_xyzw", [0, 0, 0, 1e308], "orientation_xyzw"),
    ("nodes.0.surface_points_m", [[1e9, 0, 0]], "surface_points_m"),
    ("nodes.0.label", "x" * 257, "nodes[0].label"),
    ("nodes.0.label", "cup\x1b[2J", "control character"),
    ("nodes.0.classes.0.label", "cup\n", "control character"),
    ("edges.0.predicate", "on\x07", "control character"),
    ("edges.0.object", 1, "node 1"),
    ("up", [0, 0, 0], "[0.0, 0.0, 0.0]"),
    ("up", [0, 0, 1e300], ".up"),
    ("nodes", twice, "node 1"),
    ("edges", twice, "twice"),
]


@pytest.mark.parametrize(("name", "path", "value"), BY_SCHEMA)
def test_schema_and_reader_refuse_the_same(name: str, path: str, value: object) -> None:
    content = changed(name, path, value)
    assert not validator(name).is_valid(content)
    is_schema = path in ("schema.name", "schema.version")
    assert refused(name, content)[0] == ("unknown_schema" if is_schema else "invalid_message")


@pytest.mark.parametrize(("name", "path", "value"), BY_READER)
def test_what_holds_together_in_no_way_is_refused(name: str, path: str, value: object) -> None:
    own = {"map\n[ERROR] forged": "invalid_frame_id", "[0.9, 0.9, 0.0]": "invalid_prediction"}
    reason = own.get(str(value), "invalid_message")
    assert refused(name, changed(name, path, value))[0] == reason


@pytest.mark.parametrize("name", ["scene_graph", "scene_graph_updates"])
@pytest.mark.parametrize(("path", "value", "says"), OF_GRAPHS)
def test_graphs_of_impossible_content_are_refused(name, path, value, says: str) -> None:
    reason, words = refused(name, changed(name, path, value))
    assert reason == "invalid_message" and says in words


@pytest.mark.parametrize(
    "text",
    [
        "", "{}", "[]", "null", '{"schema": 3}', "\x00",
        '{"more": ' + "[" * 10**5 + "]" * 10**5 + "}",
        '{"more": ' + '{"a":' * 10**5 + "1" + "}" * 10**5 + "}",
        "[" * 10**6,
        b'{"frame_id": "\xff"}', '{"frame_id": "\ud800"}', '{"frame_id": "\\ud800"}',
        '{"stamp": {"sec": 1e400, "nanosec": 0}}',
        '{"stamp": {"sec": 1%s, "nanosec": 0}}' % ("0" * 5000),
    ],
    ids=lambda text: repr(text[:24]),
)  # fmt: skip
def test_text_that_is_no_message_is_refused(text: str | bytes) -> None:
    for name, kind in wire.MESSAGES.items():
        reason, words = refused(name, text)
        assert reason == "invalid_message" and kind.__name__ in words


def test_numbers_of_things_have_limits() -> None:
    for name, kind in wire.MESSAGES.items():
        assert refused(name, b" " * (wire.max_bytes(kind) + 1))[0] == "message_too_large"
    local = example("local_graph") | {"relations": []}
    one = local["objects"][0]
    local["objects"] = [{**one, "instance": row + 1} for row in range(MAX_OBJECTS)]
    read("local_graph", local)
    local["objects"].append({**one, "instance": MAX_OBJECTS + 1})
    assert refused("local_graph", local)[0] == "invalid_message"
    evidence = example("relation_evidence")
    evidence["predicates"] = [f"p{index}" for index in range(8000)]
    evidence["pairs"] = [evidence["pairs"][1]] * 65_280
    text = json.dumps(evidence)
    assert len(text) < wire.max_bytes(wire.RelationEvidenceMessage)
    assert "4194304" in refused("relation_evidence", text)[1]


def test_errors_name_the_field_and_its_row() -> None:
    content = changed("frame_graph", "objects.1.class_probabilities", [1.0])
    assert "row 1 have 1 values: expected 3" in refused("frame_graph", content)[1]
    content = changed("relation_evidence", "pairs.0.prediction", [1.0])
    assert "row 0 have 1 values: expected 3" in refused("relation_evidence", content)[1]

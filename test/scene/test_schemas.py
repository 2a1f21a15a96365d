"""msg_schemas/ is what the typed messages say, and an independent validator agrees."""

from __future__ import annotations

import importlib.util
import json
from copy import deepcopy
from pathlib import Path

import jsonschema
import pytest

from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.wire import codec
from deworldsg_ros.wire import messages as wire

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "msg_schemas"
NAMES = sorted(wire.MESSAGES)


@pytest.fixture(scope="module")
def generated():
    spec = importlib.util.spec_from_file_location("make_schemas", ROOT / "tools/make_schemas.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.files()


def load(name):
    return json.loads((FOLDER / name).read_text(encoding="utf-8"))


def validator(name):
    schema = load(f"{name}.schema.json")
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def test_committed_files_are_the_generated_ones(generated):
    committed = {path.name: path.read_text(encoding="utf-8") for path in FOLDER.glob("*.json")}
    assert committed == generated, "run tools/make_schemas.py"


@pytest.mark.parametrize("name", NAMES)
def test_examples_fit_and_decode(name):
    example = load(f"{name}.example.json")
    validator(name).validate(example)
    message = wire.decode(json.dumps(example), wire.MESSAGES[name])
    assert json.loads(wire.encode(message)) == example


@pytest.mark.parametrize(
    ("name", "to_noun", "to_message"),
    [
        ("frame_graph", codec.frame_graph_from_message, codec.frame_graph_to_message),
        ("local_graph", codec.local_graph_from_message, codec.local_graph_to_message),
    ],
)
def test_examples_are_graphs_that_hold_together(name, to_noun, to_message):
    text = (FOLDER / f"{name}.example.json").read_text(encoding="utf-8")
    message = to_message(to_noun(wire.decode(text, wire.MESSAGES[name])))
    assert to_message(to_noun(message)) == message
    assert len(message.objects) == 2


@pytest.mark.parametrize("name", NAMES)
def test_a_message_without_contents_fits(name):
    empty = {
        key: [] if isinstance(value, list) and key not in ("classes", "predicates") else value
        for key, value in load(f"{name}.example.json").items()
        if key not in ("drops", "up")
    }
    if "T_world_camera" in empty:
        empty["T_world_camera"] = [float(index % 5 == 0) for index in range(16)]
    validator(name).validate(empty)
    wire.decode(json.dumps(empty), wire.MESSAGES[name])


def broken_examples():
    """Paths into an example, what to put there, and in which message; DELETED removes."""
    for name in NAMES:
        yield name, ("stamp",), 12.3
        yield name, ("stamp", "nanosec"), 10**9
        yield name, ("stamp", "sec"), 1_700_000_000_123
        yield name, ("frame_id",), None
        yield name, ("frame_id",), DELETED
        yield name, ("schema", "name"), "something_else"
        yield name, ("schema", "version"), wire.schema_of(wire.MESSAGES[name]).version + 1
        yield name, ("schema",), DELETED
    yield "frame_graph", ("objects", 0, "box_xyxy"), [1.0, 2.0, 3.0]
    yield "frame_graph", ("relations", 0, "score"), 1.5
    yield "frame_graph", ("relations", 0, "subject"), -1
    yield "frame_graph", ("width",), -640
    yield "local_graph", ("T_world_camera",), [1.0] * 12
    yield "local_graph", ("objects", 0, "instance"), 0
    yield "local_graph", ("objects", 1, "covariance_m2"), [1.0] * 6
    yield "local_graph", ("objects", 0, "mean_m", 1), "0.1"
    yield "local_graph", ("drops", "few_mask_pixels"), "many"
    yield "local_graph", ("depth_grid", "stride_px"), 0
    yield "relation_evidence", ("pairs", 0, "geo_cost"), None
    yield "relation_evidence", ("source",), DELETED
    yield "scene_graph", ("nodes", 0, "id"), 0
    yield "scene_graph", ("nodes", 0, "observations"), 0
    yield "scene_graph", ("nodes", 0, "classes", 0, "probability"), -0.1
    yield "scene_graph", ("edges", 0, "provenance"), "guess"
    yield "scene_graph", ("edges", 0, "entropy_nats"), -1.0
    yield "scene_graph", ("sequence",), 1.5
    yield "scene_graph_updates", ("sequence",), 0
    yield "scene_graph_updates", ("removed_nodes", 0, "merged_into"), "2"


DELETED = object()
BROKEN = [pytest.param(*case, id=f"{case[0]}-{'.'.join(map(str, case[1]))}-{index}")
          for index, case in enumerate(broken_examples())]  # fmt: skip


@pytest.mark.parametrize(("name", "path", "value"), BROKEN)
def test_schema_and_reader_refuse_the_same_errors(name, path, value):
    example = deepcopy(load(f"{name}.example.json"))
    place = example
    for key in path[:-1]:
        place = place[key]
    if value is DELETED:
        del place[path[-1]]
    else:
        place[path[-1]] = value
    assert not validator(name).is_valid(example)
    with pytest.raises(RefusedInput) as refusal:
        wire.decode(json.dumps(example), wire.MESSAGES[name])
    assert refusal.value.reason in ("invalid_message", "unknown_schema")


def test_each_reason_of_a_foreign_message():
    text = (FOLDER / "frame_graph.example.json").read_text(encoding="utf-8")
    with pytest.raises(RefusedInput) as refusal:
        wire.decode(text.replace('"frame_graph"', '"local_graph"'), wire.FrameGraphMessage)
    assert refusal.value.reason == "unknown_schema"


def test_no_64_bit_number_stands_for_a_time():
    for name in NAMES:
        text = (FOLDER / f"{name}.schema.json").read_text(encoding="utf-8")
        assert "stamp_ns" not in text

"""All readers by name: files here, messages in `wire_targets`."""

import dataclasses
import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st
from support import evaluation, sequences
from support import recordings as camera
from support.merging import VOCABULARY, random_local_graphs
from support.recordings import pose, stamp_ns
from support.surfaces import CHAIR, CUP, TABLE, frame, slab
from support.view import make_edge, make_graph, make_node

from deworldsg_ros.checkpoints import cards, hub
from deworldsg_ros.cli.configuration import effective_config
from deworldsg_ros.config import Config, MergingConfig, OutputConfig, to_mapping, to_yaml
from deworldsg_ros.evaluation.predictions import ScanPrediction, read_predictions
from deworldsg_ros.graph import graph_files
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.map_file import read_map, write_map
from deworldsg_ros.poses.trajectory import read_trajectory, write_tum
from deworldsg_ros.recordings.folders.annotations import Annotations, read_vertices
from deworldsg_ros.recordings.folders.sequence import read_ground_truth, read_instances
from deworldsg_ros.recordings.recording import open_recording
from deworldsg_ros.recordings.source import TF_MESSAGE
from deworldsg_ros.wire import messages as wire
from fuzz import wire_targets
from fuzz.target import Target

# --- hypothesis: whole documents -------------------------------------------------------------

_TEXT = st.text(max_size=12) | st.sampled_from(["$\\foo$", "__PLOTLY__", "[/foo]", "../x", "\x00"])
_NUMBERS = st.integers() | st.floats() | st.sampled_from([10**40, 2**63, -(2**63) - 1])
_JSON: st.SearchStrategy[Any] = st.recursive(
    st.none() | st.booleans() | _NUMBERS | _TEXT,
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(_TEXT, inner, max_size=5),
    max_leaves=20,
)
JSON_DOCUMENTS = _JSON.map(lambda value: json.dumps(value).encode())
# Sections and options that exist, with any values.
_CONFIGURATIONS = st.fixed_dictionaries(
    {},
    optional={
        section: st.dictionaries(st.sampled_from(sorted(values)) | _TEXT, _JSON, max_size=3)
        for section, values in to_mapping(Config()).items()
    },
)
_PARAMETERS = _CONFIGURATIONS.map(lambda sections: {"/**": {"ros__parameters": sections}})
_OPTIONS = [f"{name}.{field}" for name, fields in to_mapping(Config()).items() for field in fields]
_SETTINGS = st.tuples(st.sampled_from(_OPTIONS), _TEXT | _JSON.map(json.dumps))

# --- maps ------------------------------------------------------------------------------------


def _map_config(association: Any) -> Config:
    merging = MergingConfig(association=association)
    return Config(merging=merging, output=OutputConfig(min_existence=0.0))


def _frames() -> list[Any]:
    table, mug = slab((0, 0.7, 1), (0.4, 0.04, 0.3)), slab((0.1, 0.77, 1), (0.08, 0.1, 0.08))
    chair = slab((0.9, 0.25, 1), (0.3, 0.4, 0.3))
    few = [(points[:150], kind) for points, kind in ((table, TABLE), (mug, CUP), (chair, CHAIR))]
    return [frame(stamp, *few) for stamp in range(1, 7)]


def _write_map(association: str, path: Path) -> None:
    builder = GraphBuilder(_map_config(association), VOCABULARY, "world")
    paper = association == "paper"
    for local in random_local_graphs(np.random.default_rng(3), 20) if paper else _frames():
        builder.integrate(local)
    write_map(builder, path)


def _read_map(association: str, path: Path) -> None:
    """Continue as graph_node does: publish, merge frames, publish, save."""
    builder = read_map(_map_config(association), path)
    builder.update()
    _check_graph(builder.full())
    if builder.graph.vocabulary == VOCABULARY and builder.graph.frame_id == "world":
        newest = int(builder.graph.nodes.last_seen_ns.max(initial=0))
        for local in _frames()[:3]:
            builder.integrate(dataclasses.replace(local, stamp_ns=newest + local.stamp_ns))
        builder.update()
        _check_graph(builder.full())
    again = path.parents[1] / f"{association}.again"
    write_map(builder, again)
    read_map(_map_config(association), again)


def _check_graph(message: wire.SceneGraphMessage) -> None:
    """What every reader of /scene_graph relies on."""
    text = wire.encode(message)
    assert "null" not in text.replace('"null"', ""), "a number is no number"
    wire.decode(text, wire.SceneGraphMessage)
    ids = [node.id for node in message.nodes]
    assert len(set(ids)) == len(ids) and min(ids, default=1) >= 1
    assert {end for edge in message.edges for end in (edge.subject, edge.object)} <= set(ids)


# --- recordings ------------------------------------------------------------------------------


def _read_recording(folder: Path) -> None:
    source = next(path for path in sorted(folder.iterdir()) if path.name != "ReplicaSSG")
    if source.name == "data":
        source = source / "room_0"
    recording = open_recording(source)
    try:
        for item in recording.frames():
            assert np.isfinite(item.T_world_camera).all()
            read_instances(recording.source, item.stamp_ns)
    finally:
        recording.close()
    read_ground_truth(source)


def _write_bag(plugin: str, folder: Path) -> None:
    camera.write_bag(folder / "bag", camera.camera_items(3), plugin)


def _write_bag_with_tf(folder: Path) -> None:
    items = camera.camera_items(3, compressed=False, with_pose=False)
    items = [item for item in items if "color" in item[0] or item[2] == stamp_ns(0)]
    for i in range(3):
        moving = camera.tf(stamp_ns(i), (camera.WORLD, camera.CAMERA, pose(i)))
        items.append(("/tf", TF_MESSAGE, stamp_ns(i), moving))
    camera.write_bag(folder / "bag", sorted(items, key=lambda item: item[2]))


ONE_ROOM = {"room_0": ([("chair", 1)], [])}
SCANS = {"a": ([("chair", 1), ("table", 2)], [(1, 2, "near")]), "b": ([("book", 3)], [])}


def _read_annotations(layout: str, folder: Path) -> None:
    annotations = Annotations(folder, layout)
    annotations.scans("test")
    for scan in ("a", "b"):
        annotations.scan(scan)
        annotations.points(scan)


# --- other files -----------------------------------------------------------------------------


def _read_trajectory(path: Path) -> None:
    found = read_trajectory(path)
    assert len(found) and np.isfinite(found.T_world_cameras).all()
    found.at(stamp_ns(1) + 5, 1, 1, 10**8)


def _read_ply(path: Path) -> None:
    columns = read_vertices(path, ("x", "y", "z", "objectId"))
    assert len({len(column) for column in columns.values()}) == 1


PREDICTION = ScanPrediction(
    (evaluation.segment(1, 3), evaluation.segment(2, 3)),
    np.array([[0.1, 0.8, 0.1], [0.2, 0.2, 0.6]]),
    np.array([[0, 1]]),
    np.array([[0.7, 0.2, 0.1]]),
)


_NODES = [{"id": i, "class_probabilities": [0.1, 0.8, 0.1], "points": [[i, 0, 0]]} for i in (0, 1)]
_EDGES = [{"subject": 0, "object": 1, "predicate_probabilities": [0.7, 0.2, 0.1]}]
OPEN_PREDICTIONS = {
    **{"format": "scene graph predictions 1", "num_classes": 3, "num_predicates": 3},
    "scans": {"a": {"nodes": _NODES, "edges": _EDGES}, "b": {"nodes": [], "edges": []}},
}


def _read_predictions(path: Path) -> None:
    for prediction in read_predictions(path).values():
        assert len(prediction.class_scores) == len(prediction)
        assert len(prediction.edges) == len(prediction.edge_scores)


CARD = cards.CheckpointCard(classes=("cup", "table"), predicates=("on", "near"))
BACKBONE = cards.BackboneIdentity("vjepa2", 48, 32, 4)
PROBE = cards.ProbeCard(BACKBONE, ("on", "near"), training={"groups_by_part": {"train": []}})


def _read_probe_card(folder: Path) -> None:
    found = cards.read_probe_card(folder)
    assert found.seen_groups is not None and found.input_dim > 0
    str(found.backbone)


def _write_headers(path: Path) -> None:
    entry = {"dtype": "F32", "shape": [2, 2], "data_offsets": [0, 16]}
    text = json.dumps({"a": entry, "b": entry}).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + bytes(16))


def _write_graph(folder: Path) -> None:
    nodes = [make_node(1, "cup", points=[(0, 0, 0)]), make_node(2, "table", (0.3, 0, 0))]
    graph_files.write_graph(folder, make_graph(nodes, [make_edge(1, 2)]))


def _maps() -> Iterator[Target]:
    for rule, weight in (("surface", 3), ("paper", 2)):
        write, read = partial(_write_map, rule), partial(_read_map, rule)
        yield Target(f"map_{rule}", write, read, "room.map", weight=weight)


def _recordings() -> Iterator[Target]:
    made = {
        "bag_tf": _write_bag_with_tf,
        "tum": lambda at: camera.write_tum(at / "freiburg1", 2),
        "seven_scenes": lambda at: camera.write_seven_scenes(at / "seq-01", 2),
        "scan_3rscan": lambda at: sequences.write_sequence(at / "scan", 2),
        "scan_replica": lambda at: sequences.write_sequence(
            evaluation.write_dataset(at, ONE_ROOM) / "data" / "room_0", 2
        ),
        "scan_rooms": lambda at: sequences.write_ground_truth(
            sequences.write_room(at, 2) / "data" / "room_0"
        ),
    }
    for name, write in made.items():
        yield Target(name, write, _read_recording)
    for name, plugin in (("mcap", "mcap"), ("sqlite", "sqlite3")):
        write = partial(_write_bag, plugin)
        yield Target(f"bag_{name}", write, _read_recording, weight=2)
    for layout in ("replica", "3rscan"):
        write = partial(evaluation.write_dataset, scans=SCANS, layout=layout)
        yield Target(f"annotations_{layout}", write, partial(_read_annotations, layout))


def _others() -> Iterator[Target]:
    yield Target(
        "config_yaml",
        lambda path: path.write_text(to_yaml(Config())),
        effective_config,
        "config.yaml",
        documents=(_CONFIGURATIONS | _PARAMETERS).map(lambda it: json.dumps(it).encode()),
        weight=2,
    )
    yield Target(
        "set_option",
        lambda path: path.write_text("output.rate_hz=2.5"),
        lambda path: effective_config(None, [path.read_bytes().decode(errors="surrogateescape")]),
        "set.txt",
        documents=_SETTINGS.map(lambda words: "=".join(words).encode(errors="replace")),
    )
    poses = [pose(index) for index in range(4)]
    trajectories = {
        "tum": lambda path: write_tum(path, list(map(stamp_ns, range(4))), poses),
        "kitti": lambda path: np.savetxt(path, [T[:3].ravel() for T in poses], "%.9g"),
    }
    for name, write in trajectories.items():
        yield Target(f"trajectory_{name}", write, _read_trajectory, "poses.txt")
    yield Target(
        "trajectory_folder",
        lambda at: [
            np.savetxt(at / f"frame-{index:06d}.pose.txt", poses[index], "%.9g")
            for index in range(2)
        ],
        read_trajectory,
    )
    points = np.random.default_rng(0).random((5, 3))
    for name, form in (("ascii", "ascii"), ("binary", "binary_little_endian")):
        write = partial(evaluation.write_ply, points=points, ids=np.arange(5), form=form)
        yield Target(f"ply_{name}", write, _read_ply, "points.ply")
    for protocol in (2, 5):
        both = {"a": PREDICTION, "b": ScanPrediction.empty(3, 3)}
        write = partial(evaluation.write_predictions, predictions=both, protocol=protocol)
        name = f"predictions_pickle_{protocol}"
        yield Target(name, write, _read_predictions, "predictions.pkl")
    yield Target("safetensors", _write_headers, hub.read_headers, "model.safetensors")
    documents = {
        "predictions_json": (
            partial(evaluation.write_json, content=OPEN_PREDICTIONS),
            _read_predictions,
            "predictions.json",
        ),
        "checkpoint_card": (
            lambda path: cards.write_detector_card(path, CARD),
            cards.read_detector_card,
            cards.DETECTOR_CARD,
        ),
        "probe_card": (lambda at: cards.write_probe_card(at, PROBE), _read_probe_card, ""),
        "scene_graph": (_write_graph, graph_files.read_graph, ""),
    }
    for name, (write, read, file) in documents.items():
        yield Target(name, write, read, file, documents=JSON_DOCUMENTS)


TARGETS: dict[str, Target] = {
    target.name: target for target in (*_maps(), *_recordings(), *_others(), *wire_targets.TARGETS)
}

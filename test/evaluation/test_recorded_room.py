"""A recording with its ground truth beside it is a data set of one scan."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from support.cli import invoke

from deworldsg_ros.client import SceneGraph
from deworldsg_ros.evaluation.recorded_room import SPELLINGS, open_annotations
from deworldsg_ros.graph.graph_files import read_graph
from deworldsg_ros.recordings.folders.annotations import Annotations
from deworldsg_ros.scene.errors import RecordingError
from deworldsg_ros.wire import messages as wire

RECORDING = Path(__file__).resolve().parents[2] / "bags" / "demo_room"
TRUTH = json.loads(RECORDING.with_name("demo_room.gt.json").read_text(encoding="utf-8"))
# Promised for perfect masks. Nothing is fitted to this recording.
MEDIAN_ERROR_M = 0.04


def evaluate(front_end, out, *arguments):
    words = ["evaluate", "run", "--layout", "recording", RECORDING, "--checkpoints", 0]
    words += ["--front-end", front_end, *arguments, "--out", out, "--json", out / "n.json"]
    return invoke(*words)


def values_of(out, result):
    assert result.exit_code == 0, result.output
    return json.loads((out / "n.json").read_text())


def test_only_objects_that_can_be_detected_count():
    room = open_annotations(RECORDING, "recording")
    assert room.scans("test") == ["demo_room"]
    annotation = room.scan("demo_room")
    detectable = {item["id"] for item in TRUTH["objects"] if item["detectable"]}
    assert annotation.objects.keys() == detectable
    names = {room.vocabulary.classes[index] for index in annotation.objects.values()}
    assert {"tv", "couch", "dining table", "potted plant", "cup"} <= names
    assert len(annotation.relations) > 80
    assert all({line[0], line[1]} <= detectable for line in annotation.relations)


def test_command_on_a_recording(tmp_path):
    options = ("--every", 8, "--max-frames", 10, "--pose-noise", "jitter_m=0.001")
    values = values_of(tmp_path, evaluate("ground-truth", tmp_path, *options))
    assert values["scans"][0]["frames"] == 10
    assert values["measures"]["found"] >= 10
    # Ten frames, eight tenths of a second apart.
    stamp_ns = wire.ns_from_stamp(read_graph(tmp_path / "demo_room").stamp)
    assert stamp_ns == 1_750_000_000_000_000_000 + 9 * 800_000_000


def sides(size_m):
    """Sides (3,), the longer horizontal one first."""
    length, width, height = size_m
    return np.array([max(length, width), min(length, width), height])


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_boxes_of_perfect_masks_have_the_true_extents(tmp_path):
    values_of(tmp_path, evaluate("ground-truth", tmp_path))
    graph = SceneGraph.load(tmp_path / "demo_room")
    assert graph.message.up == [0.0, 0.0, 1.0]
    assert isinstance(graph.message.hidden, list)
    assert graph.message.schema == wire.Schema("scene_graph", 2)
    errors = []
    for item in TRUTH["objects"]:
        low, high = np.array(item["aabb"]) + [[-0.05], [0.05]]
        label = SPELLINGS.get(item["class"], item["class"])
        inside = [
            node
            for node in graph
            if node.label == label and ((node.mean_m >= low) & (node.mean_m <= high)).all()
        ]
        if inside and item["detectable"]:
            centre = item["visible_centroid"]
            best = min(inside, key=lambda node: np.linalg.norm(np.subtract(node.mean_m, centre)))
            errors.append(np.abs(sides(best.size_m) - sides(item["obb"]["size"])))
    assert len(errors) >= 50
    assert np.median(errors) <= MEDIAN_ERROR_M
    assert (np.median(errors, axis=0) <= MEDIAN_ERROR_M).all()


@pytest.mark.parametrize(
    ("front_end", "arguments", "words"),
    [
        ("recorded", (), "no recorded detections"),
        ("ground-truth", ("--poses", "slam"), "no frame-NNNNNN.slam.pose.txt"),
        ("backend", ("--faults", "cut=0.1"), "backend with cut 0.1"),
        ("ground-truth", ("--poses", "slam", "--pose-noise", "jitter_m=1"), "--poses perturbed"),
    ],
)
def test_conflicting_options_are_refused(tmp_path, front_end, arguments, words):
    result = evaluate(front_end, tmp_path, *arguments)
    assert result.exit_code != 0
    assert words in " ".join(result.output.split())


def test_a_recording_without_ground_truth_is_refused_with_the_missing_file(tmp_path):
    def refused(match):
        with pytest.raises(RecordingError, match=match):
            open_annotations(tmp_path / "room", "recording")

    truth, instances = tmp_path / "room.gt.json", tmp_path / "room.instances.npz"
    refused(r"room\.gt\.json is missing")
    shutil.copy(RECORDING.with_name("demo_room.gt.json"), truth)
    refused(r"room\.instances\.npz is missing")
    instances.write_bytes(b"nothing")
    with pytest.raises(RecordingError, match="expected lzma and shape"):
        open_annotations(tmp_path / "room", "recording").instances(1_750_000_000_000_000_000)
    truth.write_text('{"objects": [{}]}')
    refused(r"room\.gt\.json: KeyError")
    truth.write_text(json.dumps({**TRUTH, "rate_hz": 0}))
    refused(r"at 0\.0 Hz")
    with pytest.raises(RecordingError, match="expected replica, 3rscan or recording"):
        Annotations(tmp_path, "video")

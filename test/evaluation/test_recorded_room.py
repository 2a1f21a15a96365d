"""A recording with its ground truth beside it is a data set of one scan."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from deworldsg_ros.cli.app import app
from deworldsg_ros.evaluation.graph_measures import read_reference
from deworldsg_ros.evaluation.recorded_room import RecordedRoom, open_annotations
from deworldsg_ros.graph.graph_files import read_graph
from deworldsg_ros.recordings.folders.annotations import Annotations
from deworldsg_ros.scene.errors import RecordingError
from deworldsg_ros.wire.messages import ns_from_stamp

RECORDING = Path(__file__).resolve().parents[2] / "bags" / "demo_room"


def evaluate(*arguments: object) -> Result:
    inputs = ["--layout", "recording", RECORDING, "--checkpoints", 0]
    words = ["evaluate", "run", *inputs, *arguments]
    return CliRunner().invoke(app, [str(word) for word in words])


def test_only_objects_that_can_be_detected_count() -> None:
    room = open_annotations(RECORDING, "recording")
    assert isinstance(room, RecordedRoom)
    assert room.scans("test") == ["demo_room"]
    annotation = room.scan("demo_room")
    truth = json.loads(RECORDING.with_name("demo_room.gt.json").read_text(encoding="utf-8"))
    detectable = {item["id"] for item in truth["objects"] if item["detectable"]}
    assert annotation.objects.keys() == detectable
    names = {room.vocabulary.classes[index] for index in annotation.objects.values()}
    assert {"tv", "couch", "dining table", "potted plant", "cup"} <= names
    assert all({line[0], line[1]} <= detectable for line in annotation.relations)
    assert len(annotation.relations) > 80
    with pytest.raises(RecordingError, match="kitchen"):
        room.scan("kitchen")


def test_surface_points_are_those_of_the_objects() -> None:
    room = RecordedRoom(RECORDING)
    points = room.points("demo_room")
    reference = read_reference(room, "demo_room", points)
    assert reference.exact
    for number, low, high, centroid in zip(
        reference.ids, reference.boxes_min, reference.boxes_max, reference.centroids
    ):
        surface = points.points_world[points.object_ids == number]
        assert len(surface) >= 8
        assert ((surface > low - 0.06) & (surface < high + 0.06)).all(), number
        assert np.linalg.norm(surface.mean(axis=0) - centroid) < 0.15, number


def test_command_on_a_recording(tmp_path: Path) -> None:
    result = evaluate(
        *("--front-end", "ground-truth", "--every", 8, "--max-frames", 10),
        *("--pose-noise", "jitter_m=0.001", "--out", tmp_path, "--json", tmp_path / "n.json"),
    )
    assert result.exit_code == 0, result.output
    values = json.loads((tmp_path / "n.json").read_text())
    assert values["scans"][0]["frames"] == 10
    assert values["measures"]["found"] >= 10
    graph = read_graph(tmp_path / "demo_room")
    # Ten frames, eight tenths of a second apart.
    assert ns_from_stamp(graph.stamp) == 1_750_000_000_000_000_000 + 9 * 800_000_000


def test_true_boxes_of_a_recording_get_the_masks_of_the_segmenter(tmp_path: Path) -> None:
    result = evaluate(
        *("--front-end", "boxes", "--every", 25, "--max-frames", 3),
        *("--out", tmp_path, "--json", tmp_path / "n.json"),
    )
    assert result.exit_code == 0, result.output
    values = json.loads((tmp_path / "n.json").read_text())
    assert values["front_end"] == "boxes jitter 2"
    # Three views far apart: one look is enough, and one node's centre is in its neighbour's box.
    assert values["measures"]["found"] >= 20
    assert values["measures"]["wrong_class"] <= 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--front-end", "recorded"), "no recorded detections"),
        (("--front-end", "ground-truth", "--poses", "slam"), "no frame-NNNNNN.slam.pose.txt"),
        (("--front-end", "ground-truth", "--faults", "cut=2"), "fault cut=2: expected 0 to 1"),
        (("--front-end", "backend", "--faults", "cut=0.1"), "backend with cut 0.1: faults need"),
        (("--front-end", "boxes", "--faults", "cut=0.1"), "boxes with cut 0.1: the masks are"),
        (
            ("--front-end", "ground-truth", "--poses", "odometry", "--pose-noise", "jitter_m=1"),
            "only --poses perturbed has noise",
        ),
        (
            ("--front-end", "ground-truth", "--poses", "odometry", "--poses", "perturbed"),
            "has 2 --poses: give one",
        ),
    ],
)
def test_conflicting_options_are_refused(
    tmp_path: Path, arguments: tuple[str, ...], words: str
) -> None:
    result = evaluate(*arguments, "--out", tmp_path)
    assert result.exit_code != 0
    assert words in " ".join((result.stdout + result.stderr).split())


def test_a_recording_without_ground_truth_is_refused_with_the_missing_file(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"room\.gt\.json is missing"):
        open_annotations(tmp_path / "room", "recording")
    shutil.copy(RECORDING.with_name("demo_room.gt.json"), tmp_path / "room.gt.json")
    with pytest.raises(RecordingError, match=r"room\.instances\.npz is missing"):
        open_annotations(tmp_path / "room", "recording")
    (tmp_path / "room.instances.npz").write_bytes(b"nothing")
    room = open_annotations(tmp_path / "room", "recording")
    assert isinstance(room, RecordedRoom)
    with pytest.raises(RecordingError, match="expected lzma and shape"):
        room.instances(1_750_000_000_000_000_000)
    (tmp_path / "room.gt.json").write_text('{"objects": [{}]}')
    with pytest.raises(RecordingError, match=r"room\.gt\.json: KeyError"):
        open_annotations(tmp_path / "room", "recording")
    truth = {"objects": [], "relations": [], "first_stamp_ns": 0, "rate_hz": 0, "frames": 1}
    (tmp_path / "room.gt.json").write_text(json.dumps(truth))
    with pytest.raises(RecordingError, match=r"1 frames at 0.0 Hz: expected at most"):
        open_annotations(tmp_path / "room", "recording")


def test_other_layouts_are_data_sets(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="expected replica, 3rscan or recording"):
        Annotations(tmp_path, "video")

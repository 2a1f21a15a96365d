"""The stage that lost each annotated object, on a small room with one loss of each kind."""

import json
import re

import cv2
import numpy as np
import pytest
from support.cli import printed, refusal
from support.sequences import write_room

from deworldsg_ros.config import Config, InputsConfig, PerceptionConfig, RelationsConfig
from deworldsg_ros.evaluation.losses import STAGES, Judge, Tracer, count_stages, draw_loss
from deworldsg_ros.evaluation.recorded_room import TrueObject, Truth, read_marked
from deworldsg_ros.perception.backends.geometric import GeometricRelationHead
from deworldsg_ros.perception.protocols import Detections
from deworldsg_ros.perception.stage import Perception
from deworldsg_ros.pipeline import Pipeline
from deworldsg_ros.scene.camera import Intrinsics, MaskPatch, RgbdFrame
from deworldsg_ros.scene.errors import RecordingError
from deworldsg_ros.scene.vocabulary import COCO_CLASSES, PREDICATE_SETS

CAMERA = Intrinsics(150.0, 150.0, 159.5, 119.5, 320, 240)
FRAMES, SIDE_M, WALL_M = 30, 0.4, 4.0
# The camera looks along z, y is down; cards of 40 cm hang in the air at these x, y, each with what
# becomes of it. The wall behind them is the bed: its box fills the image.
CARDS = {
    "found": (-1.6, -0.6),
    "never fired": (-0.8, -0.6),
    "fired below": (0.0, -0.6),
    "cut away": (0.8, -0.6),
    "displaced": (1.6, -0.6),
    "merged": (-1.6, 0.0),
    "misnamed": (-0.8, 0.6),
    "unnamed": (0.0, 0.6),
    "hidden": (0.8, 0.6),
    "removed": (1.6, 0.6),
}
DEPTHS_M = {"merged": 2.6}
GONE_FROM = 18
NAME = "bottle"


def box_m(stage):
    if stage == "never seen":
        return np.array([0.0, 0.0, -2.0]), np.array([0.4, 0.4, -1.6])
    if stage == "refused":
        return np.array([-3.0, -2.0, WALL_M - 0.05]), np.array([3.0, 2.0, WALL_M + 0.05])
    (x, y), z = CARDS[stage], DEPTHS_M.get(stage, 2.5)
    half = SIDE_M / 2
    return np.array([x - half, y - half, z - 0.02]), np.array([x + half, y + half, z + 0.02])


def eye_x(number):
    return 0.5 * np.sin(0.4 * number)


def pixels(stage, number):
    """Left, top, right, bottom of a card in a frame; the last two are inside."""
    low, high = box_m(stage)
    corners = np.array([low - [eye_x(number), 0, 0], high - [eye_x(number), 0, 0]])
    corners[:, 2] = low[2] + 0.02
    (left, top), (right, bottom) = CAMERA.project(corners)
    return [int(np.ceil(left)), int(np.ceil(top)), int(right), int(bottom)]


def frame(number):
    depth = np.full((CAMERA.height, CAMERA.width), WALL_M, np.float32)
    for stage in CARDS:
        if stage == "removed" and number >= GONE_FROM:
            continue
        left, top, right, bottom = pixels(stage, number)
        depth[top : bottom + 1, max(left, 0) : right + 1] = DEPTHS_M.get(stage, 2.5)
    T = np.eye(4)
    T[0, 3] = eye_x(number)
    rgb = np.full((*depth.shape, 3), 120, np.uint8)
    return RgbdFrame(10**8 * (number + 1), rgb, depth, CAMERA, T)


class ScriptedDetector:
    """Detects the cards with the fault of each."""

    classes = COCO_CLASSES
    default_score_threshold = 0.4
    number = 0

    def detect(self, rgb, score_threshold):
        found = [item for item in self._all() if item[1] >= score_threshold]
        found.sort(key=lambda item: -item[1])
        probabilities = np.zeros((len(found), len(self.classes)))
        for row, (_, _, names, _) in enumerate(found):
            for name, share in names.items():
                probabilities[row, self.classes.index(name)] = share
        return Detections(
            np.array([box for box, *_ in found], float).reshape(-1, 4),
            probabilities,
            np.array([score for _, score, *_ in found]),
            masks=tuple(self._mask(*mask) for *_, mask in found),
        )

    def _all(self):
        sure = {NAME: 0.9, "vase": 0.1}
        yield [0, 0, 319, 239], 0.8, {"bed": 1.0}, (0, 0, 319, 239)
        for stage in CARDS:
            box, score, names = pixels(stage, self.number), 0.8, sure
            left, top, right, bottom = box
            mask = tuple(box)
            if stage == "never fired" or (stage == "hidden" and self.number != 9):
                continue
            if stage == "removed" and self.number >= GONE_FROM:
                continue
            if stage == "merged":
                # Its mask shows the neighbour above, which other frames detect.
                if self.number % 3:
                    continue
                mask = tuple(pixels("found", self.number))
            elif stage == "found" and self.number % 3 == 0:
                continue
            elif stage == "fired below":
                score = 0.15
            elif stage == "hidden":
                score = 0.41
            elif stage == "cut away":
                mask = (left, top, left + 1, top + 1)
            elif stage == "displaced":
                mask = (left, bottom + 5, right, bottom + 20)
            elif stage == "misnamed":
                names = {"vase": 0.9, NAME: 0.1}
            elif stage == "unnamed":
                names = {NAME: 0.35, "vase": 0.33, "cup": 0.32}
            yield box, score, names, mask

    def _mask(self, left, top, right, bottom):
        return MaskPatch(top, left, np.ones((bottom - top + 1, right - left + 1), bool))


def test_each_loss_is_named_by_its_stage():
    detector = ScriptedDetector()
    perception = Perception(
        detector,
        None,
        GeometricRelationHead(PREDICATE_SETS["replica_ssg"]),
        PerceptionConfig(),
        world_up="-y",
    )
    config = Config(
        inputs=InputsConfig(world_up="-y"), relations=RelationsConfig(world_model="none")
    )
    stages = [*CARDS, "never seen", "refused"]
    names = {"refused": "bed"}
    truth = Truth(
        tuple(TrueObject(s, (names.get(s, NAME),), *box_m(s)) for s in stages), margin_m=0.05
    )
    tracer = Tracer(Pipeline(config, perception), truth)
    for number in range(FRAMES):
        detector.number = number
        tracer.process(frame(number), number)
    losses = Judge(tracer).losses()
    assert {loss.item.id: loss.stage for loss in losses} == {stage: stage for stage in stages}
    assert set(stages) == set(STAGES)
    assert count_stages(losses) == {**dict.fromkeys(STAGES, 1), "duplicates": 0}
    said = {loss.stage: loss.detail for loss in losses}
    assert "box_is_the_view in 30 frames" in said["refused"]
    assert "few_mask_pixels in 30 frames" in said["cut away"]
    assert "best as bottle with 0.15" in said["fired below"]
    assert "which is bottle found" in said["merged"]
    assert "the detector said 30 × vase" in said["misnamed"]
    assert re.match(r"#\d+: bottle \d+%, vase \d+%", said["unnamed"])
    assert said["never seen"] == "in no image"
    # The picture has a header, the image, the box in green and the detections in orange.
    picture = draw_loss(losses[stages.index("misnamed")], stages.index("misnamed"))
    assert picture.shape[0] > CAMERA.height and picture.shape[1] == CAMERA.width
    colours = picture.reshape(-1, 3).tolist()
    assert [0, 140, 255] in colours and [80, 220, 60] in colours
    assert losses[stages.index("never seen")].trace.view is None


def test_command_writes_a_table_and_the_pictures(tmp_path):
    root = write_room(tmp_path / "set")
    out, values = tmp_path / "out", tmp_path / "n.json"
    words = ["evaluate", "losses", root, "--layout", "replica", "--out", out, "--json", values]
    # Of the flipped labels, those of the chair and the book are wrong.
    text = printed(*words, "--front-end", "recorded", "--flip", 0.1)
    content = json.loads((out / "room_0" / "losses.json").read_text())
    assert json.loads(values.read_text())["scans"]["room_0"]["stages"] == content["stages"]
    lost = {item["names"][0]: item for item in content["objects"]}
    assert {name: item["stage"] for name, item in lost.items()} == {
        "chair": "found",
        "table": "misnamed",
        "book": "misnamed",
    }
    assert "misnamed" in text and "book 3" in text
    pictures = {item["picture"] for item in content["objects"]} - {None}
    assert {path.name for path in (out / "room_0").glob("*.png")} == pictures
    assert len(pictures) == 2
    assert cv2.imread(str(out / "room_0" / min(pictures))) is not None
    # With right labels nothing is lost, and no picture of the first run is left.
    printed(*words, "--front-end", "recorded")
    assert [path.name for path in (out / "room_0").iterdir()] == ["losses.json"]


def test_a_recording_with_marked_boxes(tmp_path):
    root = write_room(tmp_path / "set") / "data" / "room_0"
    file = tmp_path / "boxes.json"
    words = ["evaluate", "losses", root, "--out", tmp_path / "out", "--boxes", file]
    box = {"centroid_m": [0, 0, 9.0], "extent_m": [1, 1, 1]}
    file.write_text(json.dumps({"objects": [{"id": "a", "names": ["cup", "glass"], **box}]}))
    (item,) = read_marked(file).objects
    assert (item.title, item.low.tolist()) == ("cup a", [-0.5, -0.5, 8.5])
    assert "hidden, or without depth" in printed(*words)
    assert "--layout" in refusal(*words, "--layout", "replica")
    assert "one recording" in refusal(*words, "--scan", "a")
    assert "expected backend" in refusal(*words, "--front-end", "boxes")
    bad = {"objects": [{"label": "cup", "aabb": [[0, 0, 0], [1, 1, -1]]}]}
    for content, said in (
        (bad, "object 0.*lower one first"),
        ({"objects": []}, "0 objects"),
        ({"objects": [{"names": ["cup"]}]}, "extent_m"),
        ({"objects": [{"optional": True}, {"names": "cup", **box}]}, "object 1.*list of words"),
        ([], "TypeError"),
    ):
        file.write_text(json.dumps(content))
        with pytest.raises(RecordingError, match=said):
            read_marked(file)

"""The shipped recording, made wrong on purpose: what its frames, `doctor` and `run` say."""

import json
from collections import Counter
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from support.cli import DEMO_ROOM, invoke, refusal
from support.recordings import encoded

from deworldsg_ros.doctor import FrameSampler, Observations, find
from deworldsg_ros.graph.graph_files import read_graph
from deworldsg_ros.recordings import source as ros
from deworldsg_ros.recordings.recording import open_recording
from deworldsg_ros.recordings.writer import write_mcap
from deworldsg_ros.scene.camera import invert_pose, rigid_motion, turned

pytestmark = pytest.mark.timeout(400)


def moved(frame, T):
    return replace(frame, T_world_camera=T)


def with_depth(change):
    return lambda frames: [replace(it, depth_m=np.float32(change(it.depth_m))) for it in frames]


def with_pose(change):
    """`change` gets the pose, and the number of the frame."""
    return lambda frames: [moved(it, change(it.T_world_camera, n)) for n, it in enumerate(frames)]


# The pose of a body whose x axis is the camera's z axis.
OPTICAL_TO_BODY = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
JUMP = rigid_motion(np.array([3.0, 0.0, 0.0]), np.zeros(3))


def other_poses(frames):
    """The poses of a robot that turns on the spot beside a camera that looks elsewhere."""
    turns = [
        rigid_motion(np.zeros(3), np.array([0, 0, by])) for by in np.linspace(0, 2, len(frames))
    ]
    return [moved(frame, frames[0].T_world_camera @ turn) for frame, turn in zip(frames, turns)]


# Right frames, made wrong on purpose.
WRONG = {
    "right": lambda frames: frames,
    "on its side": lambda frames: [turned(frame, 1) for frame in frames],
    "depth times 10": with_depth(lambda depth_m: np.where(depth_m * 10 > 60, 0, depth_m * 10)),
    "depth by 5": with_depth(lambda depth_m: depth_m / 5),
    "shifted depth": with_depth(lambda depth_m: np.roll(depth_m, 24, axis=1)),
    "no depth": with_depth(lambda depth_m: depth_m * (depth_m > 4.5)),
    "one frame": lambda frames: frames[:1],
    "still": lambda frames: [replace(frames[0], stamp_ns=it.stamp_ns) for it in frames[:30]],
    "jumping poses": with_pose(lambda T, number: JUMP @ T if number % 7 == 3 else T),
    "late poses": lambda frames: [moved(a, b.T_world_camera) for a, b in zip(frames[4:], frames)],
    "poses of the body": with_pose(lambda T, _: T @ OPTICAL_TO_BODY),
    "inverse poses": with_pose(lambda T, _: invert_pose(T)),
    "other poses": other_poses,
    "dark": lambda frames: [replace(frame, rgb=frame.rgb // 40) for frame in frames],
}


def messages(frames):
    """Messages without loss in the pixels; depth in millimetres."""
    for frame in frames:
        at, camera = frame.stamp_ns, "camera_optical"
        bgr = np.ascontiguousarray(frame.rgb[:, :, ::-1])
        depth_mm = np.rint(1000 * frame.depth_m).astype(np.uint16)
        yield ros.camera_info(at, camera, frame.intrinsics)
        yield ros.pose_stamped_from_matrix(at, "map", frame.T_world_camera)
        yield ros.compressed_depth(at, camera, encoded(depth_mm))
        yield ros.compressed_image(at, camera, encoded(bgr), "png")


@pytest.fixture(scope="module")
def frames():
    recording = open_recording(DEMO_ROOM)
    yield list(islice(recording.frames(), 60))
    recording.close()


@pytest.mark.parametrize(
    ("name", "code", "words"),
    [
        *[(name, None, "") for name in ("right", "on its side", "one frame", "still", "dark")],
        ("depth times 10", "depth_unit", "multiplied by 0.1"),
        ("depth by 5", "depth_unit", "multiplied by 5"),
        ("shifted depth", "not_registered", "24 pixels away"),
        ("no depth", "little_depth", "depth_scale"),
        ("late poses", "late_poses", "0.4 s later"),
        ("poses of the body", "poses_of_the_body", "x is taken as forward"),
        ("inverse poses", "poses_inverted", "inverse"),
        ("other poses", "poses_do_not_fit", "not those of this camera"),
    ],
)
def test_the_frames_tell_what_is_wrong_and_nothing_else(frames, name, code, words):
    """No detector runs."""
    sampler = FrameSampler()
    for frame in WRONG[name](frames[:50]):
        sampler.add(frame)
    findings = find(Observations(checks=sampler.checks()))
    assert [finding.code for finding in findings] == ([] if code is None else [code])
    assert words in " ".join(map(str, findings))


def test_a_few_frames_are_kept_of_many_and_none_of_none(frames):
    sampler = FrameSampler()
    assert sampler.checks() is None
    for index in range(40):
        for frame in frames[:10]:
            sampler.add(replace(frame, stamp_ns=frame.stamp_ns + 2 * 10**9 * index))
    assert len(sampler._pairs) <= 12
    assert sampler.checks() is not None


@pytest.fixture
def examine(frames, tmp_path):
    """The exit code and the output of a command on a wrong recording."""

    def call(name, *command):
        bag = tmp_path / f"{name}.mcap"
        write_mcap(map(ros.serialize, messages(WRONG[name](frames))), bag)
        result = invoke(command[0], bag, *command[1:])
        return result.exit_code, " ".join((result.stdout + result.stderr).split())

    return call


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "code", "words"),
    [
        ("right", 0, "nothing is off"),
        ("one frame", 3, "Only 1 frame reached the graph"),
        ("still", 3, "The camera stands still (0 cm, 0 degrees)"),
        ("jumping poses", 3, "The pose jumped at"),
        ("depth by 5", 3, "multiplied by 5"),
        ("dark", 3, "It knows 80 classes: person"),
    ],
)
def test_doctor_names_what_is_wrong(examine, name, code, words):
    exit_code, output = examine(name, "doctor")
    assert words in output
    assert exit_code == code, output


@pytest.mark.slow
def test_a_camera_on_its_side_gives_the_same_objects(examine, tmp_path):
    labels = {}
    for name in ("right", "on its side"):
        out = tmp_path / "out" / name
        code, output = examine(name, "run", "--out", out)
        assert code == 0, output
        labels[name] = Counter(node.label for node in read_graph(out).nodes)
        findings = json.loads((out / "run.json").read_text())["findings"]
        assert [item["code"] for item in findings] == ["turned"] * (name != "right")
        assert ("note: The camera is turned by 90 degrees in 60 frames" in output) is bool(findings)
    # Pixels are sampled in another order: an object at the threshold may differ.
    assert (labels["on its side"] & labels["right"]).total() >= labels["right"].total() - 1 > 8


@pytest.mark.parametrize("arguments", [[], [DEMO_ROOM, "--live"]])
def test_doctor_wants_a_recording_or_running_nodes(arguments):
    assert "either a RECORDING or --live" in refusal("doctor", *arguments)

"""Observations become sentences; without observations there are none."""

import pytest

from deworldsg_ros.doctor import FrameChecks, Observations, find
from deworldsg_ros.doctor.findings import DROPS, USUAL_SIZES_M
from deworldsg_ros.ros.health import REASONS
from deworldsg_ros.scene.vocabulary import COCO_CLASSES

GOOD = FrameChecks(0.9, fits={"given": 0.97, "still": 0.5}, travel_m=2.0, turn_deg=90.0)


def sizes(factor, count=4):
    names = ("chair", "cup", "tv", "book")[:count]
    return {"sizes": tuple((name, factor * USUAL_SIZES_M[name]) for name in names)}


def drops(images=100, **reasons):
    return {"images": images, "drops": reasons}


def checks(with_depth=0.9, **more):
    return {"checks": FrameChecks(with_depth, **more)}


def fits(change, fit, **more):
    """How well the frames fit with poses or depth that are changed so."""
    return checks(fits={"given": 0.5, change: fit, **more}, travel_m=2.0)


def few(frames, nodes, detections, **more):
    """A small graph."""
    return {"frames": frames, "nodes": nodes, "detections": detections, **more}


ALL_IS_WELL = {
    **drops(171, no_pose=2, unmatched_depth=40),
    **sizes(1.4),
    **few(171, 34, 900, hidden={"seen too little": 9}, turns={0: 171}, checks=GOOD),
    "found_nodes": True,
}


@pytest.mark.parametrize(
    ("seen", "code", "words"),
    [
        ({}, None, ""),
        (ALL_IS_WELL, None, ""),
        ({"silent": {"/rgb": ("/camera/color",)}}, "no_publisher", "/camera/color"),
        ({"silent": {"/rgb": ()}}, "no_publisher", "Start the driver"),
        ({"behind_s": {"/odom": 0.3, "/pose": 3600.0}}, "clock", "/pose are 3600 s beh"),
        ({"behind_s": {"/pose": -90.0}}, "clock", "90 s ahead of the clock"),
        ({"missing": ("no depth on /d for 5 s",)}, "no_input", "No depth on /d for 5 s"),
        ({"missing": ("rgb at 7 s waits for pose: the newest is at 3 s",)}, "late_input", "delay"),
        (drops(lost_rgb=30), "lost_images", "30 of rgb"),
        (drops(lost_rgb=1), None, ""),
        (drops(pose_jump=14), "pose_jumps", "at 14 images"),
        (drops(grid_mismatch=9), "not_registered", "another size"),
        (
            drops(0, detector_error=1) | {"examples": {"detector_error": "no memory."}},
            "detector_error",
            "no memory.",
        ),
        (sizes(4.0), "depth_unit", "times as large as usual: a"),
        (sizes(0.2), "depth_unit", "0.2 times as large"),
        (sizes(4.0, count=2), None, ""),
        (checks(depth_shift_px=(4.0, 0.0), shift_gain=0.5), None, ""),
        (checks(depth_shift_px=(40.0, 40.0), shift_gain=0.0), None, ""),
        (fits("still", 0.8), "poses_do_not_fit", "--odometry"),
        (fits("late -0.2", 0.8), "late_poses", "0.2 s earlier"),
        (fits("still", 0.5), "poses_do_not_fit", "tremble"),
        ({"turns": {2: 1}}, "turned", "180 degrees in 1 frame."),
        (
            {"unused_detector": "models/dfine", "its_settings": "--set a=b"},
            "unused_detector",
            "A stronger detector is in models/dfine, and the embedded one was used.",
        ),
        (few(100, 2, 12, classes=COCO_CLASSES), "few_detections", "80 classes: person, bicycle"),
        (few(1, 0, 3, hidden={"seen too little": 3}), "few_frames", "Only 1 frame reached"),
        (
            few(40, 1, 99, hidden={"x": 3}, **checks(travel_m=0.01, turn_deg=2.0)),
            "still_camera",
            "Move the camera",
        ),
        (few(40, 0, 99, hidden={"missed": 3}, checks=GOOD), "few_looks", "3 missed"),
        (few(40, 1, 99, hidden={"missed": 3}, checks=GOOD), None, ""),
    ],
)
def test_observations_become_findings(seen, code, words):
    findings = find(Observations(**seen))
    assert [finding.code for finding in findings] == ([] if code is None else [code])
    for finding in findings:
        text = str(finding)
        assert words in text
        assert finding.problem and finding.remedy
        assert "{" not in text and text.endswith(".")
        # With these two, nothing has to be done.
        assert finding.harmless is (code in ("turned", "unused_detector"))


def test_the_reasons_are_those_of_the_nodes():
    assert set(DROPS) <= set(REASONS)

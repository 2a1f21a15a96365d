"""Observations become sentences; without observations there are none."""

from __future__ import annotations

import pytest

from deworldsg_ros.doctor import FrameChecks, Observations, find
from deworldsg_ros.doctor.findings import DROPS, USUAL_SIZES_M
from deworldsg_ros.ros.health import REASONS
from deworldsg_ros.scene.vocabulary import COCO_CLASSES

GOOD = FrameChecks(0.9, fits={"given": 0.97, "still": 0.5}, travel_m=2.0, turn_deg=90.0)


def usual(factor):
    return tuple((name, factor * USUAL_SIZES_M[name]) for name in ("chair", "cup", "tv", "book"))


@pytest.mark.parametrize(
    ("seen", "codes", "words"),
    [
        (Observations(), [], ""),
        (
            Observations(
                images=171,
                frames=171,
                nodes=34,
                hidden={"seen too little": 9},
                detections=900,
                sizes=usual(1.4),
                turns={0: 171},
                checks=GOOD,
                drops={"no_pose": 2, "unmatched_depth": 40},
                found_nodes=True,
            ),
            [],
            "",
        ),
        (Observations(found_nodes=False), ["no_nodes"], "ROS_DOMAIN_ID"),
        (
            Observations(silent={"/rgb/image_raw": ("/camera/color/image_raw",)}),
            ["no_publisher"],
            "published on /camera/color/image_raw",
        ),
        (Observations(silent={"/rgb/image_raw": ()}), ["no_publisher"], "Start the driver"),
        (Observations(incompatible=("/x is best effort",)), ["qos"], "inputs.reliability"),
        (Observations(behind_s={"/odom": 0.3, "/pose": 3600.0}), ["clock"], "/pose are 3600 s beh"),
        (Observations(behind_s={"/pose": -90.0}), ["clock"], "90 s ahead of the clock"),
        (Observations(missing=("no depth on /d for 5 s",)), ["no_input"], "No depth on /d for 5 s"),
        (
            Observations(missing=("rgb at 7 s waits for pose: the newest on /odom is at 3 s",)),
            ["late_input"],
            "slower, delayed",
        ),
        (Observations(images=100, drops={"lost_rgb": 30}), ["lost_images"], "30 of rgb"),
        (Observations(images=100, drops={"lost_rgb": 1}), [], ""),
        (Observations(images=100, drops={"pose_jump": 14}), ["pose_jumps"], "at 14 images"),
        (Observations(images=100, drops={"no_pose": 90}), ["late_poses"], "90 images"),
        (Observations(images=100, drops={"grid_mismatch": 9}), ["not_registered"], "another size"),
        (
            Observations(drops={"detector_error": 1}, examples={"detector_error": "no memory."}),
            ["detector_error"],
            "no memory.",
        ),
        (Observations(checks=FrameChecks(0.02)), ["little_depth"], "Only 2%"),
        (Observations(sizes=usual(4.0)), ["depth_unit"], "times as large as usual: a"),
        (Observations(sizes=usual(0.2)), ["depth_unit"], "0.2 times as large"),
        (Observations(sizes=usual(4.0)[:2]), [], ""),
        (
            Observations(
                checks=FrameChecks(0.9, fits={"given": 0.4, "still": 0.5, "factor 5": 0.9})
            ),
            ["depth_unit"],
            "multiplied by 5",
        ),
        (
            Observations(checks=FrameChecks(0.9, depth_shift_px=(24.0, 0.0), shift_gain=0.5)),
            ["not_registered"],
            "24 pixels away",
        ),
        (Observations(checks=FrameChecks(0.9, depth_shift_px=(4.0, 0.0), shift_gain=0.5)), [], ""),
        (Observations(checks=FrameChecks(0.9, depth_shift_px=(40, 40), shift_gain=0.0)), [], ""),
        *[
            (Observations(checks=FrameChecks(0.9, fits={"given": 0.5, name: 0.8})), [code], words)
            for name, code, words in (
                ("still", "poses_do_not_fit", "--odometry"),
                ("body", "poses_of_the_body", "optical frame"),
                ("inverse", "poses_inverted", "inverse"),
                ("late 0.4", "late_poses", "0.4 s later"),
                ("late -0.2", "late_poses", "0.2 s earlier"),
            )
        ],
        (
            Observations(checks=FrameChecks(0.9, fits={"given": 0.5, "still": 0.5})),
            ["poses_do_not_fit"],
            "tremble",
        ),
        (Observations(turns={0: 3, 1: 97}), ["turned"], "90 degrees in 97 frames"),
        (Observations(turns={2: 1}), ["turned"], "180 degrees in 1 frame."),
        (
            Observations(frames=100, nodes=2, detections=12, classes=COCO_CLASSES),
            ["few_detections"],
            "80 classes: person, bicycle",
        ),
        (
            Observations(frames=1, nodes=0, hidden={"seen too little": 3}, detections=3),
            ["few_frames"],
            "Only 1 frame reached",
        ),
        (
            Observations(
                frames=40,
                nodes=1,
                hidden={"seen too little": 3},
                detections=99,
                checks=FrameChecks(0.9, travel_m=0.01, turn_deg=2.0),
            ),
            ["still_camera"],
            "Move the camera",
        ),
        (
            Observations(frames=40, nodes=1, hidden={"missed": 3}, detections=99, checks=GOOD),
            ["few_looks"],
            "3 missed",
        ),
    ],
)
def test_observations_become_findings(seen, codes, words):
    findings = find(seen)
    assert [finding.code for finding in findings] == codes
    text = " ".join(map(str, findings))
    assert words in text
    for finding in findings:
        assert finding.problem and finding.remedy
        assert "{" not in text and text.endswith(".")


def test_only_a_turned_camera_needs_nothing_to_be_done():
    assert [finding.harmless for finding in find(Observations(turns={1: 5}))] == [True]
    assert not any(finding.harmless for finding in find(Observations(drops={"no_pose": 5})))


def test_the_reasons_are_those_of_the_nodes():
    assert set(DROPS) <= set(REASONS)

"""Abnormal input on live topics: what each node gets, and the reason under which it is counted."""

import json
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec
import numpy as np
from geometry_msgs.msg import Pose, Quaternion
from support.nodes_bench import (
    HEIGHT,
    STEP_NS,
    camera_info,
    changed,
    depth,
    evidence,
    frame_graph,
    instances,
    local_graph,
    pose,
    rgb,
)

from deworldsg_ros.wire import messages as wire

HOUR_NS = 3600 * 10**9
Make = Callable[[int], Any] | None


class Case(NamedTuple):
    """One abnormal input: what is sent instead, and the reason under which it is counted.

    The topic has __ for /; without a maker of a message, none is sent.
    """

    node: str
    topic: str
    text: str
    make: Make
    reason: str


def _pose(**orientation: float) -> Callable[[int], Any]:
    values = {"w": 1.0, **orientation}
    return changed(pose, pose=Pose(orientation=Quaternion(**values)))


def _json(make: Callable[[int], Any], **fields: Any) -> Callable[[int], str]:
    """JSON of a message with fields replaced; `objects__0__score` is a place in it."""

    def text(stamp_ns: int) -> str:
        content = json.loads(wire.encode(make(stamp_ns)))
        for path, value in fields.items():
            place: Any = content
            *parents, last = (int(key) if key.isdigit() else key for key in path.split("__"))
            for key in parents:
                place = place[key]
            place[last] = value
        return json.dumps(content)

    return text


def _late(make: Callable[[int], Any], by_ns: int | None) -> Callable[[int], Any]:
    """A message with a wrong stamp; None = zero."""
    return lambda stamp_ns: make(0 if by_ns is None else stamp_ns + by_ns)


def _camera(node: str) -> list[Case]:
    """Inputs from the camera that lifting and perception share."""
    cases = [
        ("depth__image_raw", "encoding 8UC1", changed(depth, encoding="8UC1"), "unknown_encoding"),
        ("depth__image_raw", "a colour image", rgb, "not_depth"),
        ("depth__image_raw", "step shorter than a row", changed(depth, step=5), "bad_step"),
        ("depth__image_raw", "10 bytes of data", changed(depth, data=bytes(10)), "short_buffer"),
        ("depth__image_raw", "no pixels", changed(depth, height=0), "empty_image"),
        ("depth__image_raw", "half the height", lambda at: depth(at, HEIGHT // 2), "grid_mismatch"),
        ("depth__image_raw", "missing", None, "no_depth"),
        ("depth__image_raw", "stamp an hour ahead", _late(depth, HOUR_NS), "time_jump"),
        ("depth__image_raw", "stamp an hour ago", _late(depth, -HOUR_NS), "time_jump"),
        ("depth__image_raw", "stamp 0", _late(depth, None), "time_jump"),
        ("depth__image_raw", "stamp of the last frame", _late(depth, -STEP_NS), "stale"),
        ("rgb__camera_info", "K of zeros", changed(camera_info, k=[0.0] * 9), "invalid_intrinsics"),
        ("rgb__camera_info", "K of NaN", changed(camera_info, k=[math.nan] * 9),
         "invalid_intrinsics"),
        ("rgb__camera_info", "K of 1e300", changed(camera_info, k=[1e300] * 9),
         "invalid_intrinsics"),
        ("rgb__camera_info", "width 2^32 - 1", changed(camera_info, width=2**32 - 1),
         "invalid_intrinsics"),
        ("camera__pose", "position NaN", lambda at: pose(at, math.nan), "invalid_pose"),
        ("camera__pose", "position 1e300", lambda at: pose(at, 1e300), "invalid_pose"),
        ("camera__pose", "quaternion of zeros", _pose(w=0.0), "invalid_pose"),
        ("camera__pose", "quaternion with NaN", _pose(x=math.nan), "invalid_pose"),
        ("camera__pose", "quaternion of length 2", _pose(w=2.0), "invalid_pose"),
        ("camera__pose", "another world frame", lambda at: pose(at, frame_id="odom"),
         "wrong_frame"),
        ("camera__pose", "escape codes in the frame", lambda at: pose(at, frame_id="a\x1b[2J"),
         "invalid_frame_id"),
        ("camera__pose", "stamp an hour ahead", _late(pose, HOUR_NS), "time_jump"),
        ("camera__pose", "stamp 0", _late(pose, None), "time_jump"),
    ]  # fmt: skip
    return [Case(node, *case) for case in cases]


def _text(node: str, topic: str, make: Callable[[int], Any]) -> list[Case]:
    cases: list[tuple[str, Make, str]] = [
        ("no JSON", lambda at: "{not json", "invalid_message"),
        ("empty text", lambda at: "", "invalid_message"),
        ("100 000 opening brackets", lambda at: '{"x":' + "[" * 10**5, "invalid_message"),
        ("17 MB of zeros", lambda at: "0" * 17 * 2**20, "message_too_large"),
        ("stamp 1e400", lambda at: '{"stamp": {"sec": 1e400, "nanosec": 0}}', "invalid_message"),
        ("negative stamp", _json(make, stamp__sec=-1), "invalid_message"),
        ("version 99", _json(make, schema__version=99), "unknown_schema"),
        ("another message", _json(make, schema__name="other"), "unknown_schema"),
        ("escape codes in the frame", _json(make, frame_id="a\x1b[2J"), "invalid_frame_id"),
    ]
    return [Case(node, topic, *case) for case in cases]


def _stamps(node: str, topic: str, make: Callable[[int], Any]) -> list[Case]:
    jumps = {"an hour ahead": HOUR_NS, "an hour ago": -HOUR_NS, "0": None}
    return [
        Case(node, topic, f"stamp {text}", _late(make, by_ns), "time_jump")
        for text, by_ns in jumps.items()
    ]


FRAME, LOCAL, EVIDENCE = (
    f"deworldsg__{name}" for name in ("frame_graph", "local_graph", "relation_evidence")
)
RGB = "rgb__image_raw"
CASES: list[Case] = [
    Case("segmentation_node", RGB, "encoding yuv422", changed(rgb, encoding="yuv422"),
         "unknown_encoding"),
    Case("segmentation_node", RGB, "step shorter than a row", changed(rgb, step=5), "bad_step"),
    Case("segmentation_node", RGB, "10 bytes of data", changed(rgb, data=bytes(10)),
         "short_buffer"),
    Case("segmentation_node", RGB, "no pixels", changed(rgb, width=0), "empty_image"),
    *_stamps("segmentation_node", RGB, rgb),
    *_camera("segmentation_node"),
    Case("segmentation_node", "camera__pose", "50 m away", lambda at: pose(at, 50.0), "pose_jump"),
    *_camera("lifting_node"),
    *_text("lifting_node", FRAME, frame_graph),
    *_stamps("lifting_node", FRAME, frame_graph),
    Case("lifting_node", "deworldsg__instances", "an object that the frame graph lacks",
         lambda at: instances(at, 1), "unknown_instance"),
    Case("lifting_node", "deworldsg__instances", "encoding mono8",
         changed(instances, encoding="mono8"), "unknown_encoding"),
    Case("lifting_node", "deworldsg__instances", "missing", None, "no_instances"),
    *_text("relation_node", LOCAL, local_graph),
    *_stamps("relation_node", LOCAL, local_graph),
    Case("relation_node", RGB, "encoding yuv422", changed(rgb, encoding="yuv422"),
         "unknown_encoding"),
    Case("relation_node", RGB, "missing", None, "no_rgb"),
    *_text("graph_node", LOCAL, local_graph),
    *_stamps("graph_node", LOCAL, local_graph),
    Case("graph_node", LOCAL, "stamp of two frames ago", _late(local_graph, -2 * STEP_NS),
         "out_of_order"),
    Case("graph_node", LOCAL, "another world frame", changed(local_graph, frame_id="odom"),
         "wrong_frame"),
    Case("graph_node", LOCAL, "other predicates", changed(local_graph, predicates=["a", "b"]),
         "vocabulary_mismatch"),
    *(
        Case("graph_node", LOCAL, text, _json(local_graph, **{path: value}), "invalid_message")
        for text, path, value in (
            ("pose with a scale", "T_world_camera", np.diag([2.0, 2, 2, 1]).ravel().tolist()),
            ("score 2", "objects__0__score", 2.0),
            ("probabilities that sum to 2", "objects__0__class_probabilities", [1.0, 1.0]),
            ("inverted box", "objects__0__box_xyxy", [9.0, 9.0, 1.0, 1.0]),
            ("pixel_count 0", "objects__0__pixel_count", 0),
            ("covariance 1e300", "objects__0__covariance_m2", [1e300, 0, 0, 0, 1, 0, 0, 0, 1]),
            ("covariance of zeros", "objects__0__covariance_m2", [0.0] * 9),
            ("width 10^40", "width", 10**40),
            ("20 000 objects", "objects", [{}] * 20_000),
            ("one object twice", "objects", [msgspec.to_builtins(local_graph(1).objects[0])] * 2),
        )
    ),
    *_text("graph_node", EVIDENCE, evidence),
    Case("graph_node", EVIDENCE, "of a frame that was never merged",
         lambda at: evidence(at - 1), "unknown_frame"),
]  # fmt: skip


def table() -> str:
    """The table of docs/dev/reliability.md."""
    rows = [
        f"| `{case.node}` | `{case.topic.replace('__', '/')}` | {case.text} | `{case.reason}` |"
        for case in CASES
    ]
    return "\n".join(["| node | topic | abnormal input | counted as |", "|---|---|---|---|", *rows])

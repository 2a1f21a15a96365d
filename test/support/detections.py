"""Detections as another process sends them: our JSON, or vision_msgs."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from deworldsg_ros.perception.protocols import Detections
from deworldsg_ros.recordings.recording import open_source
from deworldsg_ros.recordings.source import (
    DETECTIONS,
    RawRoleMessage,
    Role,
    RoleMessage,
    header,
    serialize,
    string_message,
    typestore,
)
from deworldsg_ros.wire import messages as wire

DELAY_NS = 150_000_000
Named = Sequence[tuple[Sequence[float], Mapping[str, float]]]


def wire_message(named: Named, stamp_ns: int = 10**9, **more: Any) -> wire.DetectionsMessage:
    """Boxes with their names and scores, as our message."""
    return wire.DetectionsMessage(
        schema=wire.schema_of(wire.DetectionsMessage),
        stamp=wire.stamp_from_ns(stamp_ns),
        frame_id="camera",
        detections=[
            wire.SentDetection(list(box), [wire.NameScore(*pair) for pair in scores.items()])
            for box, scores in named
        ],
        **more,
    )


def vision_message(named: Named, stamp_ns: int = 10**9, theta: float = 0.0) -> Any:
    """The same as a vision_msgs/Detection2DArray."""
    types = typestore().types

    def vision(name: str) -> Any:
        return types[f"vision_msgs/msg/{name}"]

    pose = types["geometry_msgs/msg/PoseWithCovariance"](
        pose=types["geometry_msgs/msg/Pose"](
            position=types["geometry_msgs/msg/Point"](x=0.0, y=0.0, z=0.0),
            orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
        ),
        covariance=np.zeros(36),
    )
    head = header(stamp_ns, "camera")
    found = []
    for (x1, y1, x2, y2), scores in named:
        middle = vision("Point2D")(x=(x1 + x2) / 2, y=(y1 + y2) / 2)
        centre = vision("Pose2D")(position=middle, theta=theta)
        results = [
            vision("ObjectHypothesisWithPose")(
                hypothesis=vision("ObjectHypothesis")(class_id=name, score=score), pose=pose
            )
            for name, score in scores.items()
        ]
        box = vision("BoundingBox2D")(center=centre, size_x=x2 - x1, size_y=y2 - y1)
        found.append(vision("Detection2D")(header=head, results=results, bbox=box, id=""))
    return vision("Detection2DArray")(header=head, detections=found)


def named(found: Detections, classes: Sequence[str], *, full: bool) -> Named:
    """Detections with their whole distributions, or with one name and its score."""
    return [
        (
            box,
            dict(zip(classes, row.tolist()))
            if full
            else {classes[int(row.argmax())]: score},
        )
        for box, row, score in zip(
            found.boxes_xyxy.tolist(), found.class_probabilities, found.scores.tolist()
        )
    ]  # fmt: skip


def with_detections(recording: Path, sent: Mapping[int, RoleMessage]) -> Iterator[RawRoleMessage]:
    """The messages of a recording; those of each stamp are recorded a while after its image."""
    late: list[tuple[int, RoleMessage]] = []
    for raw in open_source(recording).raw_messages():
        while late and late[0][0] <= raw.log_time_ns:
            due_ns, message = late.pop(0)
            yield serialize(message, due_ns)
        yield raw
        if raw.role is Role.RGB and raw.stamp_ns in sent:
            late.append((raw.log_time_ns + DELAY_NS, sent[raw.stamp_ns]))
    for due_ns, message in late:
        yield serialize(message, due_ns)


def json_item(message: wire.DetectionsMessage) -> RoleMessage:
    """Our message as an item of a recording."""
    stamp_ns = wire.ns_from_stamp(message.stamp)
    return string_message(Role.DETECTIONS, stamp_ns, wire.encode(message))


def vision_item(named: Named, stamp_ns: int) -> RoleMessage:
    """A Detection2DArray as an item of a recording."""
    return RoleMessage(Role.DETECTIONS, DETECTIONS, stamp_ns, vision_message(named, stamp_ns))

"""Where a frame's time goes between its stamp and its update: marks in the processes of the nodes.

`python -m bench.latency --steps` starts the nodes with these marks and prints the times between
them.
"""

from __future__ import annotations

import functools
import pickle
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

# The marks of a frame, in the order of time; each ends the step of its name.
STEPS = (
    "image received (DDS)",
    "image taken",
    "frame complete",
    "waited for the stage",
    "decoded",
    "detected",
    "masks",
    "relations",
    "frame graph published",
    "frame graph taken",
    "lifting input complete",
    "waited for lifting",
    "depth decoded",
    "lifted",
    "local graph published",
    "local graph taken",
    "waited for the graph",
    "merged",
    "waited for the update",
    "update made",
    "update published",
)
Marks = dict[tuple[str, int], int]


class Marker:
    """Notes the time of the first mark of each name and stamp."""

    def __init__(self) -> None:
        self.marks: Marks = {}

    def mark(self, name: str, stamp_ns: int, at_ns: int | None = None) -> None:
        """Note that a frame has reached a step."""
        self.marks.setdefault((name, stamp_ns), time.time_ns() if at_ns is None else at_ns)

    def around(
        self, owner: Any, method: str, stamp_of: Callable[..., int], before: str, after: str
    ) -> None:
        """Mark the begin and the end of each call of a method; "" = no mark."""
        inner = getattr(owner, method)

        @functools.wraps(inner)
        def outer(*arguments: Any, **options: Any) -> Any:
            if before:
                self.mark(before, stamp_of(*arguments))
            result = inner(*arguments, **options)
            if after:
                self.mark(after, stamp_of(*arguments))
            return result

        setattr(owner, method, outer)

    def joining(self, owner: Any, begun: str, decoded: str, joined: str) -> None:
        """Mark the frames of an assembler: when complete, and around their decoding."""
        inner = owner._build

        def build(assembler: Any, stamp_ns: int, value: Any) -> Callable[[], Any]:
            self.mark(joined, stamp_ns)
            decode = inner(assembler, stamp_ns, value)

            def marked() -> Any:
                self.mark(begun, stamp_ns)
                frame = decode()
                self.mark(decoded, stamp_ns)
                return frame

            return marked

        owner._build = build


def mark_node(marker: Marker) -> None:
    """Put the marks into the classes of this process, before its node is made."""
    from deworldsg_ros.lifting.stage import Lifting
    from deworldsg_ros.nodes.lifting_node import LiftingNode
    from deworldsg_ros.nodes.segmentation_node import SegmentationNode
    from deworldsg_ros.perception.stage import Perception
    from deworldsg_ros.ros.graph_keeper import GraphKeeper
    from deworldsg_ros.ros.qos import AutoSubscription
    from deworldsg_ros.streams.frames import FrameAssembler, LiftingAssembler
    from deworldsg_ros.streams.poses import stamp_ns_of
    from deworldsg_ros.wire.messages import ns_from_stamp

    receive = AutoSubscription._receive

    def received(subscription: AutoSubscription, message: Any, info: dict[str, Any]) -> None:
        if subscription.topic.endswith("rgb/image_raw"):
            stamp_ns = stamp_ns_of(message)
            marker.mark("image received (DDS)", stamp_ns, info["received_timestamp"])
            marker.mark("image taken", stamp_ns)
        receive(subscription, message, info)

    AutoSubscription._receive = received  # type: ignore[method-assign]
    of_frame = lambda _, frame, *more: frame.stamp_ns  # noqa: E731
    marker.joining(FrameAssembler, "waited for the stage", "decoded", "frame complete")
    marker.around(Perception, "detect", of_frame, "", "detected")
    marker.around(Perception, "segment", of_frame, "", "masks")
    marker.around(Perception, "_perceive", of_frame, "", "relations")
    marker.around(SegmentationNode, "_segment", of_frame, "", "frame graph published")
    of_message = lambda _, message: ns_from_stamp(message.stamp)  # noqa: E731
    marker.around(LiftingNode, "_add_frame_graph", of_message, "frame graph taken", "")
    marker.joining(
        LiftingAssembler, "waited for lifting", "depth decoded", "lifting input complete"
    )
    marker.around(Lifting, "lift_frame", of_frame, "", "lifted")
    marker.around(
        LiftingNode, "_lift", lambda _, f: f.frame_graph.stamp_ns, "", "local graph published"
    )
    integrate = GraphKeeper.integrate
    merged: list[int] = []

    def integrated(keeper: GraphKeeper, local: Any) -> None:
        waited_ns = int(1e9 * (time.monotonic() - keeper._running_s))
        marker.mark("local graph taken", local.stamp_ns, time.time_ns() - waited_ns)
        marker.mark("waited for the graph", local.stamp_ns)
        integrate(keeper, local)
        marker.mark("merged", local.stamp_ns)
        merged.append(local.stamp_ns)

    def publish(keeper: GraphKeeper) -> None:
        stamps_ns, builder = list(merged), keeper._builder
        merged.clear()
        assert builder is not None
        for stamp_ns in stamps_ns:
            marker.mark("waited for the update", stamp_ns)
        update = builder.update

        def updated() -> Any:
            result = update()
            for stamp_ns in stamps_ns:
                marker.mark("update made", stamp_ns)
            return result

        builder.update = updated  # type: ignore[method-assign]
        publish_changes(keeper)
        builder.update = update  # type: ignore[method-assign]
        for stamp_ns in stamps_ns:
            marker.mark("update published", stamp_ns)

    publish_changes = GraphKeeper._publish_changes
    GraphKeeper.integrate = integrated  # type: ignore[method-assign]
    GraphKeeper._publish_changes = publish  # type: ignore[method-assign]


def write_marks(marker: Marker, path: Path) -> None:
    """Write the marks of a process."""
    path.write_bytes(pickle.dumps(marker.marks))


def read_marks(folder: Path) -> Marks:
    """The marks of all processes."""
    marks: Marks = {}
    for path in sorted(folder.glob("*.marks")):
        marks |= pickle.loads(path.read_bytes())
    return marks


def step_lines(marks: Mapping[tuple[str, int], int], arrived_ns: Mapping[int, int]) -> list[str]:
    """A line for each step: its milliseconds, and those since the stamp; median and 95 %.

    Args:
        marks: times by step and stamp.
        arrived_ns: when the update of each frame arrived, by its stamp.
    """
    before = {stamp_ns: stamp_ns for stamp_ns in arrived_ns}
    lines = [f"{'step':24} {'p50':>7} {'p95':>7} {'since the stamp':>16}"]
    ends = {name: {s: marks[name, s] for s in arrived_ns if (name, s) in marks} for name in STEPS}
    for name, end_ns in {**ends, "update received": arrived_ns}.items():
        if not end_ns:
            continue
        took = np.array([1e-6 * (at_ns - before[s]) for s, at_ns in end_ns.items()])
        since = np.array([1e-6 * (at_ns - s) for s, at_ns in end_ns.items()])
        lines.append(
            f"{name:24} {np.median(took):7.1f} {np.percentile(took, 95):7.1f} "
            f"{np.median(since):16.1f}"
        )
        before |= end_ns
    return lines

"""Observations of a run or of running nodes. A source leaves out what it does not know."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class FrameChecks:
    """Measured on a few frames of a recording.

    Attributes:
        valid_depth: median part of the pixels with a valid depth.
        depth_shift_px: columns and rows by which depth is moved against colour, where their edges
            agree best.
        shift_gain: by how much the edges agree better there than without a shift; 0 = not at all,
            1 = completely.
        fits: part of the depth that agrees between two frames, by the assumption about the poses;
            ``given`` is that of the poses as they are. Empty if no two frames overlap.
        travel_m: diagonal of the box around the positions of the camera.
        turn_deg: largest angle between two viewing directions.
    """

    valid_depth: float
    depth_shift_px: tuple[float, float] = (0.0, 0.0)
    shift_gain: float = 0.0
    fits: Mapping[str, float] = field(default_factory=dict)
    travel_m: float = 0.0
    turn_deg: float = 0.0


@dataclass(frozen=True)
class Observations:
    """What is known about a run.

    Attributes:
        images: RGB images that arrived; None = not known.
        frames: frames that reached the graph.
        drops: dropped messages, frames and clips, by reason.
        examples: an example of a drop, by reason.
        nodes: published nodes; None = not known.
        hidden: nodes that are not published, by reason, in words.
        detections: objects found in all frames; None = not known.
        classes: classes that the detector knows.
        sizes: label and longest side in metres of each node.
        turns: frames by the quarter turns that made them upright.
        checks: of a few frames; None = not made.
        missing: inputs that nodes wait for, in words.
        silent: topics without a publisher that a node subscribes to; each with the published
            topics of the same type.
        incompatible: topics whose publisher and subscriber never match in QoS, in words.
        behind_s: seconds from the stamp of a topic's newest message to the clock.
        found_nodes: whether nodes of this package run; None = it was not looked for.
    """

    images: int | None = None
    frames: int | None = None
    drops: Mapping[str, int] = field(default_factory=dict)
    examples: Mapping[str, str] = field(default_factory=dict)
    nodes: int | None = None
    hidden: Mapping[str, int] = field(default_factory=dict)
    detections: int | None = None
    classes: tuple[str, ...] = ()
    sizes: tuple[tuple[str, float], ...] = ()
    turns: Mapping[int, int] = field(default_factory=dict)
    checks: FrameChecks | None = None
    missing: tuple[str, ...] = ()
    silent: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    incompatible: tuple[str, ...] = ()
    behind_s: Mapping[str, float] = field(default_factory=dict)
    found_nodes: bool | None = None

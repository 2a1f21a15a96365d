"""Observations of a run, and checks of a few frames: do depth, colour and poses agree?"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import cv2
import numpy as np

from deworldsg_ros.scene.arrays import Float32, Float64, UInt8
from deworldsg_ros.scene.camera import Intrinsics, RgbdFrame, interpolate_pose, invert_pose

# --- Observations of a run or of running nodes. A source leaves out what it does not know.


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
    """Observations of a run.

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
        unused_detector: folder of a stronger detector than the embedded one, which was used; "" =
            none.
        its_settings: options that use it.
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
    unused_detector: str = ""
    its_settings: str = ""


# --- Checks of a few frames: do depth and colour agree, and do the poses fit the images?
#
# All images are taken at half of their resolution.

# Pairs of frames that are kept: enough for a median, and 10 MB.
MAX_PAIRS = 12
# Between the two frames of a pair: a hand-held camera moves some centimetres.
GAP_NS = 300_000_000
FIRST_PERIOD_NS = 10**9
# Edges of depth and colour are compared up to this shift, in half pixels of the image.
MOST_SHIFT = 20
# Farther than this, an edge has no counterpart.
MOST_DISTANCE = 6.0
# Relative step between two pixels that is an edge of depth; noise and slopes stay below.
DEPTH_STEP = 0.08
# Fewer edge pixels in all frames together give no answer.
MIN_EDGES = 400
# Points of a frame that are looked for in the other one; depths agree within this part.
POINT_STRIDE = 6
AGREEMENT = 0.04
MIN_OVERLAP = 100

# T_body_optical: x of the body is forward, y left, z up (REP 103).
BODY_TO_OPTICAL = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
DELAYS_S = (-0.4, -0.2, -0.1, 0.1, 0.2, 0.4)
DEPTH_FACTORS = (0.1, 0.2, 5.0, 10.0)
GIVEN, STILL, BODY, INVERSE = "given", "still", "body", "inverse"
LATE, FACTOR = "late ", "factor "


@dataclass(frozen=True)
class _Small:
    """A frame at half of its resolution: grey (h, w) uint8, depth (h, w) float32 in metres."""

    stamp_ns: int
    grey: UInt8
    depth_m: Float32
    intrinsics: Intrinsics
    T_world_camera: Float64


class FrameSampler:
    """Takes the frames of a run in order, keeps a few pairs of them, and checks these."""

    def __init__(self) -> None:
        self._pairs: list[tuple[_Small, _Small]] = []
        self._first: _Small | None = None
        self._period_ns = FIRST_PERIOD_NS
        self._next_ns = -(2**62)
        self._poses: list[tuple[int, Float64]] = []

    def add(self, frame: RgbdFrame) -> None:
        """Note a frame."""
        self._poses.append((frame.stamp_ns, frame.T_world_camera))
        if self._first is None:
            if frame.stamp_ns >= self._next_ns:
                self._first = _small(frame)
                self._next_ns = frame.stamp_ns + self._period_ns
        elif frame.stamp_ns - self._first.stamp_ns >= GAP_NS:
            self._pairs.append((self._first, _small(frame)))
            self._first = None
            if len(self._pairs) > MAX_PAIRS:
                self._pairs = self._pairs[::2]
                self._period_ns *= 2

    def checks(self) -> FrameChecks | None:
        """The results; None before the first frame."""
        frames = [frame for pair in self._pairs for frame in pair]
        frames += [self._first] if self._first is not None else []
        if not frames:
            return None
        shift_px, gain = depth_shift(frames)
        T = np.array([T for _, T in self._poses])
        directions = T[:, :3, 2]
        return FrameChecks(
            valid_depth=float(np.median([np.mean(frame.depth_m > 0) for frame in frames])),
            depth_shift_px=shift_px,
            shift_gain=gain,
            fits=self._fits(),
            travel_m=float(np.linalg.norm(np.ptp(T[:, :3, 3], axis=0))),
            turn_deg=float(np.degrees(np.arccos(np.clip(directions @ directions[0], -1, 1)).max())),
        )

    def _fits(self) -> dict[str, float]:
        """Mean agreement of the pairs under each assumption."""
        assumed: dict[str, Callable[[_Small], Float64 | None]] = {
            GIVEN: lambda frame: frame.T_world_camera,
            STILL: lambda frame: np.eye(4),
            BODY: lambda frame: frame.T_world_camera @ BODY_TO_OPTICAL,
            INVERSE: lambda frame: invert_pose(frame.T_world_camera),
        }
        for delay_s in DELAYS_S:
            assumed[f"{LATE}{delay_s:g}"] = partial(self._pose_at, delay_s)
        fits = {name: self._fit(pose_of) for name, pose_of in assumed.items()}
        for factor in DEPTH_FACTORS:
            fits[f"{FACTOR}{factor:g}"] = self._fit(assumed[GIVEN], factor)
        known = {name: fit for name, fit in fits.items() if fit is not None}
        return known if GIVEN in known else {}

    def _fit(
        self, pose_of: Callable[[_Small], Float64 | None], factor: float = 1.0
    ) -> float | None:
        found = [agreement(a, b, pose_of(a), pose_of(b), factor) for a, b in self._pairs]
        values = [value for value in found if value is not None]
        return float(np.mean(values)) if values else None

    def _pose_at(self, delay_s: float, frame: _Small) -> Float64 | None:
        """The pose that came `delay_s` after a frame; None outside of the recording."""
        stamps = [stamp for stamp, _ in self._poses]
        at_ns = frame.stamp_ns + round(1e9 * delay_s)
        after = int(np.searchsorted(stamps, at_ns))
        if not 0 < after < len(stamps):
            return None
        (t_a, T_a), (t_b, T_b) = self._poses[after - 1], self._poses[after]
        return interpolate_pose(T_a, T_b, (at_ns - t_a) / (t_b - t_a))


def _small(frame: RgbdFrame) -> _Small:
    i = frame.intrinsics
    depth_m = frame.depth_m[::2, ::2].copy()
    grey = cv2.cvtColor(np.ascontiguousarray(frame.rgb[::2, ::2]), cv2.COLOR_RGB2GRAY)
    half = Intrinsics(i.fx / 2, i.fy / 2, i.cx / 2, i.cy / 2, depth_m.shape[1], depth_m.shape[0])
    return _Small(frame.stamp_ns, np.asarray(grey, np.uint8), depth_m, half, frame.T_world_camera)


def depth_shift(frames: Sequence[_Small]) -> tuple[tuple[float, float], float]:
    """Shift of depth against colour in pixels of the image, and how much better edges agree there.

    The cost of a shift is the mean distance from edges of depth to edges of colour.
    """
    side = 2 * MOST_SHIFT + 1
    cost, edges = np.zeros((side, side)), 0.0
    for frame in frames:
        depth_edges = _depth_edges(frame.depth_m)
        colour_edges = cv2.Canny(cv2.GaussianBlur(frame.grey, (3, 3), 0), 40, 120)
        distance = cv2.distanceTransform(255 - colour_edges, cv2.DIST_L2, 3)
        distance = np.minimum(distance, MOST_DISTANCE).astype(np.float32)
        inside = depth_edges[MOST_SHIFT:-MOST_SHIFT, MOST_SHIFT:-MOST_SHIFT]
        if min(inside.shape, default=0) > 0:
            cost += cv2.matchTemplate(distance, inside.astype(np.float32), cv2.TM_CCORR)
            edges += float(inside.sum())
    if edges < MIN_EDGES:
        return (0.0, 0.0), 0.0
    row, column = np.unravel_index(int(cost.argmin()), cost.shape)
    here = cost[MOST_SHIFT, MOST_SHIFT]
    gain = float(1 - cost[row, column] / here) if here > 0 else 0.0
    # An edge of depth at p matches colour at p + shift: depth is moved by the opposite.
    return (2.0 * (MOST_SHIFT - column), 2.0 * (MOST_SHIFT - row)), gain


def _depth_edges(depth_m: Float32) -> UInt8:
    """(h, w) uint8: 1 on the nearer pixel of each step between two valid depths."""
    edges = np.zeros(depth_m.shape, np.uint8)
    for axis in (0, 1):
        first = depth_m[:-1] if axis == 0 else depth_m[:, :-1]
        second = depth_m[1:] if axis == 0 else depth_m[:, 1:]
        valid = (first > 0) & (second > 0)
        step = valid & (np.abs(first - second) > DEPTH_STEP * np.minimum(first, second))
        near = edges[:-1] if axis == 0 else edges[:, :-1]
        far = edges[1:] if axis == 0 else edges[:, 1:]
        near |= step & (first < second)
        far |= step & (second < first)
    return edges


def agreement(
    a: _Small,
    b: _Small,
    T_world_a: Float64 | None,
    T_world_b: Float64 | None,
    factor: float = 1.0,
) -> float | None:
    """Part of the points of `a` that are at the depth that `b` measured there.

    None if too few points are in both images, or a pose is missing. All depths are multiplied by
    the factor.
    """
    if T_world_a is None or T_world_b is None:
        return None
    rows, columns = np.mgrid[
        : a.depth_m.shape[0] : POINT_STRIDE, : a.depth_m.shape[1] : POINT_STRIDE
    ]
    z = a.depth_m[rows, columns].astype(np.float64)
    rows, columns, z = rows[z > 0], columns[z > 0], factor * z[z > 0]
    T_b_a = invert_pose(T_world_b) @ T_world_a
    points = a.intrinsics.back_project(columns, rows, z) @ T_b_a[:3, :3].T + T_b_a[:3, 3]
    points = points[points[:, 2] > 1e-3]
    u, v = np.rint(b.intrinsics.project(points)).T
    height, width = b.depth_m.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    measured = factor * b.depth_m[v[inside].astype(int), u[inside].astype(int)].astype(np.float64)
    expected = points[inside, 2][measured > 0]
    measured = measured[measured > 0]
    if len(z) == 0 or len(measured) < MIN_OVERLAP:
        # Poses that lead out of the image disagree; a frame without depth says nothing.
        return 0.0 if len(z) >= MIN_OVERLAP else None
    return float(np.mean(np.abs(measured - expected) <= AGREEMENT * measured))

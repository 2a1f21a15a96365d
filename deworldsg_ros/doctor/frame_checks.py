"""Observations of a run, and checks of a few frames: do depth, colour and poses agree?"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
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
        fits: part of the depth that agrees between two frames a moment apart, by the assumption
            about the poses; ``given`` is that of the poses as they are. Empty if no two overlap.
        wide: the same of frames from different places, also by factors of depth and of the focal
            length.
        zoom_gain: by how much edges of depth and colour agree better if depth has the focal length
            that fits best, and colour has its own.
        travel_m: diagonal of the box around the positions of the camera.
        turn_deg: largest angle between two viewing directions.
    """

    valid_depth: float
    depth_shift_px: tuple[float, float] = (0.0, 0.0)
    shift_gain: float = 0.0
    fits: Mapping[str, float] = field(default_factory=dict)
    wide: Mapping[str, float] = field(default_factory=dict)
    zoom_gain: float = 0.0
    travel_m: float = 0.0
    turn_deg: float = 0.0


@dataclass(frozen=True)
class Header:
    """What the first message of a stream says.

    Attributes:
        topic: its name.
        frame_id: frame of the message.
        size: columns and rows of an image.
        encoding: of an image.
        intrinsics: of a camera_info; of depth, of that beside the depth images.
        middle_m: median of the depths that are not 0, in metres, with the settings of the run.
    """

    topic: str
    frame_id: str = ""
    size: tuple[int, int] | None = None
    encoding: str = ""
    intrinsics: Intrinsics | None = None
    middle_m: float | None = None


@dataclass(frozen=True)
class Observations:
    """Observations of a run.

    Attributes:
        headers: first messages, by the role of the stream: rgb, depth, camera_info.
        images: RGB images that arrived; None = not known.
        frames: frames that reached the graph.
        drops: dropped messages, frames and clips, by reason.
        examples: an example of a drop, by reason.
        remedies: what a reason means and what to do, by reason.
        nodes: published nodes; None = not known.
        hidden: nodes that are not published, by reason, in words.
        detections: objects found in all frames; None = not known.
        classes: classes that the detector knows.
        sizes: label and longest side in metres of each node.
        turns: frames by the quarter turns that made them upright.
        up_world: up that was estimated from the poses, x, y, z; empty = it was given.
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

    headers: Mapping[str, Header] = field(default_factory=dict)
    images: int | None = None
    frames: int | None = None
    drops: Mapping[str, int] = field(default_factory=dict)
    examples: Mapping[str, str] = field(default_factory=dict)
    remedies: Mapping[str, str] = field(default_factory=dict)
    nodes: int | None = None
    hidden: Mapping[str, int] = field(default_factory=dict)
    detections: int | None = None
    classes: tuple[str, ...] = ()
    sizes: tuple[tuple[str, float], ...] = ()
    turns: Mapping[int, int] = field(default_factory=dict)
    up_world: tuple[float, ...] = ()
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
# Frames from other places: so far apart, and at most so many. Each is compared with the next ones.
KEY_STEP_M, KEY_STEP_DEG = 0.2, 12.0
MAX_KEYS, MOST_AHEAD, MAX_WIDE = 16, 4, 24
WIDE_STEPS = 0.5, 3.0
# Depths of frames from other places agree within this part: a factor of 0.9 is to be seen.
WIDE_AGREEMENT = 0.015
# Between the two frames of a pair: a hand-held camera moves some centimetres.
GAP_NS = 300_000_000
FIRST_PERIOD_NS = 10**9
# Edges of depth and colour are compared up to this shift, in half pixels of the image.
MOST_SHIFT = 20
# Farther than this, an edge has no counterpart.
MOST_DISTANCE = 6.0
# Relative step between two pixels that is an edge of depth; noise and slopes stay below.
DEPTH_STEP = 0.08
# The widest hole beside an edge, in half pixels of the image.
MOST_HOLE = 4
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
# T_opengl_optical: x of OpenGL's camera is right, y up, z backward. ARKit and Unity use it.
OPENGL_TO_OPTICAL = np.diag([1.0, -1.0, -1.0, 1.0])
DELAYS_S = (-0.4, -0.2, -0.1, 0.1, 0.2, 0.4)
# Factors that are tried, and finer ones around the best.
TENS = (0.001, 0.1, 0.2, 5.0, 10.0, 1000.0)
DEPTH_FACTORS = (*TENS, 0.5, 0.65, 0.75, 0.85, 0.93, 1.07, 1.17, 1.33, 1.55, 2.0)
FOCAL_FACTORS = (0.5, 0.6, 0.7, 0.8, 0.9, 1.1, 1.25, 1.45, 1.7, 2.0)
FINER = (0.91, 0.95, 0.975, 1.025, 1.05, 1.1)
# A smaller change is within the errors of sensors.
LEAST_CHANGE = 1.06
GIVEN, STILL, BODY, INVERSE, OPENGL = "given", "still", "body", "inverse", "opengl"
LATE, FACTOR, FOCAL = "late ", "factor ", "focal "


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
        self._keys: list[_Small] = []
        self._steps = 1.0

    def add(self, frame: RgbdFrame) -> None:
        """Note a frame."""
        self._poses.append((frame.stamp_ns, frame.T_world_camera))
        if not self._keys or _steps(self._keys[-1], frame.T_world_camera) >= self._steps:
            self._keys.append(_small(frame))
            if len(self._keys) > MAX_KEYS:
                self._keys = self._keys[::2]
                self._steps *= 2
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
        frames += [*self._keys, *([self._first] if self._first is not None else [])]
        if not frames:
            return None
        shift_px, gain = depth_shift(frames)
        wide = self._wide_fits()
        focal = best_factor(wide, FOCAL)
        T = np.array([T for _, T in self._poses])
        directions = T[:, :3, 2]
        return FrameChecks(
            valid_depth=float(np.median([np.mean(frame.depth_m > 0) for frame in frames])),
            depth_shift_px=shift_px,
            shift_gain=gain,
            fits=self._fits(),
            wide=wide,
            zoom_gain=0.0 if focal is None else zoom_gain(frames, focal),
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
            OPENGL: lambda frame: frame.T_world_camera @ OPENGL_TO_OPTICAL,
        }
        for delay_s in DELAYS_S:
            assumed[f"{LATE}{delay_s:g}"] = partial(self._pose_at, delay_s)
        fits = {name: self._fit(pose_of) for name, pose_of in assumed.items()}
        known = {name: fit for name, fit in fits.items() if fit is not None}
        return known if GIVEN in known else {}

    def _fit(self, pose_of: Callable[[_Small], Float64 | None]) -> float | None:
        return _mean(agreement(a, b, pose_of(a), pose_of(b)) for a, b in self._pairs)

    def _wide_fits(self) -> dict[str, float]:
        """Mean agreement of frames from different places under each assumption."""
        pairs = [
            (a, b)
            for index, a in enumerate(self._keys)
            for b in self._keys[index + 1 : index + 1 + MOST_AHEAD]
        ]
        # Of single pictures, two moments are two places.
        steps = [(_steps(a, b.T_world_camera), a, b) for a, b in (*pairs, *self._pairs)]
        steps = [item for item in steps if WIDE_STEPS[0] <= item[0] <= WIDE_STEPS[1]]
        steps.sort(key=lambda item: -item[0])
        pairs = [(a, b) for _, a, b in steps[:MAX_WIDE]]

        def fit(pose_of: Callable[[_Small], Float64], factor: float, focal: float) -> float | None:
            return _mean(
                agreement(
                    _zoomed(a, focal),
                    _zoomed(b, focal),
                    pose_of(a),
                    pose_of(b),
                    factor,
                    WIDE_AGREEMENT,
                )
                for a, b in pairs
            )

        def given(frame: _Small) -> Float64:
            return frame.T_world_camera

        fits = {
            GIVEN: fit(given, 1.0, 1.0),
            STILL: fit(lambda frame: np.eye(4), 1.0, 1.0),
            BODY: fit(lambda frame: frame.T_world_camera @ BODY_TO_OPTICAL, 1.0, 1.0),
            INVERSE: fit(lambda frame: invert_pose(frame.T_world_camera), 1.0, 1.0),
        }
        for name, factors in ((FACTOR, DEPTH_FACTORS), (FOCAL, FOCAL_FACTORS)):
            tried: dict[float, float | None] = {}
            for factor in factors:
                tried[factor] = fit(given, *((factor, 1.0) if name == FACTOR else (1.0, factor)))
            best = max(tried, key=lambda factor: tried[factor] or 0.0)
            for finer in FINER:
                factor = best * finer
                tried[factor] = fit(given, *((factor, 1.0) if name == FACTOR else (1.0, factor)))
            fits |= {f"{name}{factor:.3g}": value for factor, value in tried.items()}
        known = {name: value for name, value in fits.items() if value is not None}
        return known if GIVEN in known else {}

    def _pose_at(self, delay_s: float, frame: _Small) -> Float64 | None:
        """The pose that came `delay_s` after a frame; None outside of the recording."""
        stamps = [stamp for stamp, _ in self._poses]
        at_ns = frame.stamp_ns + round(1e9 * delay_s)
        after = int(np.searchsorted(stamps, at_ns))
        if not 0 < after < len(stamps):
            return None
        (t_a, T_a), (t_b, T_b) = self._poses[after - 1], self._poses[after]
        return interpolate_pose(T_a, T_b, (at_ns - t_a) / (t_b - t_a))


def best_factor(fits: Mapping[str, float], kind: str) -> float | None:
    """The factor of depth (FACTOR) or focal length (FOCAL) that fits best; None = no change."""
    of_kind = {name: fit for name, fit in fits.items() if name.startswith(kind)}
    if not of_kind:
        return None
    factor = float(max(of_kind, key=lambda name: of_kind[name])[len(kind) :])
    return None if 1 / LEAST_CHANGE < factor < LEAST_CHANGE else factor


def _steps(frame: _Small, T_world_camera: Float64) -> float:
    """How far a pose is from that of a frame: 1 = a step of a key frame."""
    T = invert_pose(frame.T_world_camera) @ T_world_camera
    turn_deg = float(np.degrees(np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1))))
    return max(float(np.linalg.norm(T[:3, 3])) / KEY_STEP_M, turn_deg / KEY_STEP_DEG)


def _zoomed(frame: _Small, factor: float) -> _Small:
    """The frame, with another focal length."""
    i = frame.intrinsics
    zoomed = Intrinsics(factor * i.fx, factor * i.fy, i.cx, i.cy, i.width, i.height)
    return frame if factor == 1.0 else replace(frame, intrinsics=zoomed)


def _mean(fits: Iterable[float | None]) -> float | None:
    values = [fit for fit in fits if fit is not None]
    return float(np.mean(values)) if values else None


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
        inside = _depth_edges(frame.depth_m)[MOST_SHIFT:-MOST_SHIFT, MOST_SHIFT:-MOST_SHIFT]
        if min(inside.shape, default=0) > 0:
            distance = _colour_distance(frame.grey)
            cost += cv2.matchTemplate(distance, inside.astype(np.float32), cv2.TM_CCORR)
            edges += float(inside.sum())
    if edges < MIN_EDGES:
        return (0.0, 0.0), 0.0
    row, column = np.unravel_index(int(cost.argmin()), cost.shape)
    here = cost[MOST_SHIFT, MOST_SHIFT]
    gain = float(1 - cost[row, column] / here) if here > 0 else 0.0
    # An edge of depth at p matches colour at p + shift: depth is moved by the opposite.
    return (2.0 * (MOST_SHIFT - int(column)), 2.0 * (MOST_SHIFT - int(row))), gain


def zoom_gain(frames: Sequence[_Small], factor: float) -> float:
    """How much better edges of depth agree with those of colour if depth has another focal length.

    0 = not at all, 1 = completely. The factor is that of the focal length of depth.
    """
    sums = np.zeros((2, 2))
    for frame in frames:
        i, distance = frame.intrinsics, _colour_distance(frame.grey)
        for row, zoom in enumerate((1.0, 1.0 / factor)):
            turn = np.array([[zoom, 0, i.cx * (1 - zoom)], [0, zoom, i.cy * (1 - zoom)]])
            edges = cv2.warpAffine(
                _depth_edges(frame.depth_m), turn, distance.shape[::-1], flags=cv2.INTER_NEAREST
            )
            sums[row] += (distance[edges > 0].sum(), (edges > 0).sum())
    if sums[:, 1].min() < MIN_EDGES or sums[0, 0] == 0:
        return 0.0
    here, zoomed = sums[:, 0] / sums[:, 1]
    return float(1 - zoomed / here)


def _colour_distance(grey: UInt8) -> Float32:
    """(h, w) distance of each pixel to the nearest edge of the picture, at most MOST_DISTANCE."""
    edges = cv2.Canny(cv2.GaussianBlur(grey, (3, 3), 0), 40, 120)
    distance = cv2.distanceTransform(255 - edges, cv2.DIST_L2, 3)
    return np.minimum(distance, MOST_DISTANCE).astype(np.float32)


def _depth_edges(depth_m: Float32) -> UInt8:
    """(h, w) uint8: 1 on the nearer pixel of each step between two valid depths.

    Between them may be pixels without depth: many sensors have none beside an edge.
    """
    edges = np.zeros(depth_m.shape, np.uint8)
    for axis, apart in itertools.product((0, 1), range(1, MOST_HOLE + 2)):
        lines = depth_m if axis == 0 else depth_m.T
        first, second = lines[:-apart], lines[apart:]
        step = (first > 0) & (second > 0)
        step &= np.abs(first - second) > DEPTH_STEP * np.minimum(first, second)
        for between in range(1, apart):
            step &= lines[between : len(lines) - apart + between] == 0
        marked = edges if axis == 0 else edges.T
        marked[:-apart] |= step & (first < second)
        marked[apart:] |= step & (second < first)
    return edges


def agreement(
    a: _Small,
    b: _Small,
    T_world_a: Float64 | None,
    T_world_b: Float64 | None,
    factor: float = 1.0,
    tolerance: float = AGREEMENT,
) -> float | None:
    """Part of the points of `a` that are at the depth that `b` measured there.

    None if too few points are in both images, or a pose is missing. All depths are multiplied by
    the factor; they agree within the tolerance, a part of them.
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
    return float(np.mean(np.abs(measured - expected) <= tolerance * measured))

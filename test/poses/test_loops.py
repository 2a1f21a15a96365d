"""Closed loops: the graph of poses, what closes a loop and what does not, and the objects."""

from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from support.corner_room import camera_at, corner_frame
from support.spaces import looking

from bench.odometry import false_loops, mirrored
from deworldsg_ros.config import Config
from deworldsg_ros.perception.stage import Perceived
from deworldsg_ros.pipeline import Pipeline
from deworldsg_ros.poses import loops
from deworldsg_ros.poses.drift import SurfelMap
from deworldsg_ros.poses.loops import (
    Edges,
    LoopOdometry,
    closings_in_words,
    fit_of,
    robust_weights,
    solve,
)
from deworldsg_ros.poses.odometry import NO_FEATURES
from deworldsg_ros.scene.camera import (
    Intrinsics,
    RgbdFrame,
    invert_pose,
    invert_poses,
    rigid_motion,
)
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import FrameGraph, Relations, Vocabulary
from deworldsg_ros.wire.follow import GraphReplica

SIGMAS = 0.002, 0.005


def noise(rng, count, sigmas=SIGMAS):
    return np.array([
        rigid_motion(sigmas[1] * rng.normal(size=3), sigmas[0] * rng.normal(size=3))
        for _ in range(count)
    ])  # fmt: skip


def circle(count, rng, outliers=0):
    """True poses on a circle, odometry that drifts, and its edges with three loops."""
    angles = np.linspace(0.0, 360.0, count, endpoint=False)
    x, y = 2.0 * np.cos(np.radians(angles)), 2.0 * np.sin(np.radians(angles))
    true = np.array([camera_at(*pose) for pose in zip(angles, x, y)])
    a = np.array([*range(count - 1), 0, 1, 2])
    b = np.array([*range(1, count), count - 1, count - 2, count - 1])
    T = invert_poses(true[a]) @ true[b] @ noise(rng, len(a))
    for _ in range(outliers):
        a, b = np.append(a, 1), np.append(b, count // 2)
        T = np.append(T, [rigid_motion(np.array([0.0, 3.0, 0.0]), np.array([0.0, 1.0, 0.0]))], 0)
    start = [true[0]]
    for step in T[: count - 1]:
        start.append(start[-1] @ step)
    edges = Edges(a, b, T, np.full((len(a), 2), SIGMAS), np.arange(len(a)) >= count - 1)
    return true, np.array(start), edges


def slow(start, edges):
    """The same sum of squares, by a dense solver without derivatives."""

    def poses(x):
        x = x.reshape(-1, 6)
        return [start[0], *(T @ rigid_motion(s[3:], s[:3]) for T, s in zip(start[1:], x))]

    def residuals(x):
        T, found = poses(x), []
        for a, b, measured, (rad, metre) in zip(*edges[:4]):
            error = invert_pose(measured) @ invert_pose(T[a]) @ T[b]
            turn = Rotation.from_matrix(error[:3, :3]).as_rotvec()
            found += [*(turn / rad), *(error[:3, 3] / metre)]
        return np.array(found)

    found = least_squares(residuals, np.zeros(6 * (len(start) - 1)), xtol=1e-12, ftol=1e-12)
    return np.array(poses(found.x))


def apart(a, b):
    return np.abs(a - b).max()


def test_the_graph_of_poses_equals_a_slow_dense_solver():
    _, start, edges = circle(7, np.random.default_rng(3))
    start = start @ noise(np.random.default_rng(4), 7, (0.05, 0.1))
    assert apart(solve(start, edges, "none"), slow(start, edges)) < 1e-6


@settings(max_examples=4, deadline=None)
@given(st.integers(0, 10**6))
def test_it_depends_neither_on_the_frame_nor_on_the_order_of_the_edges(seed):
    rng = np.random.default_rng(seed)
    _, start, edges = circle(9, rng, outliers=1)
    found = solve(start, edges)
    np.testing.assert_array_equal(found[0], start[0])
    G = rigid_motion(rng.normal(size=3), rng.normal(size=3))
    assert apart(solve(G @ start, edges), G @ found) < 1e-4
    order = rng.permutation(len(edges.a))
    assert apart(solve(start, Edges(*(values[order] for values in edges))), found) < 1e-4


def test_a_wrong_loop_does_not_move_the_others():
    true, start, edges = circle(24, np.random.default_rng(5), outliers=1)
    right = Edges(*(values[:-1] for values in edges))
    moved_m = {}
    for kernel in ("cauchy", "huber", "none"):
        moved = solve(start, edges, kernel) - solve(start, right, kernel)
        moved_m[kernel] = np.linalg.norm(moved[:, :3, 3], axis=1).max()
    assert moved_m["cauchy"] < 0.02 < 0.5 < moved_m["none"]
    assert moved_m["huber"] < 0.6 * moved_m["none"]
    closed = solve(start, right)
    assert np.abs(closed - true)[:, :3, 3].max() < np.abs(start - true)[:, :3, 3].max()


def test_weights_fall_beyond_the_limit():
    squared = np.array([0.0, 1.0, 9.0, 900.0])
    np.testing.assert_allclose(robust_weights(squared, 3.0, "none"), 1.0)
    np.testing.assert_allclose(robust_weights(squared, 3.0, "huber"), [1, 1, 1, 0.1])
    np.testing.assert_allclose(robust_weights(squared, 3.0, "cauchy"), [1, 0.9, 0.5, 1 / 101])


# --- What a camera sees of boxes, from inside of the first one.

CAMERA = Intrinsics(120.0, 120.0, 79.5, 59.5, 160, 120)
Boxes = Sequence[tuple[Sequence[float], Sequence[float]]]


def look(boxes: Boxes, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth (120, 160), metres, and which box each pixel shows."""
    v, u = np.mgrid[:120, :160]
    rays = CAMERA.back_project(u, v, np.ones(u.shape)) @ T[:3, :3].T
    depth, shows = np.full(u.shape, np.inf), np.zeros(u.shape, np.uint16)
    for row, corners in enumerate(boxes):
        with np.errstate(divide="ignore", invalid="ignore"):
            sides = np.sort([(np.array(c) - T[:3, 3]) / rays for c in corners], axis=0)
        enters, leaves = sides[0].max(axis=-1), sides[1].min(axis=-1)
        at = leaves if row == 0 else np.where((enters < leaves) & (enters > 0.1), enters, np.inf)
        shows[at < depth] = row
        depth = np.minimum(depth, at)
    return depth.astype(np.float32), shows


def fit_in(boxes: Boxes, T: np.ndarray, off: np.ndarray):
    """How the surfels of a view fit the same view under a pose that is off."""
    depth_m, _ = look(boxes, T)
    surfels, grid = SurfelMap(), loops._grid(depth_m, CAMERA)
    for _ in range(2):
        surfels.register(T, grid)
        surfels.add(T)
    return fit_of(surfels.rows, off @ T, grid)


CORRIDOR = [((-20.0, -0.7, 0.0), (20.0, 0.7, 2.2))]
ROOM = [((-2.0, -1.5, 0.0), (2.0, 1.5, 2.5)), ((0.5, -0.3, 0.0), (1.1, 0.3, 0.8))]
NOT_OFF = np.eye(4)


def test_a_room_closes_a_loop_and_neither_a_wall_nor_a_corridor_does():
    room = fit_in(ROOM, looking((-1.0, -0.5, 1.3), 20.0), NOT_OFF)
    assert room.is_loop and room.on == 1.0 and room.residual_m < 0.005
    wall = fit_in(ROOM, looking((-1.0, 0.0, 1.5), 180.0, 0.0), NOT_OFF)
    corridor = fit_in(CORRIDOR, looking((0.0, 0.1, 1.2), 0.0, 5.0), NOT_OFF)
    for open_along in (wall, corridor):
        assert open_along.held[0] < 1e-3 and not open_along.is_loop
    # A pose is corrected across the corridor, and not along it.
    T = looking((0.0, 0.1, 1.2), 0.0, 5.0)
    fitted = rigid_motion(np.array([0.2, 0.05, 0.0]), np.zeros(3)) @ T
    moved = corridor.limited(T, fitted)[:3, 3] - T[:3, 3]
    np.testing.assert_allclose(moved, [0.0, 0.05, 0.0], atol=2e-3)


def test_what_is_seen_through_or_stands_elsewhere_closes_no_loop():
    T = looking((-1.0, -0.5, 1.3), 20.0)
    for shift_m in ((0.1, 0.0, 0.0), (0.0, 0.0, 0.15)):
        fit = fit_in(ROOM, T, rigid_motion(np.array(shift_m), np.zeros(3)))
        assert fit is None or not fit.is_loop
    assert fit_of(np.zeros((0, 8)), T, loops._grid(look(ROOM, T)[0], CAMERA)) is None


# --- A camera that turns in a room, under odometry that drifts.

HALL = [((-2.6, -2.2, 0.0), (2.6, 2.2, 2.5))]
THINGS = [
    ("bed", (1.4, -1.0, 0.0), (2.55, 0.6, 0.6)),
    ("chair", (0.9, 1.5, 0.0), (1.4, 2.0, 0.9)),
    ("table", (-0.9, 1.3, 0.0), (0.3, 2.1, 0.75)),
    ("shelf", (-2.55, -0.4, 0.0), (-2.2, 0.8, 1.7)),
    ("table", (-1.9, -2.1, 0.0), (-0.9, -1.5, 0.7)),
    ("chair", (0.1, -2.0, 0.0), (0.6, -1.5, 0.9)),
]
SCENE = [*HALL, *((low, high) for _, low, high in THINGS)]
CLASSES = ("bed", "chair", "table", "shelf")
STEP_NS = 10**8
VOCABULARY = Vocabulary(CLASSES, ("on",))


def turning() -> np.ndarray:
    """A turn on a small circle, and a part of it again."""
    angles = np.linspace(0.0, 400.0, 100)
    x, y = 0.4 * np.cos(np.radians(angles)), 0.4 * np.sin(np.radians(angles))
    return np.array([looking((*at, 1.3), angle, 22.0) for *at, angle in zip(x, y, angles)])


TRUE = turning()


@cache
def seen(number: int) -> tuple[np.ndarray, np.ndarray]:
    """Depth, and what each pixel shows, of a frame of the turn."""
    return look(SCENE, TRUE[number])


class Drifting:
    """Odometry whose error grows evenly with the frames."""

    def __init__(self, shift_m: float, turn_deg: float) -> None:
        self.restarts, self.features = 0, NO_FEATURES
        self.size, self.count = (shift_m, np.radians(turn_deg)), 0

    def track(self, rgb, depth_m, intrinsics):
        part = self.count / (len(TRUE) - 1)
        shift = np.array([0.8, -0.6, 0.0]) * self.size[0] * part
        error = rigid_motion(shift, np.array([0.0, 0.0, self.size[1] * part]))
        self.count += 1
        return error @ TRUE[self.count - 1]


class Detector:
    """The true objects of the frames."""

    def perceive(self, frame: RgbdFrame) -> Perceived:
        _, shows = seen(frame.stamp_ns // STEP_NS)
        found = [n for n in range(1, len(SCENE)) if np.count_nonzero(shows == n) > 150]
        instances, boxes = np.zeros(shows.shape, np.uint16), []
        for row, number in enumerate(found):
            v, u = np.nonzero(shows == number)
            instances[v, u] = row + 1
            boxes.append([u.min(), v.min(), u.max() + 1, v.max() + 1])
        kinds = [CLASSES.index(THINGS[number - 1][0]) for number in found]
        count = len(found)
        nothing = Relations(np.zeros((0, 2), np.int64), np.zeros((0, 1)), np.zeros(0))
        graph = FrameGraph(
            frame.stamp_ns, "camera", 160, 120, VOCABULARY,
            np.array(boxes, np.float64).reshape(-1, 4), 0.02 + 0.92 * np.eye(4)[kinds],
            np.full(count, 0.9), nothing,
        )  # fmt: skip
        return Perceived(graph, instances, {})


def tracked(odometry, count=len(TRUE)):
    """Each frame of the turn with its pose, and the trajectory if a loop was closed."""
    for number in range(count):
        image = np.full((120, 160, 3), 128, np.uint8)
        depth_m, _ = seen(number)
        T, closing = odometry.track(number * STEP_NS, image, depth_m, CAMERA)
        yield RgbdFrame(number * STEP_NS, image, depth_m, CAMERA, T, "odom", None, closing)


def drifting(shift_m, turn_deg):
    odometry = LoopOdometry(TRUE[0])
    odometry.odometry = Drifting(shift_m, turn_deg)
    return odometry


def worst_m(poses):
    return np.linalg.norm((poses - TRUE)[:, :3, 3], axis=1).max()


def test_a_loop_is_closed_and_the_graph_follows(monkeypatch):
    # Nothing is aligned with the map, so the drift stays until the loop is closed.
    monkeypatch.setattr(loops, "PRIOR", 1e9)
    pipeline, copy = Pipeline(Config(), Detector()), GraphReplica()
    poses, closings_m = np.zeros((0, 4, 4)), []
    for frame in tracked(drifting(0.25, 7.0)):
        if frame.trajectory is not None:
            poses = frame.trajectory.at(STEP_NS * np.arange(len(poses))) @ poses
            closings_m.append(frame.trajectory.moved_m)
        poses = np.append(poses, frame.T_world_camera[None], axis=0)
        pipeline.process(frame)
        if len(poses) == 1:
            copy.reset(pipeline.builder.snapshot())
        if (update := pipeline.builder.update()) is not None:
            copy.apply(update)
    assert max(closings_m) > 0.05
    drift = Drifting(0.25, 7.0)
    assert worst_m(np.array([drift.track(None, None, None) for _ in TRUE])) > 0.2
    assert worst_m(poses) < 0.12
    while (update := pipeline.builder.update()) is not None or pipeline.builder.waiting:
        if update is not None:
            copy.apply(update)
    shown = pipeline.builder.snapshot()
    assert dict(copy.nodes) == {node.id: node for node in shown.nodes}
    assert sorted(node.label for node in shown.nodes) == sorted(label for label, *_ in THINGS)
    for label, low, high in THINGS:
        means = [n.mean_m for n in shown.nodes if n.label == label]
        outside = [np.maximum(np.subtract(low, m), np.subtract(m, high)).max() for m in means]
        assert min(outside) < 0.15


def test_a_trajectory_that_sees_no_place_again_is_open():
    odometry = drifting(0.25, 7.0)
    frames = list(tracked(odometry, 30))
    assert [frame for frame in frames if frame.trajectory is not None] == []
    # Aligned with the map, it drifts less.
    assert np.linalg.norm((frames[-1].T_world_camera - TRUE[29])[:3, 3]) < 0.02
    assert "open" in closings_in_words(odometry.closed, odometry.correction_m)
    assert closings_in_words(3, 0.012) == "loop closed 3 times, last correction 1.2 cm"


OTHER = [
    ((-2.2, -2.6, 0.0), (3.0, 1.9, 2.5)),
    ((1.2, 0.6, 0.0), (2.6, 1.8, 0.75)),
    ((-2.2, -1.6, 0.0), (-1.7, -0.2, 1.9)),
    ((0.4, -2.5, 0.0), (1.3, -1.8, 0.8)),
]


@pytest.mark.parametrize(("scene", "closes"), [(SCENE, True), (OTHER, False)])
def test_a_camera_that_is_carried_to_another_room_closes_no_loop_with_the_first(scene, closes):
    odometry = drifting(0.0, 0.0)
    list(tracked(odometry, 50))
    # It is put down where it thinks that it has been: only what it sees is another room.
    frames = [RgbdFrame(0, np.full((120, 160, 3), 128, np.uint8), look(scene, T)[0], CAMERA,
                        np.eye(4), "odom", None) for T in TRUE[:30]]  # fmt: skip
    odometry.odometry = Drifting(0.0, 0.0)
    odometry.odometry.restarts = 1
    tries, found = false_loops(odometry, frames)
    assert tries >= 7 and (found > 0) == closes
    mirrors = list(mirrored(frames))
    np.testing.assert_array_equal(mirrors[3].depth_m[:, ::-1], frames[3].depth_m)
    assert mirrors[3].intrinsics == CAMERA  # it looks along the middle


def test_keyframes_are_bounded_and_loops_survive(monkeypatch):
    monkeypatch.setattr(loops, "MAX_KEYFRAMES", 20)
    odometry = drifting(0.1, 2.0)
    *_, last = tracked(odometry)
    assert len(odometry._keyframes) <= 20 and odometry.closed
    assert np.linalg.norm((last.T_world_camera - TRUE[-1])[:3, 3]) < 0.03


def test_a_lost_camera_goes_on_where_it_has_been():
    path = [camera_at(0.5 * k, 0.03 * k) for k in range(12)]
    frames = [corner_frame(T, k, is_tiled=True) for k, T in enumerate(path)]
    odometry = LoopOdometry(path[0])
    for frame in frames:
        odometry.track(frame.stamp_ns, frame.rgb, frame.depth_m, frame.intrinsics)
    # A look at a near wall, then back.
    wall = corner_frame(camera_at(90.0, 0.0, 0.4), 20)
    with pytest.raises(RefusedInput, match="odometry lost"):
        odometry.track(20, wall.rgb, wall.depth_m, wall.intrinsics)
    frame = corner_frame(camera_at(25.0, -0.1), 21, is_tiled=True)
    back, _ = odometry.track(21, frame.rgb, frame.depth_m, frame.intrinsics)
    assert np.linalg.norm((back - frame.T_world_camera)[:3, 3]) < 0.05

"""Corrections of poses: what was seen from a pose moves with it, and nothing else does."""

import pickle

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.merging import VOCABULARY, local_graph, random_local_graphs, random_pose, seeds
from typer.testing import CliRunner

from deworldsg_ros.cli.app import app
from deworldsg_ros.config import Config, MergingConfig, OutputConfig
from deworldsg_ros.graph.extent import surface_points
from deworldsg_ros.graph.provenance import (
    MAX_KEYFRAMES,
    MOUNTING_POSES,
    Trail,
    TrailChange,
)
from deworldsg_ros.graph_builder import MOVED_A_CALL, GraphBuilder
from deworldsg_ros.map_file import read_map, write_map
from deworldsg_ros.poses.trajectory import write_tum
from deworldsg_ros.scene.camera import (
    interpolate_pose,
    interpolate_poses,
    invert_pose,
    rigid_motion,
)
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import LocalGraph, derived
from deworldsg_ros.wire.follow import GraphReplica
from deworldsg_ros.wire.messages import NodeState

S = 10**9
BOTH = pytest.mark.parametrize("association", ["paper", "surface"])
# Surface points, and what is published of them, are rounded to float32: a neighbour may be lost.
# Messages have four decimals.
TOLERANCE_M = {"paper": 2e-4, "surface": 1e-3}
# The body of a robot, on which a camera looks ahead.
MOUNTING = np.array([[0, 0, 1, 0.2], [-1, 0, 0, 0], [0, -1, 0, 1.0], [0, 0, 0, 1.0]])


def config_of(association: str) -> Config:
    return Config(
        merging=MergingConfig(association=association), output=OutputConfig(min_existence=0.0)
    )


def builder_of(association: str) -> GraphBuilder:
    return GraphBuilder(config_of(association), VOCABULARY, "world")


def states(builder: GraphBuilder) -> dict[int, NodeState]:
    return {node.id: node for node in builder.full().nodes}


def in_any_order(points: list[list[float]]) -> np.ndarray:
    """Points in an order that does not depend on how they were stored."""
    array = np.array(points, np.float64).reshape(-1, 3)
    return array[np.lexsort(array.round(3).T)]


def shift(x_m: float) -> np.ndarray:
    return rigid_motion(np.array([x_m, 0.0, 0.0]), np.zeros(3))


# --- The trail: from which poses, and how they change.


def loop(count: int = 80, radius_m: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (n,) at 10 Hz, and poses (n, 4, 4) of a camera that goes round and looks outwards."""
    poses = []
    for angle in np.linspace(0, 2 * np.pi, count):
        x, y = np.cos(angle), np.sin(angle)
        T = np.eye(4)
        T[:3, :3] = np.array([[y, -x, 0], [0, 0, -1], [x, y, 0]]).T
        T[:3, 3] = [radius_m * x, radius_m * y, 1.0]
        poses.append(T)
    return S + np.arange(count) * S // 10, np.array(poses)


def drifted(poses: np.ndarray, metres: float = 1.0, degrees: float = 5.0) -> np.ndarray:
    """Poses whose error grows evenly, in the frame of the first one."""
    start = rigid_motion(poses[0, :3, 3], np.zeros(3))
    found = []
    for part, T in zip(np.linspace(0, 1, len(poses)), poses):
        turn = np.radians(degrees * part) * np.array([0.0, 0.0, 1.0])
        error = rigid_motion(metres * part * np.array([0.8, -0.6, 0.0]), turn)
        found.append(start @ error @ invert_pose(start) @ T)
    return np.array(found)


def trail_of(stamps_ns: np.ndarray, poses: np.ndarray, drift: np.ndarray | None = None) -> Trail:
    trail = Trail()
    for stamp_ns, T in zip(stamps_ns.tolist(), poses):
        trail.note(stamp_ns, T, T if drift is None else drift @ T)
    return trail


def places_after(change: TrailChange, stamps_ns: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Where (n, 3) a point 2 m before each camera is after a change."""
    seen = poses @ np.array([0, 0, 2.0, 1.0])
    return (change.at(stamps_ns) @ seen[:, :, None])[:, :3, 0]


@given(seeds, st.integers(1, 9))
def test_interpolation_is_that_of_pairs_of_poses(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    stamps = np.sort(rng.choice(1000, count, replace=False))
    poses = [random_pose(rng)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ rigid_motion(rng.normal(size=3), rng.normal(0, 0.2, 3)))
    at = rng.integers(-100, 1100, 20)
    found = interpolate_poses(stamps, np.array(poses), at)
    for stamp, T in zip(at.tolist(), found):
        after = int(np.clip(stamps.searchsorted(stamp), 0, count - 1))
        before = max(after - 1, 0)
        part = (stamp - stamps[before]) / max(stamps[after] - stamps[before], 1)
        expected = interpolate_pose(poses[before], poses[after], float(np.clip(part, 0, 1)))
        np.testing.assert_allclose(T, expected, atol=0.02)
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)


@pytest.mark.parametrize("every", [1, 7])
@pytest.mark.parametrize("mounting", [np.eye(4), MOUNTING])
def test_what_was_seen_follows_a_trajectory_of_the_camera_or_of_its_body(every, mounting) -> None:
    stamps, true = loop()
    wrong, T_drift = drifted(true), rigid_motion(np.array([0, 0.1, 0]), np.zeros(3))
    trail = trail_of(stamps, wrong, T_drift)
    bodies = [poses @ invert_pose(mounting) for poses in (wrong, true)]
    assert trail.follow(stamps[::every], bodies[0][::every]) is None  # it has not changed
    change = trail.follow(stamps[::every], bodies[1][::every])
    assert change is not None
    # The correction of drift had moved the frames, too.
    places = places_after(change, stamps, T_drift @ wrong)
    expected = (true @ np.array([0, 0, 2.0, 1.0]))[:, :3]
    # Frames of a keyframe share its pose, which is right for their mean: within it, drift goes on.
    errors = places - expected
    assert np.linalg.norm(errors, axis=1).max() < (0.03 if every > 1 else 0.01)
    starts = change.starts_ns
    for part in np.split(errors, stamps.searchsorted(starts[1:])):
        assert np.linalg.norm(part.mean(axis=0)) < (0.03 if every > 1 else 0.001)
    assert trail.follow(stamps[::every], bodies[1][::every]) is None
    # And back again: now no drift is taken back.
    back = trail.follow(stamps[::every], bodies[0][::every])
    assert back is not None
    np.testing.assert_allclose(
        back.T_new_old @ change.T_new_old,
        [np.eye(4), *[invert_pose(T_drift)] * len(starts)],
        atol=0.02,
    )


def test_a_body_is_followed_when_enough_poses_have_told_where_the_camera_is() -> None:
    stamps, true = loop()
    trail = trail_of(stamps, drifted(true))
    few = (drifted(true) @ invert_pose(MOUNTING))[: MOUNTING_POSES - 1]
    few[-1] = shift(1.0) @ few[-1]
    assert trail.follow(stamps[: len(few)], few) is None
    assert trail.follow(stamps + 10**12, true) is None  # of another time
    assert Trail().follow(stamps, true) is None


def test_poses_that_jump_themselves_are_not_moved_twice() -> None:
    stamps, true = loop()
    given_ = drifted(true)
    given_[60:] = true[60:]  # SLAM closes the loop, and then its poses are right
    trail = trail_of(stamps, given_)
    change = trail.follow(stamps[:58:3], true[:58:3])  # its trajectory has not come so far
    assert change is not None
    places = places_after(change, stamps, given_)
    expected = (true @ np.array([0, 0, 2.0, 1.0]))[:, :3]
    apart = np.linalg.norm(places - expected, axis=1)
    at = np.isin(stamps, change.starts_ns)
    assert apart[at].max() < 0.05 and apart[60:].max() < 1e-9


def test_poses_that_were_on_their_way_are_moved_when_they_come() -> None:
    stamps, true = loop()
    wrong = drifted(true)
    trail = trail_of(stamps[:60], wrong[:60])
    assert trail.admit(int(stamps[60]), wrong[60]) is None
    assert trail.follow(stamps[:60:3], true[:60:3]) is not None
    for row in range(60, 64):
        T = trail.admit(int(stamps[row]), wrong[row])
        assert T is not None
        np.testing.assert_allclose((T @ wrong[row])[:3, 3], true[row, :3, 3], atol=0.1)
    for row in range(64, 70):
        assert trail.admit(int(stamps[row]), true[row]) is None
    assert trail.admit(int(stamps[70]), wrong[70]) is None  # the new trajectory has begun


def test_of_a_jump_at_the_end_of_a_loop_the_error_is_spread_over_the_way() -> None:
    stamps, true = loop(160)
    lead = np.repeat(true[:1], 40, axis=0)  # it stands before it goes
    true = np.concatenate((lead, true))
    stamps = S + np.arange(200) * S // 10
    wrong = np.concatenate((lead, drifted(true[40:])))
    trail = trail_of(stamps, wrong)
    change = trail.jump(true[-1] @ invert_pose(wrong[-1]), int(stamps[-1]) + 1)
    assert change is not None
    places = places_after(change, stamps, wrong)
    expected = (true @ np.array([0, 0, 2.0, 1.0]))[:, :3]
    before = np.linalg.norm((wrong @ np.array([0, 0, 2.0, 1.0]))[:, :3] - expected, axis=1)
    after = np.linalg.norm(places - expected, axis=1)
    assert before.max() > 1.0 and after.max() < 0.3 and after[:40].max() < 1e-6
    assert after[-1] < 0.05
    # Small steps are how a SLAM system follows its odometry, and no loop.
    assert trail.jump(shift(0.02), int(stamps[-1]) + 1) is None
    assert Trail().jump(shift(1.0), S) is None


def test_a_trail_is_bounded_and_a_clock_that_is_set_back_begins_another(monkeypatch) -> None:
    monkeypatch.setattr("deworldsg_ros.graph.provenance.MAX_TRAIL", 64)
    monkeypatch.setattr("deworldsg_ros.graph.provenance.MAX_KEYFRAMES", 16)
    stamps, true = loop(400, radius_m=10.0)
    trail, halved = Trail(), 0
    for stamp_ns, T in zip(stamps.tolist(), true):
        halved += trail.note(stamp_ns, T, T)
    assert halved >= 2 and trail.keyframe <= 16 and len(trail._stamps_ns) <= 64
    change = trail.since(shift(1.0), int(stamps[200]))
    assert 0 < change.moved.sum() < len(change.moved)
    assert not change.moved[0] and not change.moved[1] and change.moved[-1]
    trail.note(S // 2, true[0], true[0])
    change = trail.since(shift(1.0), 0)
    np.testing.assert_array_equal(np.flatnonzero(change.moved), [trail.keyframe])
    assert np.iinfo(np.uint16).max == MAX_KEYFRAMES


# --- The graph.


@BOTH
@settings(max_examples=15)
@given(seed=seeds)
def test_newer_nodes_move_rigidly_and_the_inverse_restores_them(
    association: str, seed: int
) -> None:
    rng, atol = np.random.default_rng(seed), TOLERANCE_M[association]
    builder = builder_of(association)
    for local in random_local_graphs(rng, 12):
        builder.integrate(derived(local, stamp_ns=local.stamp_ns * S))
    before, evidence = states(builder), pickle.dumps(builder.graph.state().pairs)
    nodes = builder.graph.nodes
    T, since_ns = random_pose(rng), int(rng.integers(0, 14)) * S
    # Of the nodes that were seen before and after, and of others: those come apart, and merge.
    wholly = {
        node_id
        for node_id, slot in nodes.slot_of.items()
        if len(nodes.keyframes(slot)) and (nodes.keyframes(slot).astype(int) * S >= since_ns).all()
    }
    never = {
        node_id
        for node_id, slot in nodes.slot_of.items()
        if (nodes.keyframes(slot).astype(int) * S < since_ns).all()
    }
    moved = builder.apply_correction(T, since_ns)
    assert moved == len(nodes.slot_of) - len(never & nodes.slot_of.keys()) or len(
        states(builder)
    ) < len(before)
    if len(states(builder)) < len(before):
        return  # some have met
    for node_id, node in states(builder).items():
        known = before[node_id]
        if node_id in never:  # the heading of the room, which boxes prefer, may be another one
            assert msgspec.structs.replace(node, box=known.box) == known
        if node_id not in wholly:
            continue
        sigma = T[:3, :3] @ np.reshape(known.covariance_m2, (3, 3)) @ T[:3, :3].T
        np.testing.assert_allclose(node.mean_m, T[:3, :3] @ known.mean_m + T[:3, 3], atol=atol)
        np.testing.assert_allclose(np.reshape(node.covariance_m2, (3, 3)), sigma, atol=atol)
        assert len(surface_points(node)) == len(surface_points(known))
    # Only beliefs follow the geometry.
    assert pickle.dumps(builder.graph.state().pairs) == evidence
    builder.apply_correction(invert_pose(T), since_ns)
    after = states(builder)
    for node_id in before.keys() & after.keys() if len(after) == len(before) else ():
        restored, node = after[node_id], before[node_id]
        points = (in_any_order(surface_points(one)) for one in (restored, node))
        np.testing.assert_allclose(*points, atol=2e-3)
        assert (restored.label, restored.observations) == (node.label, node.observations)


def slab_at(stamp_ns: int, x_m: float, T: np.ndarray | None = None, seed: int = 1) -> LocalGraph:
    """A frame that sees one object, a slab of points around (x, 0, 1), moved by T."""
    T = np.eye(4) if T is None else T
    rng = np.random.default_rng(seed)
    points = rng.uniform([x_m - 0.3, -0.2, 0.95], [x_m + 0.3, 0.2, 1.05], (200, 3))
    points = points @ T[:3, :3].T + T[:3, 3]
    mean, covariance = points.mean(axis=0)[None], np.cov(points.T)[None]
    classes, surface = np.array([[0.9, 0.05, 0.03, 0.02]]), (points.astype(np.float32),)
    frame = local_graph(stamp_ns, mean, covariance, classes, points=surface)
    return derived(frame, T_world_camera=T)


@BOTH
def test_after_the_correction_the_object_is_matched_at_its_new_position(association: str) -> None:
    builder, T = builder_of(association), shift(2.0)
    builder.integrate(slab_at(1 * S, 0.0))
    T[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    builder.apply_correction(T, 1 * S)
    assert builder.integrate(slab_at(2 * S, 0.0, T)) == [1]
    assert builder.integrate(slab_at(3 * S, 0.0)) == [2]


def test_the_update_contains_only_the_moved_nodes_and_no_scale_is_applied() -> None:
    builder = builder_of("surface")
    builder.integrate(slab_at(1 * S, 0.0))
    builder.integrate(slab_at(2 * S, 3.0))
    builder.update()
    builder.apply_correction(shift(0.25), 2 * S)
    update = builder.update()
    assert update is not None and [node.id for node in update.nodes] == [2]
    assert builder.apply_correction(shift(0.25), 3 * S) == 0
    for T in (np.diag([1.0, 1.0, -1.0, 1.0]), 2 * np.eye(4), np.full((4, 4), np.nan)):
        with pytest.raises(RefusedInput) as refused:
            builder.apply_correction(T, 0)
        assert refused.value.reason == "invalid_pose"
    assert builder.update() is None


def test_a_node_that_was_seen_before_and_after_moves_piece_by_piece() -> None:
    builder = builder_of("surface")
    for second in range(1, 5):  # the pose is off by 15 cm since the third frame
        T = shift(0.15 if second > 2 else 0.0)
        assert builder.integrate(slab_at(second * S, 0.0, T, seed=second)) == [1]
    assert states(builder)[1].box.size_m[0] > 0.7
    builder.apply_correction(shift(-0.15), 3 * S)
    node = states(builder)[1]
    points = surface_points(node)
    assert np.abs(points[:, 0]).max() < 0.301 and len(points) == 512
    np.testing.assert_allclose(node.mean_m, [0, 0, 1], atol=0.03)
    np.testing.assert_allclose(node.covariance_m2[0], 0.6**2 / 12, rtol=0.1)
    nodes, slot = builder.graph.nodes, builder.graph.nodes.slot(1)
    np.testing.assert_allclose(nodes.means[slot], [0, 0, 1], atol=0.02)
    np.testing.assert_allclose(nodes.covariances[slot], np.cov(points.T), atol=2e-3)


def test_what_was_seen_before_a_correction_outlasts_the_frames_after_it() -> None:
    builder = builder_of("surface")
    for second in range(1, 21):
        builder.integrate(slab_at(second * S, 0.0, seed=second))
    builder.apply_correction(shift(2.0), S)
    for second in range(21, 24):  # then its right half is in view
        slab = slab_at(second * S, 2.0, seed=second)
        half = slab.surface_points_world[0][slab.surface_points_world[0][:, 0] > 2.0]
        assert builder.integrate(derived(slab, surface_points_world=(half,))) == [1]
    points = surface_points(states(builder)[1])
    # 20 frames of a half of the slab against 23 of the other.
    assert 0.4 < np.mean(points[:, 0] < 2.0) < 0.5


@BOTH
def test_doubles_that_meet_are_merged_and_the_older_id_lives_on(association: str) -> None:
    builder, copy = builder_of(association), GraphReplica()
    copy.reset(builder.snapshot())
    for second in range(1, 4):
        assert builder.integrate(slab_at(second * S, 0.0)) == [1]
        assert builder.integrate(slab_at(second * S + S // 2, 3.0)) == [2]
    for second in range(4, 6):
        assert builder.integrate(slab_at(second * S, 0.0, shift(1.0), seed=second)) == [3]
    copy.apply(builder.update())
    assert builder.apply_correction(shift(-1.0), 4 * S) == 1
    update = builder.update()
    assert [(gone.id, gone.merged_into) for gone in update.removed_nodes] == [(3, 1)]
    copy.apply(update)
    assert sorted(copy.nodes) == [1, 2] and builder.graph.resolve(3) == 1
    assert copy.nodes[1].mean_m == states(builder)[1].mean_m
    assert builder.integrate(slab_at(9 * S, 0.0)) == [1]


def test_many_nodes_follow_in_parts_the_nearest_first_and_nobody_waits_for_more() -> None:
    builder, count = builder_of("surface"), 3 * MOVED_A_CALL
    for number in range(count):
        builder.integrate(slab_at((number + 1) * S, 3.0 * number, shift(0.0)))
    while builder.update() or builder.waiting:
        pass
    assert builder.apply_correction(shift(0.5), 0) == count
    assert builder.waiting >= 2 * MOVED_A_CALL
    builder.integrate(slab_at((count + 1) * S, 0.0, shift(0.5)))  # a frame meets none that waits
    assert len(builder.graph) == count
    moved = builder.update()
    assert moved is not None
    for node in states(builder).values():  # the whole graph waits for nothing
        np.testing.assert_allclose(node.mean_m[0], 3.0 * (node.id - 1) + 0.5, atol=0.01)
    assert not builder._due


def test_a_map_goes_on_with_its_keyframes(tmp_path) -> None:
    builder = builder_of("surface")
    for second in range(1, 5):
        builder.integrate(slab_at(second * S, 3.0 * (second // 3)))
    write_map(builder, tmp_path / "room.map")
    again = read_map(config_of("surface"), tmp_path / "room.map")
    again.integrate(slab_at(7 * S, 6.0))
    assert again.apply_correction(shift(0.5), 3 * S) == 2
    means = [node.mean_m[0] for node in states(again).values()]
    np.testing.assert_allclose(means, [0.0, 3.5, 6.5], atol=0.01)


def test_a_map_follows_a_trajectory_file(tmp_path) -> None:
    builder = builder_of("surface")
    for second in range(1, 7):  # since the fourth second, the poses are off
        T = shift(0.5 if second > 3 else 0.0)
        builder.integrate(slab_at(second * S, 3.0 * (second > 3), T, seed=second))
    path, file = tmp_path / "room.map", tmp_path / "slam.txt"
    write_map(builder, path)
    before = path.read_bytes()

    def edit(*words: str) -> str:
        done = CliRunner().invoke(app, ["edit", *words])
        return f"{done.exit_code} {done.output}".replace("\n", " ")

    later = [S * 100, S * 101]
    write_tum(file, later, [np.eye(4)] * 2)
    said = edit(str(path), "follow", str(file))
    assert "from 100.000 to 101.000 s" in said and "frames from 1.000 to 6.000 s" in said
    assert said[0] != "0" and "seconds and metres" in edit(str(path), "follow", str(path))
    assert "after the map file" in edit("--live", "follow", str(file))
    assert path.read_bytes() == before
    write_tum(file, [second * S for second in range(1, 7)], [np.eye(4)] * 6)
    assert edit(str(path), "follow", str(file)) == "0 1 object moved, by up to 0.50 m "
    again = read_map(config_of("surface"), path)
    means = [node.mean_m[0] for node in states(again).values()]
    np.testing.assert_allclose(means, [0.0, 3.0], atol=0.02)
    assert again.integrate(slab_at(7 * S, 3.0)) == [2]
    assert edit(str(path), "follow", str(file)) == "0 0 objects moved, by up to 0.00 m "


def test_a_drift_of_a_metre_and_five_degrees_over_a_loop_is_gone_when_it_closes() -> None:
    """24 slabs on a ring, 1.6 m apart; the camera sees three of them, and the first ones twice."""
    stamps, true = loop(120, radius_m=4.0)
    true = np.concatenate((true, true[1:20]))
    stamps = S + np.arange(len(true)) * S // 10
    wrong = drifted(true)
    angles = 2 * np.pi * np.arange(24) / 24
    places = np.stack([6 * np.cos(angles), 6 * np.sin(angles), np.full(24, 1.0)], axis=1)

    def frame(row: int, T_graph: np.ndarray) -> LocalGraph:
        rng = np.random.default_rng(row)
        seen = np.flatnonzero(np.linalg.norm(places - 1.5 * true[row, :3, 3], axis=1) < 2.5)
        clouds = []
        for index in seen:
            cloud = places[index] + rng.uniform(-0.2, 0.2, (150, 3)) * [1, 1, 0.1]
            clouds.append((cloud @ T_graph[:3, :3].T + T_graph[:3, 3]).astype(np.float32))
        means = np.array([cloud.mean(axis=0, dtype=np.float64) for cloud in clouds])
        covariances = np.array([np.cov(cloud.T) for cloud in clouds])
        classes = np.full((len(seen), 4), 0.02)
        classes[np.arange(len(seen)), seen % 4] = 0.94
        local = local_graph(int(stamps[row]), means, covariances, classes, points=tuple(clouds))
        return derived(local, T_world_camera=T_graph @ true[row])

    builder, copy = builder_of("surface"), GraphReplica()
    copy.reset(builder.snapshot())
    for row in range(len(true)):
        builder.integrate(frame(row, wrong[row] @ invert_pose(true[row])))
        if (update := builder.update()) is not None:
            copy.apply(update)
    apart = [np.linalg.norm(places - node.mean_m, axis=1).min() for node in copy.nodes.values()]
    assert len(copy.nodes) > 24 and max(apart) > 0.5
    older = set(copy.nodes)
    assert builder.apply_trajectory(stamps[::8], true[::8]) > 20
    while (update := builder.update()) is not None or builder.waiting:
        if update is not None:
            copy.apply(update)
    nodes = states(builder)
    apart = np.array([np.linalg.norm(places - node.mean_m, axis=1) for node in nodes.values()])
    assert len(nodes) == 24 and set(nodes) <= older
    assert apart.min(axis=1).max() < 0.1
    assert sorted(apart.argmin(axis=1)) == list(range(24))
    assert dict(copy.nodes) == {node.id: node for node in builder.snapshot().nodes}
    # The next lap, under right poses, finds the same objects.
    found = builder.integrate(derived(frame(30, np.eye(4)), stamp_ns=int(stamps[-1]) + S))
    assert found and set(found) <= set(nodes)


# --- The nodes.


def test_the_node_applies_corrections_and_refuses_invalid_ones() -> None:
    pytest.importorskip("rclpy")
    from geometry_msgs.msg import PoseStamped
    from nav_msgs.msg import Path
    from std_msgs.msg import String
    from support.nodes_bench import Bench, pose, stamped, works
    from support.nodes_bench import local_graph as message_of

    from deworldsg_ros.nodes.graph_node import GraphNode

    topics = {
        "deworldsg/local_graph": String,
        "deworldsg/pose_correction": PoseStamped,
        "deworldsg/trajectory": Path,
    }
    with Bench(GraphNode, topics) as at:

        def correct(*args: object) -> None:
            at.send(deworldsg__pose_correction=pose(at.stamp_ns, *args))

        def see() -> None:
            at.send(deworldsg__local_graph=message_of(at.next_stamp()))

        def follow(x_m: float, frame_id: str = "map", step_ns: int = 10**7) -> None:
            stamps = [at.stamp_ns + step_ns * number for number in range(3)]
            poses = [pose(stamp_ns, x_m) for stamp_ns in stamps]
            path = stamped(Path(poses=poses), at.stamp_ns, frame_id)
            at.send(deworldsg__trajectory=path)

        at.refuses("no_graph", lambda: correct(0.5))
        works(at, see)
        at.refuses("wrong_frame", lambda: correct(0.5, "odom"))
        at.refuses("invalid_pose", lambda: correct(float("nan")))
        correct(0.5)
        at.expect(lambda: at.node.more_values().get("pose corrections") == "1", "the correction")
        assert at.node.more_values()["nodes moved by corrections"] == "1"
        works(at, see)
        at.refuses("invalid_trajectory", lambda: follow(0.5, step_ns=0))
        at.refuses("invalid_pose", lambda: follow(float("nan")))
        at.refuses("wrong_frame", lambda: follow(0.5, "odom"))
        works(at, see)

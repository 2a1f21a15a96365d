"""The up direction of the world, and its state in a map."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.up import UpEstimator

seeds = st.integers(0, 10_000)


def level_pose(up: np.ndarray, yaw: float, pitch: float) -> np.ndarray:
    """A camera whose image rows are orthogonal to `up`, without roll; it looks at `pitch`."""
    seed = np.eye(3)[np.abs(up).argmin()]
    east = np.cross(seed, up) / np.linalg.norm(np.cross(seed, up))
    north = np.cross(up, east)
    ahead = np.cos(yaw) * east + np.sin(yaw) * north
    pose = np.eye(4)
    pose[:3, 0] = np.cross(ahead, up)
    pose[:3, 2] = np.cos(pitch) * ahead + np.sin(pitch) * up
    pose[:3, 1] = np.cross(pose[:3, 2], pose[:3, 0])
    return pose


def poses(seed: int, count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    up = rng.normal(size=3)
    up /= np.linalg.norm(up)
    return [level_pose(up, rng.uniform(0, 6), rng.uniform(-0.6, 0.3)) for _ in range(count)]


@settings(max_examples=30, deadline=None)
@given(seed=seeds, before=st.integers(0, 6), after=st.integers(0, 6))
def test_a_restored_estimator_continues_equally(seed: int, before: int, after: int) -> None:
    seen = poses(seed, before + after)
    whole, again = UpEstimator(), UpEstimator()
    for pose in seen[:before]:
        whole.observe(pose)
    for pose in poses(seed + 1, 3):  # this is forgotten
        again.observe(pose)
    state = whole.state()
    kept = state.copy()
    again.restore(state)
    for pose in [None, *seen[before:]]:
        if pose is not None:
            whole.observe(pose)
            again.observe(pose)
        np.testing.assert_array_equal(again.up_world(), whole.up_world())
        np.testing.assert_array_equal(again.state(), whole.state())
    np.testing.assert_array_equal(state, kept)  # the state itself is not changed
    if not seen:
        np.testing.assert_array_equal(whole.up_world(), [0, 0, 1])


def test_up_is_found_from_level_cameras() -> None:
    up = np.array([0.6, -0.8, 0.0])
    estimator = UpEstimator()
    for yaw in np.linspace(0, 5, 9):
        estimator.observe(level_pose(up, yaw, -0.3))
    np.testing.assert_allclose(estimator.up_world(), up, atol=0.02)


@pytest.mark.parametrize(
    "state",
    [
        np.zeros(0),
        np.zeros(12),
        np.zeros((13, 1)),
        np.zeros(15),
        np.full(14, 0.5),
        np.full(13, np.nan),
        np.array([-1.0] + [0] * 12),
    ],
)
def test_another_state_is_refused(state: np.ndarray) -> None:
    estimator = UpEstimator()
    estimator.observe(np.eye(4))
    before = estimator.state()
    with pytest.raises(ValueError, match="up direction"):
        estimator.restore(state)
    np.testing.assert_array_equal(estimator.state(), before)


@pytest.mark.parametrize(("axis", "up"), [("z", [0, 0, 1]), ("y", [0, 1, 0]), ("-y", [0, -1, 0])])
def test_a_named_axis_is_used_as_given(axis: str, up: list[int]) -> None:
    estimator = UpEstimator(axis)
    for pose in poses(2, 4):
        estimator.observe(pose)
    np.testing.assert_array_equal(estimator.up_world(), up)


def test_an_unknown_axis_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="world_up 'x'"):
        UpEstimator("x")

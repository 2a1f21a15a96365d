"""Moments, motion, Hellinger distance and fusion of Gaussians."""

import numpy as np
import pytest
from hypothesis import given
from support.merging import moments, random_covariances, random_pose, seeds

from deworldsg_ros.scene import gaussian


def random_pair(seed: int):
    rng = np.random.default_rng(seed)
    return rng, rng.normal(0, 10 ** rng.uniform(-3, 1), (2, 3)), random_covariances(rng, 2)


@given(seeds)
def test_moments_of_moved_points_are_moved_moments(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, T = rng.normal(size=(20, 3)), random_pose(rng)
    mean, covariance = gaussian.transform(*moments(points, 1e-6), T)
    other = moments(points @ T[:3, :3].T + T[:3, 3], 1e-6)
    np.testing.assert_allclose(mean, other[0], atol=1e-12)
    np.testing.assert_allclose(covariance, other[1], atol=1e-12)
    assert (covariance == covariance.T).all()


@given(seeds)
def test_the_hellinger_distance(seed: int) -> None:
    rng, means, covariances = random_pair(seed)
    (m_a, m_b), (c_a, c_b) = means, covariances
    distance = gaussian.hellinger_distance(m_a, c_a, m_b, c_b)
    assert 0 <= distance <= 1
    assert distance == pytest.approx(gaussian.hellinger_distance(m_b, c_b, m_a, c_a), abs=1e-12)
    assert (gaussian.hellinger_distance(means, covariances, means, covariances) == 0).all()
    assert gaussian.hellinger_distance(m_a, c_a, m_a, c_a) == 0
    # It does not depend on the frame, and grows with the offset and the difference in size.
    here = gaussian.bhattacharyya_distance(m_a, c_a, m_b, c_b)
    (t_a, t_b), (s_a, s_b) = gaussian.transform(means, covariances, random_pose(rng))
    assert gaussian.bhattacharyya_distance(t_a, s_a, t_b, s_b) == pytest.approx(
        here, rel=1e-6, abs=1e-7
    )
    offsets = np.linspace(0, 2, 9)[:, None] * rng.normal(size=3)
    assert (np.diff(gaussian.hellinger_distance(m_a, c_a, m_a + offsets, c_b)) >= 0).all()
    factors = np.linspace(1, 10, 9)[:, None, None]
    assert (np.diff(gaussian.hellinger_distance(m_a, c_a, m_a, factors * c_a)) > 0).all()


def test_the_hellinger_distance_of_a_known_case() -> None:
    # Unit spheres 2 m apart: BD = 4/8.
    distance = gaussian.hellinger_distance(np.zeros(3), np.eye(3), np.array([2.0, 0, 0]), np.eye(3))
    assert distance == pytest.approx(np.sqrt(1 - np.exp(-0.5)), abs=1e-15)


@given(seeds)
def test_fusion_pools_moments_in_any_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 7))
    weights = rng.integers(1, 20, count).astype(float)
    means, covariances = rng.normal(size=(count, 3)), random_covariances(rng, count)
    share = weights / weights.sum()
    pooled_mean = share @ means
    centred = means - pooled_mean
    pooled = np.einsum("n,nij->ij", share, covariances) + (share * centred.T) @ centred
    for _ in range(3):
        first, *others = rng.permutation(count).tolist()
        weight, mean, covariance = weights[first], means[first], covariances[first]
        for index in others:
            one, other = (weight, mean, covariance), (weights[index], means[index])
            mean, covariance = gaussian.fuse(*one, *other, covariances[index])
            swapped = gaussian.fuse(*other, covariances[index], *one)
            assert (mean == swapped[0]).all() and (covariance == swapped[1]).all()
            weight += weights[index]
        np.testing.assert_allclose(mean, pooled_mean, atol=1e-12)
        np.testing.assert_allclose(covariance, pooled, atol=1e-12)
        assert (covariance == covariance.T).all()
        assert np.linalg.eigvalsh(covariance).min() > 0


@given(seeds)
def test_log_determinant_and_eigenvalue_bound(seed: int) -> None:
    many = random_covariances(np.random.default_rng(seed), 20, 1e-4, 10.0)
    for one in many:
        assert gaussian.log_determinant(one) == pytest.approx(np.linalg.slogdet(one)[1], abs=1e-5)
        largest = np.linalg.eigvalsh(one).max()
        assert largest * (1 - 1e-12) <= gaussian.eigenvalue_bound(one) <= 1.7321 * largest
    assert gaussian.log_determinants(many).tolist() == [
        gaussian.log_determinant(one) for one in many
    ]
    assert gaussian.eigenvalue_bounds(many).tolist() == [
        gaussian.eigenvalue_bound(one) for one in many
    ]
    assert (
        not gaussian.log_determinants(many[:0]).size
        and not gaussian.eigenvalue_bounds(many[:0]).size
    )


@pytest.mark.parametrize(
    "covariance",
    [
        np.zeros((3, 3)),
        -np.eye(3),
        np.diag([1.0, 1.0, 0.0]),
        np.ones((3, 3)),
        np.full((3, 3), np.nan),
    ],
)
def test_only_positive_definite_covariances_have_a_log_determinant(covariance: np.ndarray) -> None:
    with pytest.raises(ValueError, match="not positive definite"):
        gaussian.log_determinant(covariance)
    with pytest.raises(ValueError, match="not positive definite"):
        gaussian.log_determinants(np.stack([np.eye(3), covariance]))

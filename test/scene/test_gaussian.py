"""Moments, motion, Hellinger distance and fusion of Gaussians."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from support.gaussians import moments
from support.merging import random_covariances, random_pose, seeds

from deworldsg_ros.scene.gaussian import (
    bhattacharyya_distance,
    eigenvalue_bound,
    eigenvalue_bounds,
    fuse,
    hellinger_distance,
    log_determinant,
    log_determinants,
    transform,
)


def random_pair(seed: int):
    rng = np.random.default_rng(seed)
    means = rng.normal(0, 10 ** rng.uniform(-3, 1), (2, 3))
    covariances = random_covariances(rng, 2)
    return rng, means, covariances


@given(seeds)
def test_moments_are_numpys_and_a_ridge(seed: int) -> None:
    points = np.random.default_rng(seed).normal(size=(20, 3))
    mean, covariance = moments(points, 1e-3)
    np.testing.assert_allclose(mean, points.mean(axis=0), atol=1e-14)
    np.testing.assert_allclose(covariance, np.cov(points.T) + 1e-3 * np.eye(3), atol=1e-13)


@given(seeds)
def test_moments_of_moved_points_are_moved_moments(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, T = rng.normal(size=(20, 3)), random_pose(rng)
    mean, covariance = transform(*moments(points, 1e-6), T)
    other = moments(points @ T[:3, :3].T + T[:3, 3], 1e-6)
    np.testing.assert_allclose(mean, other[0], atol=1e-12)
    np.testing.assert_allclose(covariance, other[1], atol=1e-12)
    assert (covariance == covariance.T).all()


@given(seeds)
def test_hellinger_is_symmetric_and_between_0_and_1(seed: int) -> None:
    _, (m_a, m_b), (c_a, c_b) = random_pair(seed)
    distance = hellinger_distance(m_a, c_a, m_b, c_b)
    assert 0 <= distance <= 1
    assert distance == pytest.approx(hellinger_distance(m_b, c_b, m_a, c_a), abs=1e-12)


@given(seeds)
def test_hellinger_is_exactly_0_for_equal_gaussians(seed: int) -> None:
    _, means, covariances = random_pair(seed)
    assert (hellinger_distance(means, covariances, means, covariances) == 0).all()
    for mean, covariance in zip(means, covariances):
        assert hellinger_distance(mean, covariance, mean, covariance) == 0


@given(seeds)
def test_hellinger_does_not_depend_on_the_frame(seed: int) -> None:
    rng, means, covariances = random_pair(seed)
    moved_means, moved = transform(means, covariances, random_pose(rng))
    assert bhattacharyya_distance(means[0], covariances[0], means[1], covariances[1]) == (
        pytest.approx(
            bhattacharyya_distance(moved_means[0], moved[0], moved_means[1], moved[1]),
            rel=1e-6,
            abs=1e-7,
        )
    )


@given(seeds)
def test_hellinger_grows_with_the_offset(seed: int) -> None:
    rng, means, covariances = random_pair(seed)
    direction = rng.normal(size=3)
    offsets = np.linspace(0, 2, 9)[:, None] * direction
    distances = hellinger_distance(means[0], covariances[0], means[0] + offsets, covariances[1])
    assert (np.diff(distances) >= 0).all()


@given(seeds)
def test_hellinger_grows_with_the_difference_in_size(seed: int) -> None:
    _, means, covariances = random_pair(seed)
    factors = np.linspace(1, 10, 9)[:, None, None]
    distances = hellinger_distance(means[0], covariances[0], means[0], factors * covariances[0])
    assert (np.diff(distances) > 0).all()


def test_hellinger_of_a_known_case() -> None:
    # Unit spheres 2 m apart: BD = 4/8.
    distance = hellinger_distance(np.zeros(3), np.eye(3), np.array([2.0, 0, 0]), np.eye(3))
    assert distance == pytest.approx(np.sqrt(1 - np.exp(-0.5)), abs=1e-15)


@given(seeds)
def test_fusion_pools_moments_in_any_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 7))
    weights = rng.integers(1, 20, count).astype(float)
    means, covariances = rng.normal(size=(count, 3)), random_covariances(rng, count)

    def fused(order: np.ndarray):
        result = (weights[order[0]], means[order[0]], covariances[order[0]])
        for index in order[1:]:
            mean, covariance = fuse(*result, weights[index], means[index], covariances[index])
            result = (result[0] + weights[index], mean, covariance)
        return result

    share = weights / weights.sum()
    pooled_mean = share @ means
    centred = means - pooled_mean
    pooled = np.einsum("n,nij->ij", share, covariances) + (share * centred.T) @ centred
    for _ in range(3):
        _, mean, covariance = fused(rng.permutation(count))
        np.testing.assert_allclose(mean, pooled_mean, atol=1e-12)
        np.testing.assert_allclose(covariance, pooled, atol=1e-12)
        assert (covariance == covariance.T).all()
        assert np.linalg.eigvalsh(covariance).min() > 0


@given(seeds)
def test_fusion_is_exactly_commutative_and_associative_in_moments(seed: int) -> None:
    rng = np.random.default_rng(seed)
    means, covariances = rng.normal(size=(3, 3)), random_covariances(rng, 3)
    a, b, c = zip((1.0, 2.0, 5.0), means, covariances)
    for one, other in zip(fuse(*a, *b), fuse(*b, *a)):
        assert (one == other).all()
    left = fuse(3.0, *fuse(*a, *b), *c)
    right = fuse(*a, 7.0, *fuse(*b, *c))
    for one, other in zip(left, right):
        np.testing.assert_allclose(one, other, atol=1e-12)


@given(seeds)
def test_log_determinant_and_eigenvalue_bound(seed: int) -> None:
    covariance = random_covariances(np.random.default_rng(seed), 1, 1e-4, 10.0)[0]
    assert log_determinant(covariance) == pytest.approx(np.linalg.slogdet(covariance)[1], abs=1e-5)
    largest = np.linalg.eigvalsh(covariance).max()
    assert largest * (1 - 1e-12) <= eigenvalue_bound(covariance) <= 1.7321 * largest


@given(seeds)
def test_many_covariances_give_the_same_bits_as_each(seed: int) -> None:
    many = random_covariances(np.random.default_rng(seed), 20, 1e-4, 10.0)
    assert log_determinants(many).tolist() == [log_determinant(one) for one in many]
    assert eigenvalue_bounds(many).tolist() == [eigenvalue_bound(one) for one in many]
    assert not log_determinants(many[:0]).size and not eigenvalue_bounds(many[:0]).size


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
        log_determinant(covariance)
    with pytest.raises(ValueError, match="not positive definite"):
        log_determinants(np.stack([np.eye(3), covariance]))

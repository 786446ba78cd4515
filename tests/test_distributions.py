"""The tanh-Gaussian against SciPy and numerical integration."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from sacformer_jax.distributions import NoisyPoint, TanhGaussian

LOW, HIGH = (-1.0, -0.4), (1.0, 0.8)


def test_log_prob_is_the_density_of_the_action():
    distribution = TanhGaussian(LOW, HIGH)
    mean, log_std = np.array([0.3, -0.7]), np.array([-0.5, 0.2])
    key = jax.random.key(3)
    action, log_prob = distribution.sample_and_log_prob(
        jax.random.normal(key, (2,)), jnp.array(mean), jnp.array(log_std)
    )
    low, high = np.array(LOW), np.array(HIGH)
    unit = (np.asarray(action, np.float64) - (low + high) / 2) / ((high - low) / 2)
    u = np.arctanh(unit)
    gaussian = stats.norm.logpdf(u, mean, np.exp(log_std))
    jacobian = np.log((high - low) / 2 * (1 - unit**2))
    assert float(log_prob) == pytest.approx((gaussian - jacobian).sum(), abs=1e-4)


def test_stable_far_out():
    distribution = TanhGaussian((-1.0,), (1.0,))
    for mean in (-40.0, 40.0):
        action, log_prob = distribution.sample_and_log_prob(
            jax.random.normal(jax.random.key(0), (1,)), jnp.array([mean]), jnp.array([-20.0])
        )
        assert np.isfinite(log_prob)
        assert abs(float(action[0])) <= 1.0
        gradient = jax.grad(
            lambda m: distribution.sample_and_log_prob(jnp.ones(1), m, jnp.zeros(1))[1]
        )(jnp.array([mean]))
        assert np.isfinite(gradient).all()


def test_samples_and_mode_fill_the_bounds():
    distribution = TanhGaussian(LOW, HIGH)
    mean = jnp.zeros((20_000, 2))
    action, log_prob = distribution.sample_and_log_prob(
        jax.random.normal(jax.random.key(0), mean.shape), mean, mean + 1.0
    )
    assert action.shape == (20_000, 2)
    assert log_prob.shape == (20_000,)
    assert (np.asarray(action) >= np.array(LOW) - 1e-6).all()  # float32 rounding of the bounds
    assert (np.asarray(action) <= np.array(HIGH) + 1e-6).all()
    np.testing.assert_allclose(action.min(axis=0), LOW, atol=0.02)
    np.testing.assert_allclose(action.max(axis=0), HIGH, atol=0.02)
    np.testing.assert_allclose(distribution.mode(jnp.zeros(2)), [0.0, 0.2], atol=1e-6)


def test_a_noisy_point_stays_near_its_mode_and_within_the_bounds():
    point = NoisyPoint(LOW, HIGH, noise=0.1, noise_clip=0.25)
    mean = jnp.broadcast_to(jnp.array([0.2, 3.0]), (20_000, 2))
    action, log_prob = point.sample_and_log_prob(
        jax.random.normal(jax.random.key(0), mean.shape), mean, mean
    )
    assert log_prob.shape == (20_000,)
    assert not log_prob.any()
    away = np.asarray(action - point.mode(mean)) / np.array([1.0, 0.6])  # in half ranges
    assert away[:, 0].std() == pytest.approx(0.1, rel=0.05)
    assert np.abs(away).max() == pytest.approx(0.25, abs=1e-6)  # 1 in 80 draws is clipped
    assert (np.asarray(action) >= np.float32(LOW)).all()
    assert (np.asarray(action) <= np.float32(HIGH)).all()
    assert (np.asarray(action)[:, 1] == np.float32(0.8)).mean() > 0.3  # tanh(3) is near the bound
    np.testing.assert_allclose(point.mode(mean), TanhGaussian(LOW, HIGH).mode(mean))

"""Welford's statistics against NumPy, small variances far from zero included."""

from __future__ import annotations

import jax
import numpy as np

from sacformer_jax import normalizer


def test_batches_merge_to_the_statistics_of_all():
    rng = np.random.default_rng(0)
    # Mean 1000 with std 0.01: E[x^2] - E[x]^2 would be pure rounding in float32.
    obs = rng.normal(size=(500, 3)) * [0.01, 1.0, 30.0] + [1000.0, -2.0, 5.0]
    obs = obs.astype(np.float32)
    statistics = normalizer.init(3)
    update = jax.jit(normalizer.update)
    for batch in np.split(obs, 50):
        statistics = update(statistics, batch.reshape(5, 2, 3))
    exact = obs.astype(np.float64)
    assert int(statistics.count) == 500
    np.testing.assert_allclose(statistics.mean, exact.mean(0), rtol=1e-6)
    np.testing.assert_allclose(statistics.m2 / 500, exact.var(0), rtol=0.02)
    got = normalizer.normalize(statistics, obs)
    expected = (exact - exact.mean(0)) / exact.std(0)
    np.testing.assert_allclose(got[:, 1:], expected[:, 1:], atol=1e-3)
    np.testing.assert_allclose(got[:, 0], expected[:, 0], atol=0.05)


def test_nothing_seen_changes_nothing_and_outliers_are_clipped():
    obs = np.array([[5.0, -7.0]], np.float32)
    np.testing.assert_array_equal(normalizer.normalize(normalizer.init(2), obs), obs)
    seen = normalizer.update(normalizer.init(2), np.array([[0.0, 0.0], [2.0, 2.0]], np.float32))
    far = normalizer.normalize(seen, np.array([[1e6, -1e6]], np.float32))
    assert far.tolist() == [[normalizer.CLIP, -normalizer.CLIP]]

"""Running observation statistics by Welford's method, merged a batch at a time (Chan et al.)."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from sacformer_jax.types import Normalizer

CLIP = 10.0
"""Normalized observations are clipped to this many standard deviations."""


def init(obs_size: int) -> Normalizer:
    """Statistics of nothing yet."""
    return Normalizer(jnp.zeros((), jnp.int32), jnp.zeros(obs_size), jnp.zeros(obs_size))


def update(normalizer: Normalizer, obs: jax.Array) -> Normalizer:
    """Adds a batch of observations ``[..., O]``."""
    obs = obs.reshape(-1, obs.shape[-1])  # [M, O]
    batch_count = obs.shape[0]
    batch_mean = obs.mean(axis=0)
    batch_m2 = jnp.sum((obs - batch_mean) ** 2, axis=0)
    count = normalizer.count + batch_count
    share = batch_count / count
    delta = batch_mean - normalizer.mean
    return Normalizer(
        count=count,
        mean=normalizer.mean + delta * share,
        m2=normalizer.m2 + batch_m2 + delta**2 * normalizer.count * share,
    )


def normalize(normalizer: Normalizer, obs: jax.Array) -> jax.Array:
    """``(obs - mean) / std``, clipped; the identity before anything was seen."""
    variance = normalizer.m2 / jnp.maximum(normalizer.count, 1)
    std = jnp.sqrt(jnp.maximum(variance, 1e-8))
    normalized = jnp.clip((obs - normalizer.mean) / std, -CLIP, CLIP)
    return jnp.where(normalizer.count > 0, normalized, obs)

"""Running observation statistics by Welford's method, merged a batch at a time (Chan et al.)."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from sacformer_jax.parallel import UNDIVIDED, DataAxis
from sacformer_jax.types import Normalizer

CLIP = 10.0
"""Normalized observations are clipped to this many standard deviations."""


def init(obs_size: int) -> Normalizer:
    """Statistics of nothing yet."""
    return Normalizer(jnp.zeros((), jnp.int32), jnp.zeros(obs_size), jnp.zeros(obs_size))


def update(normalizer: Normalizer, obs: jax.Array, data: DataAxis = UNDIVIDED) -> Normalizer:
    """Adds a batch of observations ``[..., O]``, of each shard."""
    obs = jnp.asarray(obs).reshape(-1, obs.shape[-1])  # [M, O]
    batch_count = obs.shape[0] * data.size
    batch_mean = data.sum(_sum_in_pairs(obs)) / batch_count
    batch_m2 = data.sum(_sum_in_pairs((obs - batch_mean) ** 2))
    count = normalizer.count + batch_count
    share = batch_count / count
    delta = batch_mean - normalizer.mean
    return Normalizer(
        count=count,
        mean=normalizer.mean + delta * share,
        m2=normalizer.m2 + batch_m2 + delta**2 * normalizer.count * share,
    )


def _sum_in_pairs(x: jax.Array) -> jax.Array:
    """Sum over the first axis, halves added until one is left.

    The order is the same under ``vmap``, unlike that of XLA's reductions, so that a seed gets the
    same bits alone and beside others.
    """
    while x.shape[0] > 1:
        half = x.shape[0] // 2
        paired = x[:half] + x[half : 2 * half]  # [half, ...]
        x = paired if x.shape[0] % 2 == 0 else paired.at[0].add(x[-1])
    return x[0]


def normalize(normalizer: Normalizer, obs: jax.Array) -> jax.Array:
    """``(obs - mean) / std``, clipped; the identity before anything was seen."""
    variance = normalizer.m2 / jnp.maximum(normalizer.count, 1)
    std = jnp.sqrt(jnp.maximum(variance, 1e-8))
    normalized = jnp.clip((obs - normalizer.mean) / std, -CLIP, CLIP)
    return jnp.where(normalizer.count > 0, normalized, obs)

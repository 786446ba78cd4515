"""Advantages of an agent's own steps, and the scale of their rewards.

Everything is over T steps in a row of N environments, ``[T, N]``.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from sacformer_jax.normalizer import CLIP
from sacformer_jax.types import Normalizer


def gae(
    reward: jax.Array,
    value: jax.Array,
    next_value: jax.Array,
    terminated: jax.Array,
    truncated: jax.Array,
    bad: jax.Array,
    discount: jax.Array,
    gae_lambda: float,
) -> jax.Array:
    """Generalized advantage estimation (Schulman et al., arXiv 1506.02438, Eq. 16).

    ``A_t = δ_t + γλ A_{t+1}`` with ``δ_t = r_t + γ V(s_{t+1}) - V(s_t)``. Where the task terminated
    nothing follows: no value and no advantage. Where an episode was cut off, and after the last of
    the T steps, the value of the state it came to counts and stands for everything after it.

    Args:
      reward: ``[T, N]``.
      value: ``[T, N]`` of the states acted on.
      next_value: ``[T, N]`` of the states that the steps led to, before any reset.
      terminated: bool ``[T, N]``.
      truncated: bool ``[T, N]``.
      bad: bool ``[T, N]`` steps that mean nothing; their advantage is 0, so that the one before
        stands on the value of the state that it led to.
      discount: γ.
      gae_lambda: λ.

    Returns:
      ``[T, N]``.
    """
    following = jnp.where(terminated, 0.0, next_value)
    delta = jnp.where(bad, 0.0, reward + discount * following - value)
    decay = jnp.where(terminated | truncated, 0.0, discount * gae_lambda)

    def backward(
        later: jax.Array, step: tuple[jax.Array, jax.Array]
    ) -> tuple[jax.Array, jax.Array]:
        advantage = step[0] + step[1] * later
        return advantage, advantage

    nothing = jnp.zeros_like(delta[0])
    return jax.lax.scan(backward, nothing, (delta, decay), reverse=True)[1]


def discounted_returns(
    reward: jax.Array, done: jax.Array, before: jax.Array, discount: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """``R_t = γ R_{t-1} + r_t``, from 0 in each episode.

    Args:
      reward: ``[T, N]``.
      done: bool ``[T, N]`` the episode ended with that step.
      before: ``[N]`` R of the running episodes before the first step.
      discount: γ.

    Returns:
      R ``[T, N]``, and ``[N]`` after the last step, 0 where it ended an episode.
    """

    def forward(
        running: jax.Array, step: tuple[jax.Array, jax.Array]
    ) -> tuple[jax.Array, jax.Array]:
        reward, done = step
        returned = discount * running + reward
        return jnp.where(done, 0.0, returned), returned

    after, returns = jax.lax.scan(forward, before, (reward, done))
    return returns, after


def scale_reward(statistics: Normalizer, reward: jax.Array) -> jax.Array:
    """Rewards over the standard deviation of discounted returns, clipped at 10; any shape.

    Args:
      statistics: of :func:`discounted_returns`, ``O = 1``; at least one was seen.
      reward: not centred, or it would mean something else.
    """
    variance = statistics.m2[0] / statistics.count
    return jnp.clip(reward / jnp.sqrt(variance + 1e-8), -CLIP, CLIP)

"""Return-to-go arithmetic and the acting context of the last K (return, state) pairs."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from sacformer_jax.types import Acted, Cache, Context


def empty(
    num_envs: int, context_length: int, obs_size: int, action_size: int, cache: Cache
) -> Context:
    """A context without any pair, ``[N, K]``; ``cache`` as from ``Agent.init_cache``."""
    return Context(
        obs=jnp.zeros((num_envs, context_length, obs_size)),
        action=jnp.zeros((num_envs, context_length, action_size)),
        return_so_far=jnp.zeros((num_envs, context_length)),
        time_step=jnp.zeros((num_envs, context_length), jnp.int32),
        mask=jnp.zeros((num_envs, context_length), bool),
        cache=cache,
    )


def push(
    context: Context, obs: jax.Array, return_so_far: jax.Array, time_step: jax.Array
) -> Context:
    """Appends a pair to every context and drops the oldest.

    Args:
      context: ``[N, K]`` pairs.
      obs: ``[N, O]``.
      return_so_far: ``[N]`` reward collected before ``obs``.
      time_step: int32 ``[N]``.
    """

    def append(old: jax.Array, new: jax.Array) -> jax.Array:
        kept, new = old[:, 1:], new[:, None]
        return jnp.concatenate([kept, new], axis=1) if kept.shape[1] else new  # [N, K, ...]

    return dataclasses.replace(
        context,
        obs=append(context.obs, obs),
        action=append(context.action, jnp.zeros_like(context.action[:, -1])),
        return_so_far=append(context.return_so_far, return_so_far),
        time_step=append(context.time_step, time_step),
        mask=append(context.mask, jnp.ones(obs.shape[0], bool)),
    )


def start(obs: jax.Array, context_length: int, action_size: int, cache: Cache) -> Context:
    """The context at the first state of an episode: ``obs [N, O]``; ``cache`` as in `empty`."""
    num_envs, obs_size = obs.shape
    return push(
        empty(num_envs, context_length, obs_size, action_size, cache),
        obs,
        jnp.zeros(num_envs),
        jnp.zeros(num_envs, jnp.int32),
    )


def advance(acted: Acted, next_obs: jax.Array, reward: jax.Array, done: jax.Array) -> Context:
    """The context after a step: cleared where the episode ended.

    Args:
      acted: the context acted on, and what was done there.
      next_obs: ``[N, O]`` the state to act on next, after the reset where ``done``.
      reward: ``[N]``.
      done: bool ``[N]``.
    """
    context = acted.context
    return_so_far = jnp.where(done, 0.0, context.return_so_far[:, -1] + reward)
    time_step = jnp.where(done, 0, context.time_step[:, -1] + 1)
    kept = dataclasses.replace(
        context,
        action=context.action.at[:, -1].set(acted.action),
        mask=context.mask & ~done[:, None],
    )
    return push(kept, next_obs, return_so_far, time_step)


def commanded_return_to_go(
    return_so_far: jax.Array, target_return: jax.Array, return_scale: jax.Array
) -> jax.Array:
    """Eq. 1 unrolled: ``G_t = G_1 - (R_1 + … + R_{t-1})``, scaled. Any shape."""
    return (target_return - return_so_far) / return_scale


def all_discounted_suffix_sums(rewards: jax.Array, discount: jax.Array) -> jax.Array:
    """``G_i = Σ_{l ≥ i} discount^(l-i) rewards_l`` for every position: ``[B, L]`` -> ``[B, L]``.

    By doubling: sums of 1, 2, 4, … terms, so that L positions take log2(L) passes.
    """
    sums, span = rewards, 1
    while span < rewards.shape[1]:
        sums = sums + discount * jnp.pad(sums[:, span:], ((0, 0), (0, span)))
        discount, span = discount * discount, 2 * span
    return sums


def discounted_suffix_sums(rewards: jax.Array, num: int, discount: jax.Array) -> jax.Array:
    """``G_i = Σ_{l ≥ i} discount^(l-i) rewards_l`` for the first ``num`` positions.

    A backward sum, not a difference of prefix sums, which would lose all precision in float32.
    For a few positions, as in a window, cheaper than the sums of all.

    Args:
      rewards: ``[B, L]``, zero after the episode's end.
      num: how many leading positions are wanted, at most L.
      discount: scalar.

    Returns:
      ``[B, num]``.
    """
    powers = discount ** jnp.arange(rewards.shape[1] - num + 1)
    last = jnp.sum(rewards[:, num - 1 :] * powers, axis=1)
    sums = [last]
    for i in reversed(range(num - 1)):
        sums.append(rewards[:, i] + discount * sums[-1])
    return jnp.stack(sums[::-1], axis=1)  # [B, num]

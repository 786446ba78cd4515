"""A policy's episodes, step by step, as a dataset has them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import numpy as np

from sacformer_jax import context as contexts
from sacformer_jax.envs.core import VectorEnv, VectorStep
from sacformer_jax.offline import Episode
from sacformer_jax.types import Acted, Context

_ACTING_STREAM = 2**31
"""Folded into the key: beyond the small numbers by which the environments split it."""

Choose = Callable[[Context, jax.Array], Acted]
"""What is done at contexts of N environments, by a key."""


@flax.struct.dataclass
class _Seen:
    """A step of N environments: the observation acted on, the action, and what came of it."""

    obs: jax.Array
    action: jax.Array
    step: VectorStep


def make_collector(
    env: VectorEnv, choose: Choose, context_length: int, cache: Any
) -> Callable[[jax.Array], list[Episode]]:
    """``collect(key) -> N episodes``, one of each environment, by the key of resets and acting.

    Those that bad physics ended are left out. Compiled once.

    Args:
      env: the environments.
      choose: how to act.
      context_length: K.
      cache: of contexts at the start of their episodes, ``agent.init_cache(N)``.
    """

    def step(carry: Any, act_key: jax.Array) -> tuple[Any, _Seen]:
        env_state, context = carry
        acted = choose(context, act_key)
        next_state, taken = env.step(env_state, acted.action)
        context = contexts.advance(acted, taken.next_obs, taken.reward, taken.done)
        return (next_state, context), _Seen(env_state.obs, acted.action, taken)

    @jax.jit
    def scan(key: jax.Array) -> _Seen:
        env_state = env.init(key)
        context = contexts.start(env_state.obs, context_length, env.spec.action_size, cache)
        keys = jax.random.split(jax.random.fold_in(key, _ACTING_STREAM), env.max_episode_steps)
        seen: _Seen = jax.lax.scan(step, (env_state, context), keys)[1]
        return seen  # [T, N, ...]

    def collect(key: jax.Array) -> list[Episode]:
        seen = jax.device_get(scan(key))
        columns = (jax.tree.map(lambda leaf, i=i: leaf[:, i], seen) for i in range(env.num_envs))
        return [episode for column in columns if (episode := _episode(column)) is not None]

    return collect


def _episode(seen: _Seen) -> Episode | None:
    """The first episode of one environment's steps ``[T, ...]``; None where physics broke down."""
    step = seen.step
    length = int(np.argmax(step.done)) + 1
    if np.any(step.bad[:length]):
        return None
    return Episode(
        obs=np.concatenate([seen.obs[:length], step.obs[length - 1 : length]]),
        action=np.asarray(seen.action[:length]),
        reward=np.asarray(step.reward[:length]),
        terminated=bool(step.terminated[length - 1]),
    )

"""Collecting: act, step, remember."""

from __future__ import annotations

from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp

from sacformer_jax import context as contexts
from sacformer_jax.buffer import TrajectoryBuffer
from sacformer_jax.envs.core import VectorEnv, VectorEnvState
from sacformer_jax.parallel import DataAxis
from sacformer_jax.types import Acted, BufferState, Cache, Context, Transition


@flax.struct.dataclass
class RolloutState:
    """What collecting reads and advances: environments, acting contexts, replay."""

    env: VectorEnvState
    context: Context
    buffer: BufferState


@flax.struct.dataclass
class RolloutStats:
    """What happened in a stretch of collecting (scalars).

    Attributes:
      episodes: int32 finished episodes.
      return_sum: sum of their returns.
      return_max: highest of their returns (-inf without any).
      length_sum: int32 sum of their lengths.
      bad_physics: int32 steps dropped because the simulation broke down.
    """

    episodes: jax.Array
    return_sum: jax.Array
    return_max: jax.Array
    length_sum: jax.Array
    bad_physics: jax.Array

    def total(self) -> RolloutStats:
        """Sums (and maximum) over all leading axes."""
        return RolloutStats(
            episodes=self.episodes.sum(),
            return_sum=self.return_sum.sum(),
            return_max=self.return_max.max(),
            length_sum=self.length_sum.sum(),
            bad_physics=self.bad_physics.sum(),
        )

    def over_shards(self, data: DataAxis) -> RolloutStats:
        """Sums (and maximum) over the shards of the environments."""
        return RolloutStats(
            episodes=data.count(self.episodes),
            return_sum=data.sum(self.return_sum),
            return_max=data.max(self.return_max),
            length_sum=data.count(self.length_sum),
            bad_physics=data.count(self.bad_physics),
        )


ChooseAction = Callable[[Context, jax.Array], Acted]
"""``(context, key) -> Acted``."""


def start(env: VectorEnv, buffer: TrajectoryBuffer, cache: Cache, key: jax.Array) -> RolloutState:
    """N fresh episodes and an empty replay; ``cache`` is the agent's for N contexts."""
    env_state = env.init(key)
    return RolloutState(
        env=env_state,
        context=contexts.start(env_state.obs, buffer.context_length, buffer.action_size, cache),
        buffer=buffer.init(),
    )


def collect(
    env: VectorEnv,
    buffer: TrajectoryBuffer,
    choose_action: ChooseAction,
    state: RolloutState,
    key: jax.Array,
    num_steps: int,
) -> tuple[RolloutState, RolloutStats, jax.Array]:
    """Scans ``num_steps`` steps of all environments into the replay.

    Returns:
      the new state, totals, and the observations acted on ``[num_steps, N, O]``.
    """

    def one_step(
        state: RolloutState, key: jax.Array
    ) -> tuple[RolloutState, tuple[RolloutStats, jax.Array]]:
        acted = choose_action(state.context, key)
        context = acted.context
        env_state, step = env.step(state.env, acted.action)
        transition = Transition(
            obs=context.obs[:, -1],
            action=acted.action,
            reward=step.reward,
            terminated=step.terminated,
            truncated=step.truncated,
            bad=step.bad,
            time_step=context.time_step[:, -1],
            return_so_far=context.return_so_far[:, -1],
        )
        episode_return = transition.return_so_far + step.reward
        stats = RolloutStats(
            episodes=jnp.sum(step.done, dtype=jnp.int32),
            return_sum=jnp.sum(jnp.where(step.done, episode_return, 0.0)),
            return_max=jnp.max(jnp.where(step.done, episode_return, -jnp.inf)),
            length_sum=jnp.sum(jnp.where(step.done, transition.time_step + 1, 0)),
            bad_physics=jnp.sum(step.bad, dtype=jnp.int32),
        )
        next_state = RolloutState(
            env=env_state,
            context=contexts.advance(acted, step.next_obs, step.reward, step.done),
            buffer=buffer.add(state.buffer, transition),
        )
        return next_state, (stats, transition.obs)

    state, (stats, obs) = jax.lax.scan(one_step, state, jax.random.split(key, num_steps))
    return state, stats.total().over_shards(env.data), obs

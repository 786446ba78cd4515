"""Collecting: act, step, and either remember the step or hand it on."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp

from sacformer_jax import context as contexts
from sacformer_jax.buffer import TrajectoryBuffer
from sacformer_jax.envs.core import VectorEnv, VectorEnvState, VectorStep
from sacformer_jax.parallel import DataAxis
from sacformer_jax.types import Acted, BufferState, Cache, Context, Rollout, Transition


@flax.struct.dataclass
class RolloutState:
    """What collecting reads and advances: environments, acting contexts, replay (if any)."""

    env: VectorEnvState
    context: Context
    buffer: BufferState | None


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

    def metrics(self) -> dict[str, jax.Array]:
        """Means over the finished episodes; NaN where none finished."""
        episodes = self.episodes.astype(jnp.float32)
        return {
            "episodes": self.episodes,
            "episode_return_mean": self.return_sum / episodes,
            "episode_return_max": jnp.where(episodes > 0, self.return_max, jnp.nan),
            "episode_length_mean": self.length_sum / episodes,
            "bad_physics": self.bad_physics,
        }


ChooseAction = Callable[[Context, jax.Array], Acted]
"""``(context, key) -> Acted``."""


def start(
    env: VectorEnv,
    buffer: TrajectoryBuffer | None,
    context_length: int,
    cache: Cache,
    key: jax.Array,
) -> RolloutState:
    """N fresh episodes and an empty replay; ``cache`` is the agent's for N contexts."""
    env_state = env.init(key)
    return RolloutState(
        env=env_state,
        context=contexts.start(env_state.obs, context_length, env.spec.action_size, cache),
        buffer=None if buffer is None else buffer.init(),
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
        done = _step(env, choose_action, state, key)
        assert state.buffer is not None
        next_state = dataclasses.replace(
            done.state, buffer=buffer.add(state.buffer, done.transition)
        )
        return next_state, (done.stats, done.transition.obs)

    state, (stats, obs) = jax.lax.scan(one_step, state, jax.random.split(key, num_steps))
    return state, stats.total().over_shards(env.data), obs


def collect_rollout(
    env: VectorEnv,
    choose_action: ChooseAction,
    state: RolloutState,
    key: jax.Array,
    num_steps: int,
) -> tuple[RolloutState, RolloutStats, Rollout]:
    """Scans ``num_steps`` steps of all environments, of an agent that tells what it drew.

    Returns:
      the new state, totals, and the steps.
    """

    def one_step(
        state: RolloutState, key: jax.Array
    ) -> tuple[RolloutState, tuple[RolloutStats, Rollout]]:
        done = _step(env, choose_action, state, key)
        assert done.acted.sample is not None
        steps = Rollout(
            obs=done.transition.obs,
            sample=done.acted.sample,
            reward=done.transition.reward,
            terminated=done.transition.terminated,
            truncated=done.transition.truncated,
            bad=done.transition.bad,
            next_obs=done.step.obs,
        )
        return done.state, (done.stats, steps)

    state, (stats, steps) = jax.lax.scan(one_step, state, jax.random.split(key, num_steps))
    return state, stats.total().over_shards(env.data), steps


@dataclasses.dataclass(frozen=True)
class _Step:
    """One step of all environments: how it was chosen, what it gave, the state after it."""

    acted: Acted
    step: VectorStep
    transition: Transition
    stats: RolloutStats
    state: RolloutState


def _step(
    env: VectorEnv, choose_action: ChooseAction, state: RolloutState, key: jax.Array
) -> _Step:
    """Acts and steps; the replay stays as it is."""
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
        buffer=state.buffer,
    )
    return _Step(acted, step, transition, stats, next_state)

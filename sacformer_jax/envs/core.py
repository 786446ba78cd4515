"""The environment contract, and vectorization with time limit and auto-reset.

An :class:`Env` is a bundle of pure functions of *one* environment. :class:`VectorEnv` runs many,
adds the time limit and resets finished ones. A fresh reset lies prepared beside every running
environment and is swapped in where an episode ends; the *next* step refills those that were used.
So an engine that lives on the host still needs only one call per step, and resets are new every
time.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Protocol

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from sacformer_jax.config import ConfigError
from sacformer_jax.envs.wrapping import UNWRAPPED, Places, Wrapping
from sacformer_jax.parallel import UNDIVIDED, DataAxis, any_of_all


@dataclasses.dataclass(frozen=True)
class EnvSpec:
    """Static facts of an environment.

    Attributes:
      name: what it is called, e.g. ``"HalfCheetah"`` or ``"brax:ant"``.
      obs_size: O, length of an observation (float32).
      action_size: A, length of an action (float32).
      action_low: lower action bounds, ``A`` floats.
      action_high: upper action bounds, ``A`` floats.
      max_episode_steps: the time limit, in environment steps.
      engine: which physics runs it.
      engine_reason: why that engine.
      gymnasium_id: the same task in Gymnasium, or None.
      velocities: places of the observation that are velocities, each ``(start, stop)``, in order;
        empty where nobody said.
      wrapping: the wrappers around it.
    """

    name: str
    obs_size: int
    action_size: int
    action_low: tuple[float, ...]
    action_high: tuple[float, ...]
    max_episode_steps: int
    engine: str
    engine_reason: str
    gymnasium_id: str | None = None
    velocities: Places = ()
    wrapping: Wrapping = UNWRAPPED

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> EnvSpec:
        """Inverse of ``dataclasses.asdict``, also after JSON, and of an earlier version."""
        wrapping = {name: _tuples(value) for name, value in values.get("wrapping", {}).items()}
        facts = {name: _tuples(value) for name, value in values.items()}
        return cls(**{**facts, "wrapping": Wrapping(**wrapping)})


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list | tuple) else value


@flax.struct.dataclass
class EnvStep:
    """What one step of one environment gives, before any reset.

    Attributes:
      obs: ``[O]`` float32, the observation after the step.
      reward: float32.
      terminated: bool, the task ended (value 0 afterwards). Time limits are not known here.
      bad: bool, the physics broke down: the other values are meaningless.
      reward_terms: named parts of the reward (may be empty).
      truncated: bool, the environment cut the episode off by itself, for another reason than the
        time limit; False where it is not given.
    """

    obs: jax.Array
    reward: jax.Array
    terminated: jax.Array
    bad: jax.Array
    reward_terms: dict[str, jax.Array]
    truncated: jax.Array = flax.struct.field(default_factory=lambda: jnp.zeros((), bool))

    @property
    def broke_down(self) -> jax.Array:
        """Bool: ``bad``, or not said to be, but the observation or the reward is not finite."""
        return self.bad | ~jnp.all(jnp.isfinite(self.obs), axis=-1) | ~jnp.isfinite(self.reward)


class Env(Protocol):
    """Pure functions of one environment; vectorized with ``jax.vmap``."""

    spec: EnvSpec

    def reset(self, key: jax.Array) -> tuple[Any, jax.Array]:
        """A fresh episode: ``(env_state, obs [O])``."""
        ...

    def step(self, state: Any, action: jax.Array) -> tuple[Any, EnvStep]:
        """One step under ``action [A]``, never a reset: ``(env_state, step)``."""
        ...

    def step_and_refill(
        self,
        states: Any,
        actions: jax.Array,
        refill: jax.Array,
        prepared: tuple[Any, jax.Array],
        keys: Callable[[], jax.Array],
    ) -> tuple[tuple[Any, EnvStep], tuple[Any, jax.Array]]:
        """Steps N environments and renews the prepared resets where ``refill [N]`` is true.

        ``keys()`` makes a key for each, ``[N]``; it is called where they are needed, so that a step
        in which nothing is to be refilled need not make them.
        """
        ...


def where_tree(condition: jax.Array, if_true: Any, if_false: Any) -> Any:
    """``jnp.where`` over PyTrees whose leaves lead with the axes of ``condition``."""

    def select(a: jax.Array, b: jax.Array) -> jax.Array:
        mask = condition.reshape(condition.shape + (1,) * (a.ndim - condition.ndim))
        return jnp.where(mask, a, b)

    return jax.tree.map(select, if_true, if_false)


class JaxEnv:
    """Base of environments that are JAX all through: refills by ``lax.cond`` only when needed."""

    spec: EnvSpec

    def reset(self, key: jax.Array) -> tuple[Any, jax.Array]:
        raise NotImplementedError

    def step(self, state: Any, action: jax.Array) -> tuple[Any, EnvStep]:
        raise NotImplementedError

    def step_and_refill(
        self,
        states: Any,
        actions: jax.Array,
        refill: jax.Array,
        prepared: tuple[Any, jax.Array],
        keys: Callable[[], jax.Array],
    ) -> tuple[tuple[Any, EnvStep], tuple[Any, jax.Array]]:
        prepared = jax.lax.cond(
            any_of_all(refill),
            lambda: where_tree(refill, jax.vmap(self.reset)(keys()), prepared),
            lambda: prepared,
        )
        return jax.vmap(self.step)(states, actions), prepared


def _successor(key: jax.Array) -> jax.Array:
    """The key after this one, as a counter counts: in a loop on the CPU, hashing even one key takes
    longer than all else a step needs beside the physics. What threefry makes of neighbours is
    unrelated.
    """
    words = jax.random.key_data(key)
    return jax.random.wrap_key_data(words.at[..., -1].add(1), impl=jax.random.key_impl(key))


@flax.struct.dataclass
class VectorEnvState:
    """State of N environments.

    Attributes:
      env: the environments' own states, leaves ``[N, ...]``.
      obs: ``[N, O]`` the observations to act on next.
      time_step: int32 ``[N]``, steps taken in the running episode.
      prepared: ``(env_state, obs)``, a fresh reset for each environment.
      refill: bool ``[N]``, whose prepared reset has been used up.
      key: typed PRNG key.
    """

    env: Any
    obs: jax.Array
    time_step: jax.Array
    prepared: tuple[Any, jax.Array]
    refill: jax.Array
    key: jax.Array


@flax.struct.dataclass
class VectorStep:
    """One step of N environments.

    Attributes:
      obs: ``[N, O]``, the final observation where an episode ended, *before* the reset.
      reward: ``[N]`` float32, 0 where ``bad``.
      terminated: bool ``[N]``, the task ended.
      truncated: bool ``[N]``, cut off by the time limit, the environment itself or bad physics.
      bad: bool ``[N]``, bad physics: this transition must not be learnt from; ``obs`` repeats the
        last good observation.
      next_obs: ``[N, O]``, the observation to act on next (after the reset where one happened).
      reward_terms: named parts of the reward, each ``[N]``.
    """

    obs: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    bad: jax.Array
    next_obs: jax.Array
    reward_terms: dict[str, jax.Array]

    @property
    def done(self) -> jax.Array:
        """The episode ended, whichever way: bool ``[N]``."""
        return self.terminated | self.truncated


class VectorEnv:
    """N copies of an environment with time limit and auto-reset.

    Args:
      env: the environment.
      num_envs: how many in all.
      max_episode_steps: the time limit; default: the environment's own.
      data: how they are split over devices; N is one shard's share. Keys are those of one device.

    Attributes:
      num_envs: N.

    Raises:
      ConfigError: ``num_envs`` or ``max_episode_steps`` is below 1, or the shards do not divide
        ``num_envs``.
    """

    def __init__(
        self,
        env: Env,
        num_envs: int,
        max_episode_steps: int | None = None,
        data: DataAxis = UNDIVIDED,
    ):
        if num_envs < 1:
            raise ConfigError(f"num_envs={num_envs}: must be at least 1")
        if num_envs % data.size:
            raise ConfigError(
                f"num_envs={num_envs}: must be a multiple of data_devices={data.size}"
            )
        limit = env.spec.max_episode_steps if max_episode_steps is None else max_episode_steps
        if limit < 1:
            raise ConfigError(f"max_episode_steps={limit}: must be at least 1")
        longest = getattr(env, "longest_episode", limit)  # where its states have only so much room
        if limit > longest:
            raise ConfigError(
                f"max_episode_steps={limit}: this {env.spec.name} was made for at most {longest}; "
                f"give make_env the same max_episode_steps={limit}"
            )
        self.env = env
        self.data, self.num_envs = data, num_envs // data.size
        self.max_episode_steps = limit
        self.spec = dataclasses.replace(env.spec, max_episode_steps=limit)

    def init(self, key: jax.Array) -> VectorEnvState:
        """N fresh episodes, and as many prepared."""
        key, start_key, prepared_key = jax.random.split(key, 3)
        reset = jax.vmap(self.env.reset)
        env_state, obs = reset(self._keys(start_key))
        return VectorEnvState(
            env=env_state,
            obs=obs,
            time_step=jnp.zeros(self.num_envs, jnp.int32),
            prepared=reset(self._keys(prepared_key)),
            refill=jnp.zeros(self.num_envs, bool),
            key=key,
        )

    def step(self, state: VectorEnvState, action: jax.Array) -> tuple[VectorEnvState, VectorStep]:
        """Steps all environments under ``action [N, A]`` and resets those that finished."""
        (env_state, step), prepared = self.env.step_and_refill(
            state.env, action, state.refill, state.prepared, lambda: self._keys(state.key)
        )
        bad = step.broke_down
        time_step = state.time_step + 1
        terminated = step.terminated & ~bad
        cut_off = step.truncated | (time_step >= self.max_episode_steps)
        truncated = bad | (~terminated & cut_off)
        done = terminated | truncated
        obs = jnp.where(bad[:, None], state.obs, step.obs)
        next_env, next_obs = where_tree(done, prepared, (env_state, obs))
        next_state = VectorEnvState(
            env=next_env,
            obs=next_obs,
            time_step=jnp.where(done, 0, time_step),
            prepared=prepared,
            refill=done,
            key=_successor(state.key),
        )
        return next_state, VectorStep(
            obs=obs,
            reward=jnp.where(bad, 0.0, step.reward),
            terminated=terminated,
            truncated=truncated,
            bad=bad,
            next_obs=next_obs,
            reward_terms={
                name: jnp.where(bad, 0.0, term) for name, term in step.reward_terms.items()
            },
        )

    def random_action(self, key: jax.Array) -> jax.Array:
        """Uniform actions within the bounds, ``[N, A]``."""
        low, high = np.asarray(self.spec.action_low), np.asarray(self.spec.action_high)
        shape = (self.num_envs * self.data.size, self.spec.action_size)
        return self.data.rows(jax.random.uniform(key, shape, jnp.float32, low, high))

    def _keys(self, key: jax.Array) -> jax.Array:
        """A key for each environment."""
        return self.data.rows(jax.random.split(key, self.num_envs * self.data.size))

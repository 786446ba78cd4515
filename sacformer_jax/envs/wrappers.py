"""Wrappers that hide, delay and stack: around any environment, an environment again.

They are pure and make one step of the environment within out of one of theirs, so one call to the
host a step stays one. The same for Gymnasium's: :mod:`sacformer_jax.envs.gym_wrappers`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from sacformer_jax.config import ConfigError
from sacformer_jax.envs.core import Env, EnvSpec, EnvStep, where_tree
from sacformer_jax.envs.wrapping import UNWRAPPED, Wrapping, are_places, neutral_action, others


@flax.struct.dataclass
class WrapperState:
    """State of a wrapped environment.

    Attributes:
      env: of the environment within.
      memory: what the wrapper remembers, a PyTree of arrays.
    """

    env: Any
    memory: Any


class Wrapper:
    """Base of wrappers. What else is asked of one, the environment within answers.

    Attributes:
      env: the environment within.
      spec: facts of the wrapped one.
    """

    env: Env
    spec: EnvSpec

    def __getattr__(self, name: str) -> Any:
        if name == "env":  # not there yet: a copy that is being made
            raise AttributeError(name)
        return getattr(self.env, name)

    # --- what a wrapper is: pure functions of one environment --------------------------------

    def _fresh(self, obs: jax.Array) -> tuple[Any, jax.Array]:
        """Memory and observation at an episode's start, where the one within observes ``obs``."""
        raise NotImplementedError

    def _applied(self, memory: Any, action: jax.Array) -> jax.Array:
        """The action that the environment within takes."""
        return action

    def _seen(self, memory: Any, action: jax.Array, step: EnvStep) -> tuple[Any, EnvStep]:
        """Memory and step after the environment within made ``step``."""
        raise NotImplementedError

    # --- the contract ------------------------------------------------------------------------

    def reset(self, key: jax.Array) -> tuple[WrapperState, jax.Array]:
        inner, obs = self.env.reset(key)
        memory, obs = self._fresh(obs)
        return WrapperState(inner, memory), obs

    def step(self, state: WrapperState, action: jax.Array) -> tuple[WrapperState, EnvStep]:
        inner, step = self.env.step(state.env, self._applied(state.memory, action))
        memory, step = self._seen(state.memory, action, step)
        return WrapperState(inner, memory), step

    def step_and_refill(
        self,
        states: WrapperState,
        actions: jax.Array,
        refill: jax.Array,
        prepared: tuple[WrapperState, jax.Array],
        keys: Callable[[], jax.Array],
    ) -> tuple[tuple[WrapperState, EnvStep], tuple[WrapperState, jax.Array]]:
        kept, kept_obs = prepared
        # Nobody looks at what the environment within observed at resets that are not renewed.
        no_obs = jnp.zeros((len(refill), self.env.spec.obs_size))
        (inner, steps), (fresh, fresh_obs) = self.env.step_and_refill(
            states.env,
            jax.vmap(self._applied)(states.memory, actions),
            refill,
            (kept.env, no_obs),
            keys,
        )
        memory, steps = jax.vmap(self._seen)(states.memory, actions, steps)
        renewed = where_tree(refill, jax.vmap(self._fresh)(fresh_obs), (kept.memory, kept_obs))
        return (WrapperState(inner, memory), steps), (WrapperState(fresh, renewed[0]), renewed[1])


class HiddenVelocities(Wrapper):
    """Leaves the velocities out of the observation.

    Args:
      env: an environment that says which they are, by :attr:`EnvSpec.velocities`.

    Raises:
      ConfigError: it does not, or nothing else is observed, or it has been wrapped before.
    """

    def __init__(self, env: Env):
        what, spec = "hide_velocities=True", env.spec
        _check_order(what, spec, UNWRAPPED)
        if not spec.velocities:
            raise ConfigError(
                f"{what}: env={spec.name!r} does not say which of its observations are "
                "velocities; use hide_velocities=False, or name them in the velocities of its "
                "Task or EnvSpec"
            )
        if not are_places(spec.velocities, spec.obs_size):
            raise ConfigError(
                f"{what}: env={spec.name!r} has velocities={spec.velocities!r}: must be pairs "
                f"(start, stop) in order, within its {spec.obs_size} observations"
            )
        self._kept = others(spec.velocities, spec.obs_size)
        if not self._kept:
            raise ConfigError(f"{what}: env={spec.name!r} observes nothing but velocities")
        self.env = env
        self.spec = dataclasses.replace(
            spec,
            obs_size=sum(stop - start for start, stop in self._kept),
            velocities=(),
            wrapping=Wrapping(hidden=spec.velocities),
        )

    def _fresh(self, obs: jax.Array) -> tuple[Any, jax.Array]:
        return (), self._shown(obs)

    def _seen(self, memory: Any, action: jax.Array, step: EnvStep) -> tuple[Any, EnvStep]:
        # A velocity that is not finite can no longer be seen by who looks for bad physics.
        bad = step.bad | ~jnp.all(jnp.isfinite(step.obs))
        return (), dataclasses.replace(step, obs=self._shown(step.obs), bad=bad)

    def _shown(self, obs: jax.Array) -> jax.Array:
        return jnp.concatenate([obs[start:stop] for start, stop in self._kept])


class ActionDelay(Wrapper):
    """An action takes effect some steps after it was chosen.

    Until the first one does, the environment takes 0, or the middle of bounds that leave 0 out.
    Costs of an action are those of the one that takes effect.

    Args:
      env: the environment.
      action_delay: how many steps.

    Raises:
      ConfigError: it is negative, or the environment is delayed or stacked already.
    """

    def __init__(self, env: Env, action_delay: int):
        what, spec = f"action_delay={action_delay}", env.spec
        _check_order(what, spec, Wrapping(hidden=spec.wrapping.hidden))
        if action_delay < 0:
            raise ConfigError(f"{what}: must not be negative")
        self.env = env
        wrapping = dataclasses.replace(spec.wrapping, action_delay=action_delay)
        self.spec = dataclasses.replace(spec, wrapping=wrapping)
        neutral = neutral_action(np.array(spec.action_low), np.array(spec.action_high))
        self._waiting = np.tile(neutral, (action_delay, 1))  # [action_delay, A], oldest first

    def _fresh(self, obs: jax.Array) -> tuple[Any, jax.Array]:
        return jnp.asarray(self._waiting), obs

    def _applied(self, memory: Any, action: jax.Array) -> jax.Array:
        return self._queue(memory, action)[0]

    def _seen(self, memory: Any, action: jax.Array, step: EnvStep) -> tuple[Any, EnvStep]:
        return self._queue(memory, action)[1:], step

    def _queue(self, waiting: jax.Array, action: jax.Array) -> jax.Array:
        return jnp.concatenate([waiting, action[None].astype(jnp.float32)])


@flax.struct.dataclass
class _Last:
    """The last K observations ``[K, O]`` and the K - 1 actions between them, oldest first."""

    obs: jax.Array
    actions: jax.Array


class StackedObs(Wrapper):
    """The last K observations as one, oldest first, then the K - 1 actions chosen between them.

    An episode's first observation stands for those before it, as in Gymnasium's
    ``FrameStackObservation`` with ``padding_type="reset"``, and 0 for the actions.

    Args:
      env: the environment.
      stack_obs: K.

    Raises:
      ConfigError: it is below 1, or the environment is stacked already.
    """

    def __init__(self, env: Env, stack_obs: int):
        what, spec = f"stack_obs={stack_obs}", env.spec
        _check_order(what, spec, dataclasses.replace(spec.wrapping, stack_obs=1))
        if stack_obs < 1:
            raise ConfigError(f"{what}: must be at least 1")
        self.env, self._size = env, stack_obs
        self.spec = dataclasses.replace(
            spec,
            obs_size=stack_obs * spec.obs_size + (stack_obs - 1) * spec.action_size,
            velocities=(),
            wrapping=dataclasses.replace(spec.wrapping, stack_obs=stack_obs),
        )

    def _fresh(self, obs: jax.Array) -> tuple[Any, jax.Array]:
        last = _Last(
            obs=jnp.tile(obs, (self._size, 1)),
            actions=jnp.zeros((self._size - 1, self.spec.action_size)),
        )
        return last, _as_one(last)

    def _seen(self, memory: Any, action: jax.Array, step: EnvStep) -> tuple[Any, EnvStep]:
        last = _Last(
            obs=jnp.concatenate([memory.obs, step.obs[None]])[1:],
            actions=jnp.concatenate([memory.actions, action[None].astype(jnp.float32)])[1:],
        )
        return last, dataclasses.replace(step, obs=_as_one(last))


def wrapped(
    env: Env, hide_velocities: bool = False, action_delay: int = 0, stack_obs: int = 1
) -> Env:
    """An environment with the wrappers asked for; itself, where there are none.

    Args:
      env: the environment.
      hide_velocities: leave the velocities out of the observation.
      action_delay: steps between choosing an action and its effect.
      stack_obs: observations seen as one, with the actions between them.

    Raises:
      ConfigError: see :class:`HiddenVelocities`, :class:`ActionDelay` and :class:`StackedObs`.
    """
    if hide_velocities:
        env = HiddenVelocities(env)
    if action_delay:
        env = ActionDelay(env, action_delay)
    if stack_obs != 1:
        env = StackedObs(env, stack_obs)
    return env


def _as_one(last: _Last) -> jax.Array:
    return jnp.concatenate([last.obs.reshape(-1), last.actions.reshape(-1)])


def _check_order(what: str, spec: EnvSpec, inside: Wrapping) -> None:
    """Facts say what was wrapped, not in which order: there is but one."""
    if spec.wrapping != inside:
        raise ConfigError(
            f"{what}: env={spec.name!r} is wrapped already ({', '.join(spec.wrapping.words())}); "
            "from the inside outwards there may be HiddenVelocities, ActionDelay and StackedObs, "
            "each once"
        )

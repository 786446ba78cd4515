"""The wrappers of :mod:`sacformer_jax.envs.wrappers` for environments of Gymnasium."""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec, WrapperSpec
from gymnasium.utils import RecordConstructorArgs

from sacformer_jax.envs.wrapping import Places, Wrapping, neutral_action, others


class HiddenVelocities(gymnasium.ObservationWrapper, RecordConstructorArgs):
    """Leaves the velocities out of the observation.

    Args:
      env: the environment.
      velocities: their places, each ``(start, stop)``, in order.

    Raises:
      ValueError: observations are not vectors.
    """

    def __init__(self, env: gymnasium.Env, velocities: Places):
        RecordConstructorArgs.__init__(self, velocities=velocities)
        gymnasium.ObservationWrapper.__init__(self, env)
        space = _box("observation_space", env.observation_space)
        self._kept = others(velocities, space.shape[0])
        self.observation_space = gymnasium.spaces.Box(
            self.observation(space.low), self.observation(space.high), dtype=space.dtype
        )

    def observation(self, observation: np.ndarray) -> np.ndarray:
        return np.concatenate([observation[start:stop] for start, stop in self._kept])


class ActionDelay(gymnasium.Wrapper, RecordConstructorArgs):
    """An action takes effect some steps after it was chosen; before that 0 or the bounds' middle.

    Args:
      env: the environment.
      action_delay: how many steps.

    Raises:
      ValueError: actions are not vectors.
    """

    def __init__(self, env: gymnasium.Env, action_delay: int):
        RecordConstructorArgs.__init__(self, action_delay=action_delay)
        gymnasium.Wrapper.__init__(self, env)
        space = _box("action_space", env.action_space)
        self._delay = action_delay
        self._neutral = neutral_action(space.low, space.high).astype(space.dtype)
        self._waiting: deque[np.ndarray] = deque()

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        self._waiting = deque(self._neutral.copy() for _ in range(self._delay))
        return self.env.reset(**kwargs)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        self._waiting.append(np.array(action))  # its own, whatever becomes of the caller's
        return self.env.step(self._waiting.popleft())


class StackedObs(gymnasium.Wrapper, RecordConstructorArgs):
    """The last K observations as one, oldest first, then the K - 1 actions chosen between them.

    At an episode's start the first observation is repeated, and actions are 0.

    Args:
      env: the environment.
      stack_obs: K.

    Raises:
      ValueError: observations or actions are not vectors.
    """

    def __init__(self, env: gymnasium.Env, stack_obs: int):
        RecordConstructorArgs.__init__(self, stack_obs=stack_obs)
        gymnasium.Wrapper.__init__(self, env)
        self._obs: deque[np.ndarray] = deque(maxlen=stack_obs)
        self._actions: deque[np.ndarray] = deque(maxlen=stack_obs - 1)
        space = _box("observation_space", env.observation_space)
        actions = _box("action_space", env.action_space)
        self._no_action = np.zeros(actions.shape, space.dtype)

        def bound(obs: np.ndarray, action: np.ndarray) -> np.ndarray:
            both = [*[obs] * stack_obs, *[action] * (stack_obs - 1)]
            return np.concatenate(both).astype(space.dtype)

        self.observation_space = gymnasium.spaces.Box(
            bound(space.low, np.minimum(actions.low, 0)),
            bound(space.high, np.maximum(actions.high, 0)),
            dtype=space.dtype,
        )

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict[str, Any]]:
        obs, info = self.env.reset(**kwargs)
        self._obs.extend([np.array(obs)] * (self._obs.maxlen or 0))
        self._actions.extend([self._no_action] * (self._actions.maxlen or 0))
        return self._as_one(), info

    def step(self, action: Any) -> tuple[np.ndarray, Any, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = self.env.step(action)
        self._obs.append(np.array(obs))
        self._actions.append(np.array(action, self._no_action.dtype))
        return self._as_one(), reward, terminated, truncated, info

    def _as_one(self) -> np.ndarray:
        return np.concatenate([*self._obs, *self._actions])


def gym_wrapped(env: gymnasium.Env, wrapping: Wrapping) -> gymnasium.Env:
    """A Gymnasium environment with these wrappers; itself, where there are none."""
    for wrapper, arguments in _wrappers(wrapping):
        env = wrapper(env, **arguments)
    return env


def gym_wrapped_spec(spec: EnvSpec, wrapping: Wrapping) -> EnvSpec:
    """What ``gymnasium.make`` makes an environment with these wrappers of."""
    spec = copy.deepcopy(spec)
    spec.additional_wrappers += tuple(
        WrapperSpec(wrapper.__name__, f"{wrapper.__module__}:{wrapper.__name__}", arguments)
        for wrapper, arguments in _wrappers(wrapping)
    )
    return spec


def _wrappers(wrapping: Wrapping) -> Iterator[tuple[Any, dict[str, Any]]]:
    """Their classes and arguments, innermost first."""
    if wrapping.hidden:
        yield HiddenVelocities, {"velocities": wrapping.hidden}
    if wrapping.action_delay:
        yield ActionDelay, {"action_delay": wrapping.action_delay}
    if wrapping.stack_obs != 1:
        yield StackedObs, {"stack_obs": wrapping.stack_obs}


def _box(name: str, space: Any) -> gymnasium.spaces.Box:
    if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
        raise ValueError(f"{name}={space}: must be a Box of one axis")
    return space

"""What Gymnasium's registry says of an id, and which environments we can take."""

from __future__ import annotations

import dataclasses
import difflib
import importlib
import numbers
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec as RegisteredSpec

from sacformer_jax.config import ConfigError
from sacformer_jax.envs.gym_live import GymFacts, make
from sacformer_jax.presets import UNKNOWN_TARGET, Layer

DEFAULT_LIMIT = 1000
"""Time limit of an environment that is registered without one."""


@dataclasses.dataclass(frozen=True)
class Found:
    """An environment that we can take.

    Attributes:
      env: one of it.
      facts: what the host needs to know.
      action_low: ``A`` floats.
      action_high: ``A`` floats.
    """

    env: gymnasium.Env
    facts: GymFacts
    action_low: tuple[float, ...]
    action_high: tuple[float, ...]


def registered(env_id: str) -> RegisteredSpec:
    """What is registered under an id.

    Args:
      env_id: the id, or ``"module:ID"`` for one that a module registers when it is imported.

    Raises:
      ConfigError: there is no such module or id; the message names ids that are close.
    """
    module, _, name = env_id.rpartition(":")
    if module:
        try:
            importlib.import_module(module)
        except ImportError as error:
            raise ConfigError(
                f"env='gym:{env_id}': cannot import {module!r}, which is to register {name!r}: "
                f"{error}"
            ) from error
    if name in gymnasium.registry:
        return gymnasium.registry[name]
    close = difflib.get_close_matches(name, list(gymnasium.registry), n=5)
    raise ConfigError(
        f"env='gym:{env_id}': Gymnasium knows no such id; "
        + (f"close ones are {', '.join(close)}; " if close else "")
        + "an id that a package registers when imported is written gym:PACKAGE:ID"
    )


def time_limit(spec: RegisteredSpec) -> int:
    """The id's own time limit, in steps."""
    return spec.max_episode_steps or DEFAULT_LIMIT


def task_layers(env_id: str) -> tuple[Layer, ...]:
    """Settings that the registry knows better than our defaults.

    Raises:
      ConfigError: see :func:`registered`.
    """
    spec = registered(env_id)
    layers = [Layer("the id's own time limit", {"max_episode_steps": time_limit(spec)})]
    if spec.reward_threshold is not None:
        target = float(spec.reward_threshold)
        scale = abs(target) / 10 or 1.0
        layers.append(
            Layer(
                "the id's reward threshold, and a tenth of it",
                {"target_return": target, "return_scale": scale},
            )
        )
    else:
        layers.append(UNKNOWN_TARGET)
    return tuple(layers)


def find(env_id: str, max_steps: int) -> Found:
    """Makes one environment and looks whether it is of the kind we can take.

    Args:
      env_id: see :func:`registered`.
      max_steps: steps of the longest episode.

    Raises:
      ConfigError: it cannot be made or stepped (a package is missing), or its spaces are of
        another kind.
    """
    registered(env_id)
    try:
        env = make(env_id)
    except Exception as error:
        raise ConfigError(
            f"env='gym:{env_id}': Gymnasium cannot make it: {type(error).__name__}: {error}"
        ) from error
    try:
        _check_host(env_id, env)
        actions = _checked_actions(env_id, env.action_space)
        obs_size = _checked_observations(env_id, env.observation_space)
        terms = _reward_terms(env_id, env, actions)
    except BaseException:
        env.close()
        raise
    low, high = (bound.astype(np.float32) for bound in (actions.low, actions.high))
    facts = GymFacts(
        env_id=env_id,
        obs_size=obs_size,
        action_size=actions.shape[0],
        action_dtype=actions.dtype,
        reward_terms=terms,
        max_steps=max_steps,
    )
    return Found(env, facts, tuple(low.tolist()), tuple(high.tolist()))


def _check_host(env_id: str, env: gymnasium.Env) -> None:
    if any(base.__name__ == "FunctionalJaxEnv" for base in type(env.unwrapped).__mro__):
        raise ConfigError(
            f"env='gym:{env_id}': runs JAX itself, which can hang inside a call from a JAX "
            "program; use its functions in an environment of our contract instead"
        )


def _checked_actions(env_id: str, space: spaces.Space) -> spaces.Box:
    kind = f"env='gym:{env_id}': action_space is {space}; what can be taken is"
    if not isinstance(space, spaces.Box) or not np.issubdtype(space.dtype, np.floating):
        raise ConfigError(f"{kind} a Box of floats: continuous actions")
    if len(space.shape) != 1 or space.shape[0] < 1:
        raise ConfigError(f"{kind} a Box with one axis: a vector")
    if not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
        raise ConfigError(
            f"{kind} a bounded Box, since actions are drawn from within the bounds; "
            "gymnasium.wrappers.RescaleAction or ClipAction among the id's wrappers sets some"
        )
    if not (space.low < space.high).all():
        raise ConfigError(f"{kind} a Box whose upper bounds are above the lower ones")
    return space


def _checked_observations(env_id: str, space: spaces.Space) -> int:
    kind = f"env='gym:{env_id}': observation_space is {space}; what can be taken is"
    remedy = "gymnasium.wrappers.FlattenObservation among the id's wrappers makes one of it"
    if not isinstance(space, spaces.Box):
        raise ConfigError(f"{kind} a Box with one axis: a vector; {remedy}")
    if len(space.shape) >= 2 and space.dtype == np.uint8:
        raise ConfigError(f"{kind} a vector; there are no networks for images")
    if len(space.shape) != 1 or space.shape[0] < 1:
        raise ConfigError(f"{kind} a Box with one axis: a vector; {remedy}")
    return space.shape[0]


def _reward_terms(env_id: str, env: gymnasium.Env, actions: spaces.Box) -> tuple[str, ...]:
    """Names of the parts of the reward in ``info``, found by one step."""
    try:
        env.reset(seed=0)
        info = env.step(((actions.low + actions.high) / 2).astype(actions.dtype))[4]
    except Exception as error:
        raise ConfigError(
            f"env='gym:{env_id}': its first step fails: {type(error).__name__}: {error}"
        ) from error
    return tuple(sorted(reward_terms(info)))


def reward_terms(info: dict[str, Any]) -> dict[str, float]:
    """The parts of the reward in a step's ``info``: its numbers whose names begin with
    ``reward_``.
    """
    return {
        name: float(value)
        for name, value in info.items()
        if name.startswith("reward_") and _is_number(value)
    }


def _is_number(value: Any) -> bool:
    if isinstance(value, numbers.Real | np.bool_):
        return True
    # Not only NumPy's: whatever has a type and no axes.
    kind, shape = getattr(value, "dtype", None), getattr(value, "shape", None)
    return shape == () and isinstance(kind, np.dtype) and kind.kind in "biuf"

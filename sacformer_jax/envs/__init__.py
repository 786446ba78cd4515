"""Environments by name."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sacformer_jax import env_names
from sacformer_jax.config import ConfigError, TaskConfig
from sacformer_jax.envs.checking import check_env
from sacformer_jax.envs.core import (
    Env,
    EnvSpec,
    EnvStep,
    JaxEnv,
    VectorEnv,
    VectorEnvState,
    VectorStep,
)
from sacformer_jax.envs.mujoco_env import MujocoEnv
from sacformer_jax.envs.own import as_env, own_env, register_env
from sacformer_jax.envs.physics import ENGINES, EngineChoice
from sacformer_jax.envs.tasks import TASKS, Coordinates, Quantities, Task
from sacformer_jax.envs.wrappers import ActionDelay, HiddenVelocities, StackedObs, Wrapper, wrapped
from sacformer_jax.envs.wrapping import Wrapping
from sacformer_jax.presets import TASK_LAYERS, UNKNOWN_TARGET, Layer

if TYPE_CHECKING:
    from sacformer_jax.envs.brax_view import BraxView

BRAX_PREFIX, GYM_PREFIX, PLAYGROUND_PREFIX = "brax:", "gym:", "playground:"

__all__ = [
    "ENGINES",
    "TASKS",
    "ActionDelay",
    "Coordinates",
    "EngineChoice",
    "Env",
    "EnvSpec",
    "EnvStep",
    "HiddenVelocities",
    "JaxEnv",
    "MujocoEnv",
    "Quantities",
    "StackedObs",
    "Task",
    "VectorEnv",
    "VectorEnvState",
    "VectorStep",
    "Wrapper",
    "Wrapping",
    "as_brax",
    "check_env",
    "make_env",
    "register_env",
    "wrapped",
]


def make_env(
    name: str | Any,
    engine: str = "auto",
    brax_backend: str = "spring",
    mjx_preset: str = "parity",
    mjx_impl: str = "jax",
    max_episode_steps: int | None = None,
) -> Env:
    """Makes an environment by name, or of an object.

    Args:
      name: a MuJoCo task (``"HalfCheetah"``, …), ``"brax:NAME"`` for any environment of
        ``brax.envs`` (``"brax:ant"``), ``"playground:NAME"`` for a task of MuJoCo Playground
        (``"playground:CheetahRun"``) or ``"gym:ID"`` for one of Gymnasium's registry
        (``"gym:Pendulum-v1"``); for one of your own ``"module:attribute"``, a name given to
        :func:`register_env`, or the object itself (see there).
      engine: physics engine of MuJoCo tasks, yours too: ``"native"`` (C MuJoCo on the host),
        ``"mjx"`` (MuJoCo in JAX, on the device) or ``"auto"`` (native on CPU, mjx on accelerators).
      brax_backend: ``"spring"``, ``"positional"``, ``"generalized"`` or ``"mjx"``.
      mjx_preset: solver of engine mjx: ``"parity"`` (as in the models) or ``"fast"``.
      mjx_impl: ``"jax"``, or ``"warp"`` on NVIDIA.
      max_episode_steps: of ``gym:ID``, the longest episode that is wanted; default: its own time
        limit.

    Raises:
      ConfigError: an unknown name (the message lists what exists), engine or backend, or one that
        such an environment does not have; or one of your own that breaks the contract of
        :func:`check_env`.
    """
    choice = EngineChoice(engine, mjx_preset, mjx_impl)
    _check_mjx(name, choice)
    if not isinstance(name, str):
        return as_env(name, choice)
    _check_choices(name, engine, brax_backend)
    if env_names.is_own(name):
        return own_env(name, choice)
    if name.startswith(BRAX_PREFIX):
        from sacformer_jax.envs.brax_env import BraxEnv

        return BraxEnv(name.removeprefix(BRAX_PREFIX), brax_backend)
    if name.startswith(PLAYGROUND_PREFIX):
        from sacformer_jax.envs.playground_env import PlaygroundEnv

        return PlaygroundEnv(name.removeprefix(PLAYGROUND_PREFIX), mjx_impl)
    if name.startswith(GYM_PREFIX):
        from sacformer_jax.envs.gym_env import GymEnv

        return GymEnv(name.removeprefix(GYM_PREFIX), max_episode_steps)
    if name not in TASKS:
        from sacformer_jax.envs.brax_env import brax_names

        known = [*TASKS, *(BRAX_PREFIX + brax_name for brax_name in brax_names())]
        known += env_names.registered()
        raise ConfigError(
            f"env={name!r}: no such environment; there are {', '.join(known)}, "
            f"{PLAYGROUND_PREFIX}NAME and {GYM_PREFIX}ID; and for one of your own "
            "MODULE:ATTRIBUTE (register_env makes a name known in its own process alone)"
        )
    return MujocoEnv(name, choice)


def _check_choices(name: str, engine: str, brax_backend: str) -> None:
    """Refuses physics for environments that have their own."""
    own_physics = {
        BRAX_PREFIX: ("auto",),
        GYM_PREFIX: ("auto",),
        PLAYGROUND_PREFIX: ("auto", "mjx"),
    }
    for prefix, engines in own_physics.items():
        if name.startswith(prefix) and engine not in engines:
            hint = "; its physics is chosen by brax_backend" if prefix == BRAX_PREFIX else ""
            raise ConfigError(f"engine={engine!r}: env={name!r} has its own; use auto{hint}")
    default = TaskConfig.brax_backend
    if brax_backend != default and not name.startswith(BRAX_PREFIX):
        raise ConfigError(
            f"brax_backend={brax_backend!r}: is for env=brax:NAME, not {name!r}; use {default}"
        )


def _check_mjx(name: str | Any, choice: EngineChoice) -> None:
    """Refuses what says how MJX is to work where it does not; auto may find it."""
    prefixes = (BRAX_PREFIX, GYM_PREFIX)
    elsewhere = isinstance(name, str) and name.startswith(prefixes)
    if not elsewhere and choice.engine != "native":
        return
    for field in ("mjx_preset", "mjx_impl"):
        value, default = getattr(choice, field), getattr(EngineChoice, field)
        if value != default:
            raise ConfigError(
                f"{field}={value!r}: is for engine=mjx, not "
                f"{f'env={name!r}' if elsewhere else 'engine=native'}; use {default}"
            )


def as_brax(env: Env) -> BraxView:
    """An environment of ours as a ``brax.envs.Env``, for ``brax.training`` and its peers."""
    from sacformer_jax.envs.brax_view import as_brax

    return as_brax(env)


def _gym_layers(env_id: str) -> tuple[Layer, ...]:
    from sacformer_jax.envs.gym_registry import task_layers

    return task_layers(env_id)


def _playground_layers(name: str) -> tuple[Layer, ...]:
    from sacformer_jax.envs.playground_env import task_layers

    return task_layers(name)


def _brax_layers(name: str) -> tuple[Layer, ...]:
    return (UNKNOWN_TARGET,)


TASK_LAYERS[BRAX_PREFIX] = _brax_layers
TASK_LAYERS[GYM_PREFIX] = _gym_layers
TASK_LAYERS[PLAYGROUND_PREFIX] = _playground_layers

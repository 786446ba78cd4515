"""A user's own environments: which objects can be one, and how they come under our contract."""

from __future__ import annotations

from typing import Any

from sacformer_jax import env_names
from sacformer_jax.config import ConfigError
from sacformer_jax.envs.checking import check_env
from sacformer_jax.envs.core import Env, EnvSpec
from sacformer_jax.envs.physics import EngineChoice
from sacformer_jax.envs.tasks import TASKS, Task


def register_env(name: str, env: Any, replace: bool = False) -> None:
    """Makes an environment of your own known by name in this process: ``Config(env=name)``.

    A run whose environment is registered is resumed only where the same is registered again;
    ``env="module:attribute"`` needs no registration, and is found in any process.

    Args:
      name: the new name, without a colon.
      env: a :class:`Task`, an environment of our contract, a ``brax.envs.Env``, an ``MjxEnv`` of
        MuJoCo Playground, or a class or function that makes one and needs no arguments; it is
        called when the name is first used.
      replace: whether it may take the place of one registered before.

    Raises:
      ConfigError: the name is taken or cannot be one.
    """
    if name in TASKS:
        raise ConfigError(f"register_env: name={name!r}: is one of the tasks here; choose another")
    env_names.register(name, env, replace)


def own_env(name: str, choice: EngineChoice) -> Env:
    """The own environment of that name, checked.

    Raises:
      ConfigError: it cannot be found, is nothing that can be an environment, or breaks the
        contract; the message says where.
    """
    return as_env(env_names.find(name), choice, name)


def as_env(found: Any, choice: EngineChoice, name: str | None = None) -> Env:
    """An object as an environment of our contract, its shapes checked.

    Args:
      found: what :func:`register_env` takes.
      choice: the engine, where it is a :class:`Task`.
      name: what it is called in messages; default: by its kind.

    Raises:
      ConfigError: see :func:`own_env`.
    """
    name = type(found).__name__ if name is None else name
    if env_names.is_factory(found):
        found = env_names.called(name, found)
    env = _adapted(found, choice, name)
    if env is None:
        raise ConfigError(f"env={name!r}: {_refusal(found)}")
    check_env(env, num_steps=0, name=name)
    return env


def _adapted(found: Any, choice: EngineChoice, name: str) -> Env | None:
    """The object under our contract; None if its kind is none of those known."""
    if isinstance(found, Task):
        from sacformer_jax.envs.mujoco_env import MujocoEnv

        return MujocoEnv(found, choice)
    if isinstance(getattr(found, "spec", None), EnvSpec):
        return found
    from sacformer_jax.envs import brax_env, playground_env

    if playground_env.is_playground(found):
        return playground_env.PlaygroundEnv(found, name=name)
    if isinstance(found, brax_env.brax_envs.Env):
        return brax_env.BraxEnv(found, name=name)
    return None


def _refusal(found: Any) -> str:
    known = (
        "must be a Task, an environment of sacformer_jax (reset, step and an EnvSpec as spec), a "
        "brax.envs.Env, an MjxEnv of MuJoCo Playground, or a class or function that makes one"
    )
    kind = f"is of type {type(found).__module__}.{type(found).__qualname__}; {known}"
    if hasattr(found, "action_space"):
        return f"{kind}. Register a Gymnasium environment with Gymnasium, and name it gym:ID"
    return kind

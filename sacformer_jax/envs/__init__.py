"""Environments by name."""

from __future__ import annotations

from sacformer_jax.config import ConfigError
from sacformer_jax.envs.core import Env, EnvSpec, EnvStep, VectorEnv, VectorEnvState, VectorStep
from sacformer_jax.envs.physics import ENGINES, EngineChoice
from sacformer_jax.envs.tasks import TASKS

BRAX_PREFIX = "brax:"

__all__ = [
    "ENGINES",
    "TASKS",
    "EngineChoice",
    "Env",
    "EnvSpec",
    "EnvStep",
    "VectorEnv",
    "VectorEnvState",
    "VectorStep",
    "make_env",
]


def make_env(
    name: str,
    engine: str = "auto",
    brax_backend: str = "spring",
    mjx_preset: str = "parity",
    mjx_impl: str = "jax",
) -> Env:
    """Makes an environment by name.

    Args:
      name: a MuJoCo task (``"HalfCheetah"``, …) or ``"brax:NAME"`` for any environment of
        ``brax.envs`` (``"brax:ant"``).
      engine: physics engine of the MuJoCo tasks: ``"native"`` (C MuJoCo on the host), ``"mjx"``
        (MuJoCo in JAX, on the device) or ``"auto"`` (native on CPU, mjx on accelerators).
      brax_backend: ``"spring"``, ``"positional"``, ``"generalized"`` or ``"mjx"``.
      mjx_preset: solver of engine mjx: ``"parity"`` (as in the models) or ``"fast"``.
      mjx_impl: ``"jax"``, or ``"warp"`` on NVIDIA.

    Raises:
      ConfigError: an unknown name (the message lists what exists), engine or backend.
    """
    if name.startswith(BRAX_PREFIX):
        from sacformer_jax.envs.brax_env import BraxEnv

        return BraxEnv(name.removeprefix(BRAX_PREFIX), brax_backend)
    if name not in TASKS:
        from sacformer_jax.envs.brax_env import brax_names

        known = [*TASKS, *(BRAX_PREFIX + brax_name for brax_name in brax_names())]
        raise ConfigError(f"env={name!r}: no such environment; there are {', '.join(known)}")
    from sacformer_jax.envs.mujoco_env import MujocoEnv

    return MujocoEnv(name, EngineChoice(engine, mjx_preset, mjx_impl))

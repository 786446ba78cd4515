"""Physics engines: one signature, several implementations.

An engine advances the physics of *one* environment and is vectorized with ``jax.vmap``. It works
on an opaque state PyTree and reports :class:`~sacformer_jax.envs.tasks.Quantities`; the task turns
those into observations and rewards.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any, Protocol

import flax.struct
import jax

from sacformer_jax.config import ConfigError
from sacformer_jax.envs.tasks import Quantities, Task

ENGINES = ("auto", "native")


@flax.struct.dataclass
class ResetNoise:
    """Noise added to the model's initial position and velocity: ``qpos [nq]``, ``qvel [nv]``."""

    qpos: jax.Array
    qvel: jax.Array


@flax.struct.dataclass
class PhysicsOutput:
    """State and quantities of one environment after a reset or a step.

    Attributes:
      state: the engine's own state PyTree; the same structure from ``reset`` and ``step``.
      quantities: what the task reads.
      bad: bool, whether the simulation became unstable (values are then meaningless).
    """

    state: Any
    quantities: Quantities
    bad: jax.Array


class Engine(Protocol):
    """What every physics engine provides (shapes of one environment; vmap for more)."""

    nq: int
    nv: int
    dt: float
    """Seconds of one environment step: time step times frame skip."""
    action_low: jax.Array
    action_high: jax.Array

    def reset(self, noise: ResetNoise) -> PhysicsOutput:
        """The initial state with ``noise`` added."""
        ...

    def step(self, state: Any, ctrl: jax.Array) -> PhysicsOutput:
        """Advances by ``frame_skip`` physics steps under ``ctrl [A]``."""
        ...

    def step_and_reset(
        self, state: Any, ctrl: jax.Array, reset: jax.Array, noise: ResetNoise
    ) -> tuple[PhysicsOutput, PhysicsOutput]:
        """Both at once; where ``reset`` (bool) is false the second output holds zeros."""
        ...


def model_path(task: Task) -> Path:
    """The task's MJCF file inside the installed ``gymnasium`` package (not imported)."""
    spec = importlib.util.find_spec("gymnasium")
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError("gymnasium is not installed; the model files come from it")
    path = Path(spec.origin).parent / "envs" / "mujoco" / "assets" / task.xml_file
    if not path.is_file():
        raise FileNotFoundError(
            f"model of task {task.name!r}: {path} does not exist; install gymnasium >= 1.1"
        )
    return path


def resolve_engine(engine: str) -> tuple[str, str]:
    """The engine that ``engine`` stands for, and why: ``("native", "CPU backend")``.

    Raises:
      ConfigError: ``engine`` is not one of :data:`ENGINES`.
    """
    if engine not in ENGINES:
        raise ConfigError(f"engine={engine!r}: must be one of {', '.join(ENGINES)}")
    if engine == "auto":
        return "native", f"auto: C MuJoCo on the host, JAX backend is {jax.default_backend()}"
    return engine, "as asked for"


def make_engine(task: Task, engine: str = "auto") -> Engine:
    """Builds the engine for ``task``."""
    from sacformer_jax.envs.native import NativeEngine

    resolve_engine(engine)
    return NativeEngine(task)

"""Physics engines: one signature, several implementations.

An engine advances the physics of *one* environment and is vectorized with ``jax.vmap``. It works
on an opaque state PyTree and reports :class:`~sacformer_jax.envs.tasks.Quantities`; the task turns
those into observations and rewards.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
from pathlib import Path
from typing import Any, Protocol, get_args

import flax.struct
import jax

from sacformer_jax.config import ConfigError, EngineName, MjxImpl, MjxPreset
from sacformer_jax.cores import usable_cores
from sacformer_jax.envs.tasks import Quantities, Task

ENGINES = get_args(EngineName)
MJX_PRESETS = get_args(MjxPreset)
MJX_IMPLS = get_args(MjxImpl)


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
    """What every physics engine provides; ``reset`` and ``step`` are of one environment."""

    nq: int
    nv: int
    init_qpos: jax.Array
    """The model's initial position, ``[nq]`` float32; it starts at rest."""
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
        self, states: Any, ctrls: jax.Array, reset: jax.Array, noise: ResetNoise
    ) -> tuple[PhysicsOutput, PhysicsOutput]:
        """Both at once for N environments; where ``reset [N]`` is false the second holds zeros."""
        ...


def is_mjcf(task: Task) -> bool:
    """Whether the task holds its model itself, instead of naming a file."""
    return isinstance(task.xml_file, str) and task.xml_file.lstrip().startswith("<")


def model_path(task: Task) -> Path:
    """The task's MJCF file: its own, or one inside the installed ``gymnasium`` (not imported).

    Raises:
      ConfigError: there is none.
    """
    if isinstance(task.xml_file, Path):
        own = task.xml_file.expanduser().absolute()
        if not own.is_file():
            raise ConfigError(f"task {task.name!r}: there is no file {str(own)!r} (xml_file)")
        return own
    spec = importlib.util.find_spec("gymnasium")
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError("gymnasium is not installed; the model files come from it")
    path = Path(spec.origin).parent / "envs" / "mujoco" / "assets" / task.xml_file
    if not path.is_file():
        raise ConfigError(
            f"task {task.name!r}: xml_file={task.xml_file!r} is not among the assets of the "
            f"installed gymnasium ({path.parent}); a file of your own is given as a Path: "
            f"xml_file=Path({task.xml_file!r})"
        )
    return path


@dataclasses.dataclass(frozen=True)
class EngineChoice:
    """Which engine runs a task, and how.

    Attributes:
      engine: one of :data:`ENGINES`.
      mjx_preset: solver settings of ``mjx``: one of :data:`MJX_PRESETS`.
      mjx_impl: implementation of ``mjx``: one of :data:`MJX_IMPLS`.

    Raises:
      ConfigError: a value is not among those.
    """

    engine: str = "auto"
    mjx_preset: str = "parity"
    mjx_impl: str = "jax"

    def __post_init__(self) -> None:
        for name, choices in (
            ("engine", ENGINES),
            ("mjx_preset", MJX_PRESETS),
            ("mjx_impl", MJX_IMPLS),
        ):
            value = getattr(self, name)
            if value not in choices:
                raise ConfigError(f"{name}={value!r}: must be one of {', '.join(choices)}")

    def resolved(self) -> tuple[EngineChoice, str]:
        """Itself with ``auto`` decided by the device, and why."""
        chosen, reason = self, "as asked for"
        if self.engine == "auto":
            backend = jax.default_backend()
            engine, where = ("native", "C MuJoCo on the host") if backend == "cpu" else (
                "mjx", "MuJoCo on the device"
            )  # fmt: skip
            chosen = dataclasses.replace(self, engine=engine)
            reason = f"auto: {where}, JAX backend is {backend}"
        if chosen.engine == "mjx":
            reason += f"; preset {chosen.mjx_preset}, impl {chosen.mjx_impl}"
        return chosen, reason


def make_engine(task: Task, choice: EngineChoice) -> Engine:
    """Builds the engine for ``task``; ``choice`` must be resolved.

    Raises:
      ConfigError: this machine or this task cannot have it.
    """
    if choice.engine == "mjx":
        from sacformer_jax.envs.mjx_engine import MjxEngine

        return MjxEngine(task, choice.mjx_preset, choice.mjx_impl)
    return _native_engine(task, usable_cores())


@functools.cache
def _native_engine(task: Task, num_threads: int) -> Engine:
    """The process's engine of a task: pure, so one is enough for all programs.

    What is compiled for one program is then found in the compilation cache by the next one that
    is the same, since both call the same host functions.
    """
    from sacformer_jax.envs.native import NativeEngine

    return NativeEngine(task, num_threads)

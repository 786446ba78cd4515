"""The native engine: C MuJoCo, all environments in one threaded batch, called from inside jit.

It is *pure*: state in, state out. A state is MuJoCo's float64 state
(``mjSTATE_FULLPHYSICS | mjSTATE_WARMSTART``) followed by the measured xy position (float64),
travelling through JAX as 32-bit words, so that a trajectory equals Gymnasium's to the last bit
while JAX stays in float32. The measured position is carried because ``xpos`` and ``xipos`` lag
``qpos`` by one substep after ``mj_step`` and are not part of MuJoCo's state.

``jax.vmap`` turns any number of environments (and seeds) into one host call
(``vmap_method="broadcast_all"``) with one operand, since each costs time. What happens in it:
:mod:`sacformer_jax.envs.native_host`.
"""

from __future__ import annotations

import collections
import contextlib
import itertools
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from sacformer_jax.cores import usable_cores
from sacformer_jax.envs.host_call import HostCall
from sacformer_jax.envs.native_host import STATE_SPEC, Job, Layout, Outputs, Threads, Worker
from sacformer_jax.envs.physics import PhysicsOutput, ResetNoise, model_path
from sacformer_jax.envs.tasks import Quantities, Task


@contextlib.contextmanager
def loading_quietly() -> Iterator[None]:
    """Around the loading of Gymnasium's models: drops the warnings about their old attributes.

    MuJoCo's own handler would print them and write MUJOCO_LOG.TXT into the working directory.
    """
    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(handler)


def load_model(task: Task) -> mujoco.MjModel:
    with loading_quietly():
        return mujoco.MjModel.from_xml_path(str(model_path(task)))


def _as_words(values: jax.Array) -> jax.Array:
    """One part of the host call's operand: a vector or scalar as 32-bit words."""
    if values.dtype == bool:
        values = values.astype(jnp.uint32)
    elif values.dtype != jnp.uint32:
        values = jax.lax.bitcast_convert_type(values.astype(jnp.float32), jnp.uint32)
    return values.reshape(-1)


_NUMBERS: dict[str, Iterator[int]] = collections.defaultdict(itertools.count)
"""Engines are numbered by task: in programs that make them in the same order, alike."""


class NativeEngine:
    """C MuJoCo behind the engine signature of :mod:`sacformer_jax.envs.physics`.

    Args:
      task: the task, whose model file is loaded from the installed ``gymnasium`` package.
      num_threads: host threads; default: the cores this process may use.
    """

    def __init__(self, task: Task, num_threads: int | None = None):
        self.model = load_model(task)
        self.nq, self.nv = int(self.model.nq), int(self.model.nv)
        self.dt = float(self.model.opt.timestep * task.frame_skip)
        low, high = self.model.actuator_ctrlrange.astype(np.float32).T
        self.action_low, self.action_high = jnp.asarray(low), jnp.asarray(high)
        self.task = task
        self.num_threads = num_threads or usable_cores()
        self.threads = Threads(self.model, task, self.num_threads)
        self._layout = Layout.of(self.model, task)
        self._num_physics = mujoco.mj_stateSize(self.model, STATE_SPEC)
        self._num_words = 2 * (self._num_physics + 2)
        runge_kutta = self.model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
        number = next(_NUMBERS[task.name])
        self._host_calls = {
            name: HostCall(f"sacformer_jax.native.{task.name}.{number}.{name}", function)
            for name, function in {
                "reset": self._host_reset,
                "step": self._host_step,
                "step_and_reset": self._host_step_and_reset,
            }.items()
        }
        self._step_work = task.frame_skip * (4 if runge_kutta else 1) * self.nv

    @property
    def host_calls(self) -> int:
        """Number of host calls so far (for tests and benchmarks)."""
        return self.threads.calls

    # --- pure functions of one environment ---------------------------------------------------

    def reset(self, noise: ResetNoise) -> PhysicsOutput:
        return self._unpack(*self._call("reset", 1, noise.qpos, noise.qvel))

    def step(self, state: jax.Array, ctrl: jax.Array) -> PhysicsOutput:
        return self._unpack(*self._call("step", 1, state, ctrl))

    def step_and_reset(
        self, states: jax.Array, ctrls: jax.Array, reset: jax.Array, noise: ResetNoise
    ) -> tuple[PhysicsOutput, PhysicsOutput]:
        return jax.vmap(self._step_and_reset)(states, ctrls, reset, noise)

    def _step_and_reset(
        self, state: jax.Array, ctrl: jax.Array, reset: jax.Array, noise: ResetNoise
    ) -> tuple[PhysicsOutput, PhysicsOutput]:
        words, row, fresh_words, fresh_row = self._call(
            "step_and_reset", 2, state, ctrl, noise.qpos, noise.qvel, reset
        )
        return self._unpack(words, row), self._unpack(fresh_words, fresh_row)

    def pack_state(self, physics: np.ndarray, measured: np.ndarray) -> np.ndarray:
        """Host helper: MuJoCo's state vector and measured xy (float64) as the state's words."""
        return np.concatenate([physics, measured]).astype(np.float64).view(np.uint32)

    def unpack_state(self, words: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Host helper, inverse of :meth:`pack_state`."""
        state = np.ascontiguousarray(np.asarray(words)).view(np.float64)
        return state[..., :-2], state[..., -2:]

    def _call(self, host_call: str, outputs: int, *parts: jax.Array) -> Any:
        result = (
            jax.ShapeDtypeStruct((self._num_words,), jnp.uint32),
            jax.ShapeDtypeStruct((self._layout.size,), jnp.float32),
        )
        operand = jnp.concatenate([_as_words(part) for part in parts])
        return self._host_calls[host_call](result * outputs, operand)

    def _unpack(self, words: jax.Array, row: jax.Array) -> PhysicsOutput:
        values = self._layout.unpack(row)
        quantities = Quantities(
            qpos=values["qpos"],
            qvel=values["qvel"],
            displacement=values["displacement"],
            derived={name: values[name] for name in self.task.derived},
        )
        return PhysicsOutput(state=words, quantities=quantities, bad=values["bad"] > 0.5)

    # --- the host call: NumPy only -----------------------------------------------------------

    def _host_step(self, operand: Any) -> tuple[np.ndarray, ...]:
        operand = np.asarray(operand)
        return self._host(operand, np.zeros(operand.shape[:-1], bool))[:2]

    def _host_reset(self, operand: Any) -> tuple[np.ndarray, ...]:
        operand = np.asarray(operand)
        return self._host(operand, np.ones(operand.shape[:-1], bool), steps=False)[2:]

    def _host_step_and_reset(self, operand: Any) -> tuple[np.ndarray, ...]:
        operand = np.asarray(operand)
        return self._host(operand, operand[..., -1] != 0)

    def _host(
        self, operand: np.ndarray, resets: np.ndarray, steps: bool = True
    ) -> tuple[np.ndarray, ...]:
        """All environments, of any leading shape.

        Args:
          operand: ``[..., words]`` uint32: state and control if ``steps``, then the noise of qpos
            and qvel if there are ``resets``; what follows is not looked at.
          resets: ``[...]`` bool, which environments get a fresh episode.
          steps: whether to step all.

        Returns:
          States ``[..., words of a state]`` uint32 and rows ``[..., layout.size]`` float32 after
          the step, and both of the fresh episodes; zeros where nothing was asked for.
        """
        num, nq, nu, num_physics = resets.size, self.nq, self.model.nu, self._num_physics
        words, chosen = operand.reshape(num, operand.shape[-1]), np.flatnonzero(resets).tolist()
        stepped, fresh = (Outputs(num, num_physics, self._layout) for _ in range(2))
        jobs: list[Job] = []
        if steps:
            state = words[:, : self._num_words].view(np.float64)
            words = words[:, self._num_words :]
            inputs = np.empty((num, num_physics + nu))
            inputs[:, :num_physics] = state[:, :num_physics]
            inputs[:, num_physics:] = words[:, :nu].view(np.float32)
            words = words[:, nu:]
            stepped.prepare(self.task, self.model, self._layout)
            jobs.append(Job(Worker.step, inputs, stepped, range(num), self._step_work))
        if chosen:
            noise = words[:, : nq + self.nv].view(np.float32)
            fresh.prepare(self.task, self.model, self._layout)
            jobs.append(Job(Worker.reset, noise, fresh, chosen, self.nv))
        self.threads.run(jobs)
        if steps:
            stepped.finish(self.model, state[:, num_physics:])
        if chosen:
            fresh.finish(self.model, None)
        return tuple(
            values.reshape(*resets.shape, values.shape[-1])
            for outputs in (stepped, fresh)
            for values in (outputs.states.view(np.uint32), outputs.rows)
        )

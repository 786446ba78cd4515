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
import itertools
import math
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from sacformer_jax.cores import usable_cores
from sacformer_jax.envs.host_call import HostCall
from sacformer_jax.envs.models import load_model
from sacformer_jax.envs.native_host import Job, Layout, Outputs, Threads, Worker
from sacformer_jax.envs.physics import PhysicsOutput, ResetNoise
from sacformer_jax.envs.tasks import Quantities, Task


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
      task: the task.
      num_threads: host threads; default: the cores this process may use.

    Raises:
      ConfigError: the task's model cannot be had, or cannot be run.
    """

    def __init__(self, task: Task, num_threads: int | None = None):
        self.model = load_model(task)
        self.nq, self.nv = int(self.model.nq), int(self.model.nv)
        self.init_qpos = jnp.asarray(self.model.qpos0, jnp.float32)
        self.dt = float(self.model.opt.timestep * task.frame_skip)
        low, high = self.model.actuator_ctrlrange.astype(np.float32).T
        self.action_low, self.action_high = jnp.asarray(low), jnp.asarray(high)
        self.task = task
        self.num_threads = num_threads or usable_cores()
        self.threads = Threads(self.model, task, self.num_threads)
        self._layout = Layout.of(self.model, task)
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
        (fresh,) = self._call("reset", 1, noise.qpos, noise.qvel)
        return fresh

    def step(self, state: jax.Array, ctrl: jax.Array) -> PhysicsOutput:
        (stepped,) = self._call("step", 1, state, ctrl)
        return stepped

    def step_and_reset(
        self, states: jax.Array, ctrls: jax.Array, reset: jax.Array, noise: ResetNoise
    ) -> tuple[PhysicsOutput, PhysicsOutput]:
        return jax.vmap(self._step_and_reset)(states, ctrls, reset, noise)

    def _step_and_reset(
        self, state: jax.Array, ctrl: jax.Array, reset: jax.Array, noise: ResetNoise
    ) -> tuple[PhysicsOutput, PhysicsOutput]:
        stepped, fresh = self._call("step_and_reset", 2, state, ctrl, noise.qpos, noise.qvel, reset)
        return stepped, fresh

    def pack_state(self, physics: np.ndarray, measured: np.ndarray) -> np.ndarray:
        """Host helper: MuJoCo's state vector and measured xy (float64) as the state's words."""
        return np.concatenate([physics, measured]).astype(np.float64).view(np.uint32)

    def unpack_state(self, words: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Host helper, inverse of :meth:`pack_state`."""
        state = np.ascontiguousarray(np.asarray(words)).view(np.float64)
        return state[..., :-2], state[..., -2:]

    def _call(self, host_call: str, outputs: int, *parts: jax.Array) -> list[PhysicsOutput]:
        num_words = 2 * self._layout.columns
        result = jax.ShapeDtypeStruct((outputs * num_words,), jnp.uint32)
        operand = jnp.concatenate([_as_words(part) for part in parts])
        (words,) = self._host_calls[host_call]((result,), operand)
        return [self._unpack(words[i * num_words :]) for i in range(outputs)]

    def _unpack(self, words: jax.Array) -> PhysicsOutput:
        num_state, size = self._layout.num_state_words, self._layout.size
        row = jax.lax.bitcast_convert_type(words[num_state : num_state + size], jnp.float32)
        values = self._layout.unpack(row)
        quantities = Quantities(
            qpos=values["qpos"],
            qvel=values["qvel"],
            displacement=values["displacement"],
            derived={name: values[name] for name in self.task.derived},
        )
        state = words[:num_state]
        return PhysicsOutput(state=state, quantities=quantities, bad=values["bad"] > 0.5)

    # --- the host call: NumPy only -----------------------------------------------------------

    def _host_step(self, operand: Any) -> tuple[np.ndarray]:
        return self._host(np.asarray(operand), steps=True, resets=None)

    def _host_reset(self, operand: Any) -> tuple[np.ndarray]:
        operand = np.asarray(operand)
        return self._host(operand, steps=False, resets=np.ones(operand.shape[:-1], bool))

    def _host_step_and_reset(self, operand: Any) -> tuple[np.ndarray]:
        operand = np.asarray(operand)
        return self._host(operand, steps=True, resets=operand[..., -1] != 0)

    def _host(
        self, operand: np.ndarray, *, steps: bool, resets: np.ndarray | None
    ) -> tuple[np.ndarray]:
        """All environments, of any leading shape.

        Args:
          operand: ``[..., words]`` uint32: state and control if ``steps``, then the noise of qpos
            and qvel if there are ``resets``; what follows is not looked at.
          steps: whether to step all.
          resets: ``[...]`` bool, which environments get a fresh episode.

        Returns:
          ``[..., words]`` uint32, by :class:`Layout`: after the step, then of the fresh episode,
          as far as asked for; zeros where an environment gets none.
        """
        layout, model = self._layout, self.model
        leading = operand.shape[:-1]
        words = operand.reshape(math.prod(leading), operand.shape[-1])
        columns, num_physics = layout.columns, layout.num_physics
        numbers = np.zeros((len(words), columns * (steps + (resets is not None))))
        stepped = fresh = None
        jobs: list[Job] = []
        if steps:
            stepped = Outputs(numbers[:, :columns], layout)
            state = words[:, : layout.num_state_words].view(np.float64)
            words = words[:, layout.num_state_words :]
            inputs = np.empty((len(words), num_physics + model.nu))
            inputs[:, :num_physics] = state[:, :num_physics]
            inputs[:, num_physics:] = words[:, : model.nu].view(np.float32)
            words = words[:, model.nu :]
            stepped.prepare(self.task, model, layout)
            jobs.append(Job(Worker.step, inputs, stepped, range(len(words)), self._step_work))
        if resets is not None and np.count_nonzero(resets):
            fresh = Outputs(numbers[:, -columns:], layout)
            chosen = np.flatnonzero(resets).tolist()
            noise = words[:, : self.nq + self.nv].view(np.float32)
            fresh.prepare(self.task, model, layout)
            jobs.append(Job(Worker.reset, noise, fresh, chosen, self.nv))
        self.threads.run(jobs)
        if stepped:
            stepped.finish(model, state[:, num_physics:])
        if fresh:
            fresh.finish(model, None)
        num_words = 2 * numbers.shape[1]
        return (numbers.view(np.uint32).reshape(*leading, num_words),)

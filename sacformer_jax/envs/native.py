"""The native engine: C MuJoCo, all environments in one threaded batch, called from inside jit.

It is *pure*: state in, state out. A state is MuJoCo's float64 state
(``mjSTATE_FULLPHYSICS | mjSTATE_WARMSTART``) followed by the measured xy position (float64),
travelling through JAX as 32-bit words, so that a trajectory equals Gymnasium's to the last bit
while JAX stays in float32. The measured position is carried because ``xpos`` and ``xipos`` lag
``qpos`` by one substep after ``mj_step`` and are not part of MuJoCo's state.

``jax.vmap`` turns any number of environments (and seeds) into one host call
(``vmap_method="broadcast_all"``), which a pool of threads works off, one ``MjData`` each;
``mj_step`` releases the GIL.
"""

from __future__ import annotations

import contextlib
import dataclasses
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from sacformer_jax.cores import usable_cores
from sacformer_jax.envs.physics import PhysicsOutput, ResetNoise, model_path
from sacformer_jax.envs.tasks import Quantities, Task

STATE_SPEC = mujoco.mjtState.mjSTATE_FULLPHYSICS | mujoco.mjtState.mjSTATE_WARMSTART
# C MuJoCo resets an unstable simulation silently; only these counters tell.
_BAD_WARNINGS = [
    int(getattr(mujoco.mjtWarning, f"mjWARN_{name}"))
    for name in ("BADQPOS", "BADQVEL", "BADQACC", "BADCTRL")
]
# MuJoCo prints a warning, and writes MUJOCO_LOG.TXT into the working directory, only when its
# counter is 0; counting from here keeps it quiet, and nothing is lost.
_WARNED_BEFORE = 1000
_DERIVED_COLUMNS = {"cinert": 10, "cvel": 6, "cfrc_ext": 6}


@dataclasses.dataclass(frozen=True)
class _Layout:
    """Where each quantity lies in the packed float32 output row of one environment."""

    shapes: dict[str, tuple[int, ...]]

    @property
    def size(self) -> int:
        return sum(int(np.prod(shape)) for shape in self.shapes.values())

    def slices(self) -> dict[str, slice]:
        slices, start = {}, 0
        for name, shape in self.shapes.items():
            size = int(np.prod(shape))
            slices[name] = slice(start, start + size)
            start += size
        return slices

    def unpack(self, row: jax.Array) -> dict[str, jax.Array]:
        return {
            name: row[where].reshape(self.shapes[name]) for name, where in self.slices().items()
        }


class _Worker:
    """One thread's ``MjData`` and the loop over its share of the batch."""

    def __init__(self, model: mujoco.MjModel, task: Task, slices: dict[str, slice]):
        self.model = model
        self.data = mujoco.MjData(model)
        self.frame_skip = task.frame_skip
        self.warnings = self.data.warning.number  # a live view
        self.body_mass = model.body_mass.copy()
        self.measure = {
            "root": self._measure_root,
            "torso": self._measure_torso,
            "mass_center": self._measure_mass_center,
        }[task.measure]
        # Live views into MjData, written to these places of the output row.
        self.outputs = [
            (getattr(self.data, name), where)
            for name, where in slices.items()
            if name not in ("displacement", "bad")
        ]
        self.displacement = slices["displacement"]
        self.bad = slices["bad"].start
        self.num_physics = mujoco.mj_stateSize(model, STATE_SPEC)
        self.init_qpos = self.data.qpos.copy()

    def _measure_root(self) -> np.ndarray:
        return np.array([self.data.qpos[0], 0.0])

    def _measure_torso(self) -> np.ndarray:
        return self.data.xpos[1, :2].copy()

    def _measure_mass_center(self) -> np.ndarray:
        numerator = np.einsum("b,bj->j", self.body_mass, self.data.xipos)
        return (numerator / self.body_mass.sum())[:2]

    def _write(self, state_out: np.ndarray, row: np.ndarray) -> None:
        mujoco.mj_getState(self.model, self.data, state_out[: self.num_physics], STATE_SPEC)
        for view, where in self.outputs:
            row[where] = view.reshape(-1)

    def step(self, state: np.ndarray, ctrl: np.ndarray, out: np.ndarray, row: np.ndarray) -> None:
        """Advances ``state`` (float64) into ``out`` and fills ``row`` (float32)."""
        model, data = self.model, self.data
        mujoco.mj_setState(model, data, state[: self.num_physics], STATE_SPEC)
        data.ctrl[:] = ctrl
        self.warnings[:] = _WARNED_BEFORE
        mujoco.mj_step(model, data, nstep=self.frame_skip)
        mujoco.mj_rnePostConstraint(model, data)
        self._write(out, row)
        measured = self.measure()
        row[self.displacement] = measured - state[self.num_physics :]
        row[self.bad] = (self.warnings[_BAD_WARNINGS] != _WARNED_BEFORE).any()
        out[self.num_physics :] = measured

    def reset(
        self, qpos_noise: np.ndarray, qvel_noise: np.ndarray, out: np.ndarray, row: np.ndarray
    ) -> None:
        """Writes a fresh episode's state into ``out`` and its quantities into ``row``."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self.init_qpos + qpos_noise
        self.data.qvel[:] = qvel_noise
        mujoco.mj_forward(self.model, self.data)
        self._write(out, row)
        row[self.displacement] = 0.0
        row[self.bad] = 0.0
        out[self.num_physics :] = self.measure()


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
        shapes: dict[str, tuple[int, ...]] = {"qpos": (self.nq,), "qvel": (self.nv,)}
        for name in task.derived:
            columns = _DERIVED_COLUMNS.get(name)
            shapes[name] = (self.model.nbody, columns) if columns else (self.nv,)
        self._derived = task.derived
        self._layout = _Layout({**shapes, "displacement": (2,), "bad": ()})
        self._num_state = mujoco.mj_stateSize(self.model, STATE_SPEC) + 2
        self.num_threads = num_threads or usable_cores()
        slices = self._layout.slices()
        self._workers = [_Worker(self.model, task, slices) for _ in range(self.num_threads)]
        self._pool = ThreadPoolExecutor(self.num_threads, thread_name_prefix="mujoco")
        self._lock = threading.Lock()  # two programs at once must not share an MjData
        self.host_calls = 0
        """Number of host calls so far (for tests and benchmarks)."""

    # --- pure functions of one environment ---------------------------------------------------

    def reset(self, noise: ResetNoise) -> PhysicsOutput:
        return self._unpack(*self._call(self._host_reset, 1, noise.qpos, noise.qvel))

    def step(self, state: jax.Array, ctrl: jax.Array) -> PhysicsOutput:
        return self._unpack(*self._call(self._host_step, 1, state, ctrl))

    def step_and_reset(
        self, states: jax.Array, ctrls: jax.Array, reset: jax.Array, noise: ResetNoise
    ) -> tuple[PhysicsOutput, PhysicsOutput]:
        return jax.vmap(self._step_and_reset)(states, ctrls, reset, noise)

    def _step_and_reset(
        self, state: jax.Array, ctrl: jax.Array, reset: jax.Array, noise: ResetNoise
    ) -> tuple[PhysicsOutput, PhysicsOutput]:
        words, row, fresh_words, fresh_row = self._call(
            self._host_step_and_reset, 2, state, ctrl, reset, noise.qpos, noise.qvel
        )
        return self._unpack(words, row), self._unpack(fresh_words, fresh_row)

    def pack_state(self, physics: np.ndarray, measured: np.ndarray) -> np.ndarray:
        """Host helper: MuJoCo's state vector and measured xy (float64) as the state's words."""
        return np.concatenate([physics, measured]).astype(np.float64).view(np.uint32)

    def unpack_state(self, words: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Host helper, inverse of :meth:`pack_state`."""
        state = np.ascontiguousarray(np.asarray(words)).view(np.float64)
        return state[..., :-2], state[..., -2:]

    def _call(self, host_function: Any, outputs: int, *args: jax.Array) -> Any:
        result = (
            jax.ShapeDtypeStruct((2 * self._num_state,), jnp.uint32),
            jax.ShapeDtypeStruct((self._layout.size,), jnp.float32),
        )
        return jax.pure_callback(
            host_function, result * outputs, *args, vmap_method="broadcast_all"
        )

    def _unpack(self, words: jax.Array, row: jax.Array) -> PhysicsOutput:
        values = self._layout.unpack(row)
        quantities = Quantities(
            qpos=values["qpos"],
            qvel=values["qvel"],
            displacement=values["displacement"],
            derived={name: values[name] for name in self._derived},
        )
        return PhysicsOutput(state=words, quantities=quantities, bad=values["bad"] > 0.5)

    # --- the host side: NumPy only -----------------------------------------------------------

    def _host_step(self, words: Any, ctrl: Any) -> tuple[np.ndarray, ...]:
        never = np.zeros(np.shape(words)[:-1], bool)
        return self._host_step_and_reset(words, ctrl, never, None, None)[:2]

    def _host_reset(self, qpos_noise: Any, qvel_noise: Any) -> tuple[np.ndarray, ...]:
        always = np.ones(np.shape(qpos_noise)[:-1], bool)
        return self._host_step_and_reset(None, None, always, qpos_noise, qvel_noise)[2:]

    def _host_step_and_reset(
        self, words: Any, ctrl: Any, reset: Any, qpos_noise: Any, qvel_noise: Any
    ) -> tuple[np.ndarray, ...]:
        """All environments, any leading shape; ``words is None`` steps none."""
        reset_mask = np.asarray(reset)
        batch_shape, resets = reset_mask.shape, reset_mask.reshape(-1)
        num = resets.size
        state = ctrls = qpos = qvel = None
        if words is not None:
            state = np.ascontiguousarray(np.asarray(words)).reshape(num, -1).view(np.float64)
            ctrls = np.asarray(ctrl).reshape(num, -1)
        if qpos_noise is not None:
            qpos = np.asarray(qpos_noise).reshape(num, -1)
            qvel = np.asarray(qvel_noise).reshape(num, -1)
        out, fresh = np.zeros((2, num, self._num_state))
        row, fresh_row = np.zeros((2, num, self._layout.size), np.float32)

        def work(worker: _Worker, start: int, stop: int) -> None:
            for i in range(start, stop):
                if state is not None and ctrls is not None:
                    worker.step(state[i], ctrls[i], out[i], row[i])
                if resets[i] and qpos is not None and qvel is not None:
                    worker.reset(qpos[i], qvel[i], fresh[i], fresh_row[i])

        self._run(work, num)

        def words_of(states: np.ndarray) -> np.ndarray:
            return states.view(np.uint32).reshape(*batch_shape, 2 * self._num_state)

        rows = [r.reshape(*batch_shape, self._layout.size) for r in (row, fresh_row)]
        return words_of(out), rows[0], words_of(fresh), rows[1]

    def _run(self, work: Any, num: int) -> None:
        """Splits ``num`` environments over the threads; a single one stays on this thread."""
        shares = min(self.num_threads, num)
        bounds = np.linspace(0, num, shares + 1).astype(int)
        with self._lock:
            pending = [
                self._pool.submit(work, self._workers[k], bounds[k], bounds[k + 1])
                for k in range(1, shares)
            ]
            self.host_calls += 1
            try:
                work(self._workers[0], bounds[0], bounds[1])
            finally:  # whatever happened here, their MjData are theirs until they are done
                wait(pending)
            for future in pending:
                future.result()

"""The host's side of the native engine: batches of environments on threads, without jax.

Threads, the calling one among them, take chunks of the batch until none is left, one ``MjData``
each; ``mj_step`` releases the GIL. Whatever else they do for an environment holds the others up,
so that is little: state in, step, state out. The rest is done for the whole batch at once.

jax is not to be used here: a callback that waits for XLA's own threads hangs now and then.
"""

from __future__ import annotations

import dataclasses
import functools
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any, NamedTuple

import mujoco
import numpy as np

from sacformer_jax.envs.tasks import Task

STATE_SPEC = int(mujoco.mjtState.mjSTATE_FULLPHYSICS | mujoco.mjtState.mjSTATE_WARMSTART)
# The control comes last in it (plugins have no state in these models).
_STATE_AND_CTRL_SPEC = STATE_SPEC | int(mujoco.mjtState.mjSTATE_CTRL)
# C MuJoCo resets an unstable simulation silently; only these counters tell.
_BAD_WARNINGS = [
    int(getattr(mujoco.mjtWarning, f"mjWARN_{name}"))
    for name in ("BADQPOS", "BADQVEL", "BADQACC", "BADCTRL")
]
# MuJoCo prints a warning, and writes MUJOCO_LOG.TXT into the working directory, only when its
# counter is 0; counting from here keeps it quiet, and nothing is lost.
_WARNED_BEFORE = 1000
# Work of a whole batch, in the unit of Job, above which it is shared between threads: below it,
# waking them takes longer than it saves. A unit takes 0.3 to 0.5 µs; measured with two threads,
# sharing gains nothing at 360 (8 HalfCheetahs) and 14% at 576 (4 Walker2ds).
_WORTH_SHARING = 400


@dataclasses.dataclass(frozen=True)
class Layout:
    """Where what the host reports of one environment lies.

    First MuJoCo's state and the measured position in float64, then the float32 row of quantities.

    Attributes:
      shapes: of the quantities, by name.
      num_physics: numbers in MuJoCo's state.
    """

    shapes: dict[str, tuple[int, ...]]
    num_physics: int

    @classmethod
    def of(cls, model: mujoco.MjModel, task: Task) -> Layout:
        shapes: dict[str, tuple[int, ...]] = {"qpos": (model.nq,), "qvel": (model.nv,)}
        data = mujoco.MjData(model)
        shapes.update({name: getattr(data, name).shape for name in task.derived})
        return cls(
            {**shapes, "displacement": (2,), "bad": ()}, mujoco.mj_stateSize(model, STATE_SPEC)
        )

    @functools.cached_property
    def num_state_words(self) -> int:
        """32-bit words of the state and the measured position."""
        return 2 * (self.num_physics + 2)

    @functools.cached_property
    def columns(self) -> int:
        """Float64 numbers that all of it takes, half a one perhaps unused."""
        return self.num_physics + 2 + (self.size + 1) // 2

    @functools.cached_property
    def size(self) -> int:
        """Numbers in the row."""
        return sum(int(np.prod(shape)) for shape in self.shapes.values())

    @functools.cached_property
    def slices(self) -> dict[str, slice]:
        slices, start = {}, 0
        for name, shape in self.shapes.items():
            size = int(np.prod(shape))
            slices[name] = slice(start, start + size)
            start += size
        return slices

    def unpack(self, row: Any) -> dict[str, Any]:
        """The quantities by name, of a NumPy or a traced row."""
        return {name: row[where].reshape(self.shapes[name]) for name, where in self.slices.items()}


class Outputs:
    """What one host call reports of its environments after a step, or after a reset.

    Args:
      numbers: ``[num, layout.columns]`` float64, at first zeros; the rest are views into it.
      layout: where what lies.

    Attributes:
      physics: ``[num, num_physics]`` float64, MuJoCo's state.
      measured: ``[num, 2]`` float64, the measured position.
      rows: ``[num, layout.size]`` float32.
      copied: where a worker puts what it reads from ``MjData``, by MuJoCo's name, or by that of
        what the task measures.
    """

    def __init__(self, numbers: np.ndarray, layout: Layout):
        num_state = layout.num_physics + 2
        self.physics = numbers[:, : layout.num_physics]
        self.measured = numbers[:, layout.num_physics : num_state]
        self.rows = numbers[:, num_state:].view(np.float32)[:, : layout.size]
        self.copied: dict[str, np.ndarray] = {}

    def prepare(self, task: Task, model: mujoco.MjModel, layout: Layout) -> None:
        """Makes room for what the workers copy."""
        num = len(self.rows)
        for name in task.derived:
            self.copied[name] = self.rows[:, layout.slices[name]].reshape(num, *layout.shapes[name])
        if task.measure == "torso":
            self.copied["torso"] = self.measured
        elif task.measure == "mass_center":
            self.copied["mass_center"] = np.zeros((num, model.nbody, 2))

    def finish(self, model: mujoco.MjModel, measured_before: np.ndarray | None) -> None:
        """Fills in what the workers left to do for all at once."""
        num_positions = model.nq + model.nv
        self.rows[:, :num_positions] = self.physics[:, 1 : 1 + num_positions]  # after the time
        if "mass_center" in self.copied:
            moments = model.body_mass[:, None] * self.copied["mass_center"]
            self.measured[:] = moments.sum(axis=1) / model.body_mass.sum()
        elif "torso" not in self.copied:
            self.measured[:, 0] = self.physics[:, 1]
        if measured_before is not None:
            self.rows[:, -3:-1] = self.measured - measured_before


class Worker:
    """One thread's ``MjData`` and the loops over its chunks of the batch.

    Attributes:
      lock: to be held while working, so that no two threads share the ``MjData``.
    """

    def __init__(self, model: mujoco.MjModel, task: Task):
        self.model = model
        self.data = mujoco.MjData(model)
        self.lock = threading.Lock()
        self.frame_skip = task.frame_skip
        self.contact_forces = "cfrc_ext" in task.derived
        self.init_qpos = self.data.qpos.copy()
        # Live views.
        self.warnings = self.data.warning.number
        self.views: dict[str, np.ndarray] = {
            **{name: getattr(self.data, name) for name in task.derived},
            "torso": self.data.xpos[1, :2],
            "mass_center": self.data.xipos[:, :2],
        }
        self.no_warning = np.full_like(self.warnings, _WARNED_BEFORE).tobytes()

    def _copies(self, outputs: Outputs) -> list[tuple[np.ndarray, np.ndarray]]:
        return [(to, self.views[name]) for name, to in outputs.copied.items()]

    def step(self, inputs: np.ndarray, outputs: Outputs, chunk: range) -> None:
        """Steps the chunk's environments; a row of ``inputs`` is MuJoCo's state and control."""
        model, data, copies = self.model, self.data, self._copies(outputs)
        part = slice(chunk.start, chunk.stop)
        self.warnings[:] = _WARNED_BEFORE  # whatever a reset or an interrupted step left there
        for i, before, after in zip(chunk, inputs[part], outputs.physics[part], strict=True):
            mujoco.mj_setState(model, data, before, _STATE_AND_CTRL_SPEC)
            mujoco.mj_step(model, data, self.frame_skip)
            mujoco.mj_getState(model, data, after, STATE_SPEC)
            if self.contact_forces:
                mujoco.mj_rnePostConstraint(model, data)
            for to, view in copies:
                to[i] = view
            if self.warnings.tobytes() != self.no_warning:
                outputs.rows[i, -1] = (self.warnings[_BAD_WARNINGS] != _WARNED_BEFORE).any()
                self.warnings[:] = _WARNED_BEFORE

    def reset(self, noise: np.ndarray, outputs: Outputs, chunk: Sequence[int]) -> None:
        """Writes fresh episodes; a row of ``noise`` is that of qpos and qvel."""
        model, data, copies = self.model, self.data, self._copies(outputs)
        for i in chunk:
            mujoco.mj_resetData(model, data)
            data.qpos[:] = self.init_qpos + noise[i, : model.nq]
            data.qvel[:] = noise[i, model.nq :]
            mujoco.mj_forward(model, data)
            mujoco.mj_getState(model, data, outputs.physics[i], STATE_SPEC)
            for to, view in copies:
                to[i] = view


class Job(NamedTuple):
    """One kind of work for the chosen environments.

    Attributes:
      task: the method of a worker.
      numbers: what goes into it, ``[num, ...]``.
      outputs: where it writes to.
      chosen: for which environments, none perhaps.
      work: of one environment: evaluations of the dynamics × degrees of freedom.
    """

    task: Callable[[Worker, np.ndarray, Outputs, Any], None]
    numbers: np.ndarray
    outputs: Outputs
    chosen: Sequence[int]
    work: int


def _chunks(chosen: Sequence[int], num_threads: int) -> Iterator[Sequence[int]]:
    """Large ones first, since each costs time; single ones last, so that no thread ends late."""
    start = 0
    while start < len(chosen):
        size = max(1, (len(chosen) - start) // (2 * num_threads))
        yield chosen[start : start + size]
        start += size


class Threads:
    """``num`` threads with a :class:`Worker` each, the calling one among them.

    Attributes:
      calls: number of calls of :meth:`run` so far.
    """

    def __init__(self, model: mujoco.MjModel, task: Task, num: int):
        self.workers = [Worker(model, task) for _ in range(num)]
        self.pool = ThreadPoolExecutor(max(1, num - 1), "mujoco")
        self.calls = 0

    def run(self, jobs: Sequence[Job]) -> None:
        """Does the jobs in chunks, on all threads if there is enough to do.

        An exception in a thread is raised here, when no thread is working any more.
        """
        num_threads = len(self.workers)
        chunks = iter([(job, c) for job in jobs for c in _chunks(job.chosen, num_threads)])

        def work(worker: Worker) -> None:
            for job, chunk in chunks:  # its next() is atomic
                job.task(worker, job.numbers, job.outputs, chunk)

        def help_out(worker: Worker) -> None:
            # Free by now, unless an interrupt kept an earlier call from waiting for its helpers.
            with worker.lock:
                work(worker)

        num = sum(len(job.chosen) for job in jobs)
        enough = sum(len(job.chosen) * job.work for job in jobs) > _WORTH_SHARING
        helpers: list[Future[None]] = []
        with self.workers[0].lock:  # programs at once take turns
            self.calls += 1
            try:
                for worker in self.workers[1 : num if enough else 1]:
                    helpers.append(self.pool.submit(help_out, worker))
                work(self.workers[0])
            finally:  # whatever happened here, their MjData are theirs until they are done
                # One that has not even started is not waited for.
                started = [helper for helper in helpers if not helper.cancel()]
                if started:
                    wait(started)
            for helper in started:
                helper.result()

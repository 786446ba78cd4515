"""The MJX engine: MuJoCo in JAX, so that environments stay on the accelerator.

The state is slim: positions, velocities, the solver's warm start and what the task measures; all
else follows from those. The root is moved back to the origin after every step, and how far it has
gone is kept apart, so that float32 loses nothing of the displacement however far a run gets.
"""

from __future__ import annotations

import contextlib
import dataclasses
import threading
from collections.abc import Iterator
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from sacformer_jax.config import ConfigError
from sacformer_jax.envs.core import where_tree
from sacformer_jax.envs.models import load_model
from sacformer_jax.envs.physics import PhysicsOutput, ResetNoise
from sacformer_jax.envs.tasks import Quantities, Task
from sacformer_jax.parallel import any_of_all

with contextlib.redirect_stdout(None):  # MJX prints that it could do without warp
    from mujoco import mjx
    from mujoco.mjx import warp as mjx_warp
    from mujoco.mjx._src import collision_driver
    from mujoco.mjx._src.collision_primitive import _plane_sphere, collider
    from mujoco.mjx._src.math import quat_integrate

# C MuJoCo calls a state bad beyond this magnitude (mjMAXVAL).
_BAD_VALUE = 1e10


@dataclasses.dataclass(frozen=True)
class SolverIterations:
    """The constraint solver's budget.

    Attributes:
      newton: Newton iterations at most.
      line_search: steps of each line search at most.
    """

    newton: int
    line_search: int


# Preset "fast": chosen from the table of error against speed in experiments/README.md.
FAST_ITERATIONS = {
    "HalfCheetah": SolverIterations(4, 8),
    "Hopper": SolverIterations(4, 8),
    "Walker2d": SolverIterations(4, 8),
    "Ant": SolverIterations(8, 8),
    "Humanoid": SolverIterations(4, 8),
}
_FAST_ITERATIONS_ELSEWHERE = SolverIterations(8, 8)
"""Of tasks that are not in the table: the most of those that are."""


_WARP_CONTACTS = 2**17


def _check_warp(task: Task) -> None:
    if "cfrc_ext" in task.derived:
        raise ConfigError(
            f"mjx_impl='warp': task {task.name} reads contact forces, which MJX gives with "
            "mjx_impl=jax alone"
        )
    if not mjx_warp.WARP_INSTALLED:
        raise ConfigError("mjx_impl='warp': is not installed: pip install warp-lang")
    if jax.default_backend() != "gpu":
        raise ConfigError(
            f"mjx_impl='warp': needs an NVIDIA GPU, JAX's backend is {jax.default_backend()}; "
            "use mjx_impl=jax"
        )


@flax.struct.dataclass
class MjxState:
    """The physics state of one environment, its root at the origin if the task has it recentred.

    Attributes:
      qpos: ``[nq]``, positions relative to ``origin``.
      qvel: ``[nv]``.
      qacc_warmstart: ``[nv]``, where the constraint solver starts from.
      measured: ``[2]``, xy of what the task measures, relative to ``origin``.
      origin: ``[2]``, how far the root has gone, as far as it is recentred.
      act: ``[na]``, activations of the actuators that have them; None where there are none.
    """

    qpos: jax.Array
    qvel: jax.Array
    qacc_warmstart: jax.Array
    measured: jax.Array
    origin: jax.Array
    act: jax.Array | None = None


@flax.struct.dataclass
class _RungeKutta:
    """Between the stages of a step: the next one's data, and weighted sums over those done."""

    data: mjx.Data
    velocity: jax.Array
    acceleration: jax.Array


# Classical Runge-Kutta: how far each stage goes on for the next one, and its share in the sum.
_RK4_TABLEAU = np.array([[0.5, 1 / 6], [0.5, 1 / 3], [1.0, 1 / 3], [0.0, 1 / 6]], np.float32)


class MjxEngine:
    """MJX behind the engine signature of :mod:`sacformer_jax.envs.physics`.

    Args:
      task: the task.
      preset: ``"parity"``, the model's own solver settings (PGS, which MJX lacks, becomes Newton);
        or ``"fast"``, the few iterations of :data:`FAST_ITERATIONS`.
      impl: ``"jax"``, or ``"warp"`` on NVIDIA.
      iterations: the solver's budget; overrides the preset's.

    Raises:
      ConfigError: ``impl`` is ``"warp"`` and this machine or the task cannot have it; or the task's
        model cannot be had, or MJX cannot run it.
    """

    def __init__(
        self,
        task: Task,
        preset: str = "parity",
        impl: str = "jax",
        iterations: SolverIterations | None = None,
    ):
        if impl == "warp":
            _check_warp(task)
        self.task, self._impl = task, impl
        self.model = model = load_model(task)
        if getattr(model, "nhistory", 0):  # of MuJoCo that has them
            raise ConfigError(
                f"task {task.name!r}: its model delays an actuator or a sensor, which MJX does not "
                "do; use engine=native"
            )
        if model.opt.solver == mujoco.mjtSolver.mjSOL_PGS:
            model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
        if iterations is None and preset == "fast":
            iterations = FAST_ITERATIONS.get(task.name, _FAST_ITERATIONS_ELSEWHERE)
        if iterations is not None:
            model.opt.iterations = iterations.newton
            model.opt.ls_iterations = iterations.line_search
        self.nq, self.nv = int(model.nq), int(model.nv)
        self.dt = float(model.opt.timestep * task.frame_skip)
        low, high = model.actuator_ctrlrange.astype(np.float32).T
        self.action_low, self.action_high = jnp.asarray(low), jnp.asarray(high)
        self.init_qpos = jnp.asarray(model.qpos0, jnp.float32)
        self._body_mass = jnp.asarray(model.body_mass, jnp.float32)
        free, quaternions = _joints(model)
        # A free root moves in x and y, a planar one in x.
        self._num_root = (2 if free else 1) if task.recentre_root else 0
        runge_kutta = model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
        self._own_runge_kutta = runge_kutta and quaternions == free and model.na == 0
        self._free_root = free
        self._senses_in_stages = runge_kutta and "sensordata" in task.derived
        self._resets_in_full = "sensordata" in task.derived or (
            # Motors do nothing at a control of 0, other actuators may.
            bool(model.actuator_biastype.any()) and {*task.derived} & {*_ACTUATION}
        )
        # Warp's contacts lie in one array over all environments, whose number is not known here.
        room = {"naconmax": _WARP_CONTACTS} if impl == "warp" else {}
        try:
            self._mjx_model = mjx.put_model(model, impl=impl)
            self._blank = mjx.make_data(model, impl=impl, **room)
        except NotImplementedError as error:
            raise ConfigError(
                f"engine='mjx': cannot run the model of task {task.name!r}: {error}; use "
                "engine=native"
            ) from error

    # --- pure functions ----------------------------------------------------------------------

    def reset(self, noise: ResetNoise) -> PhysicsOutput:
        qpos = self.init_qpos + noise.qpos
        data = self._blank.replace(qpos=qpos, qvel=noise.qvel)
        with _traced_like_mujoco():
            if self._impl == "warp" or self._resets_in_full:
                data = mjx.forward(self._mjx_model, data)
            else:
                # Contacts and solver would change nothing that a task reads after a reset.
                for stage in (mjx.kinematics, mjx.com_pos, mjx.com_vel):
                    data = stage(self._mjx_model, data)
            # MJX normalizes a free root's quaternion here; C MuJoCo leaves it as it is.
            return self._output(data.replace(qpos=qpos), jnp.zeros(2), None)

    def step(self, state: MjxState, ctrl: jax.Array) -> PhysicsOutput:
        data = self._blank.replace(
            qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.qacc_warmstart, ctrl=ctrl
        )
        if state.act is not None:
            data = data.replace(act=state.act)

        with _traced_like_mujoco():
            data, _ = jax.lax.scan(
                lambda data, _: (self._substep(data), None), data, length=self.task.frame_skip
            )
            if "cfrc_ext" in self.task.derived:
                data = mjx.rne_postconstraint(self._mjx_model, data)
            return self._output(data, state.origin, state.measured)

    def step_and_reset(
        self, states: MjxState, ctrls: jax.Array, reset: jax.Array, noise: ResetNoise
    ) -> tuple[PhysicsOutput, PhysicsOutput]:
        stepped = jax.vmap(self.step)(states, ctrls)
        zeros = jax.tree.map(jnp.zeros_like, stepped)
        fresh = jax.lax.cond(any_of_all(reset), lambda: jax.vmap(self.reset)(noise), lambda: zeros)
        return stepped, where_tree(reset, fresh, zeros)

    def _substep(self, data: mjx.Data) -> mjx.Data:
        """One physics step."""
        stepped = (
            self._runge_kutta(data) if self._own_runge_kutta else mjx.step(self._mjx_model, data)
        )
        if self._senses_in_stages:  # C MuJoCo senses in the first stage alone
            sensed = mjx.forward(self._mjx_model, data)
            stepped = stepped.replace(sensordata=sensed.sensordata)
        return stepped

    def _runge_kutta(self, data: mjx.Data) -> mjx.Data:
        """A Runge-Kutta step, where no joint but a free root has a quaternion."""
        # MJX's own Runge-Kutta lays four copies of the dynamics into the program; one copy in a
        # loop compiles in about half the time.
        timestep = self._mjx_model.opt.timestep

        def stage(carry: _RungeKutta, tableau: jax.Array) -> tuple[_RungeKutta, None]:
            to_next, share = tableau
            data = mjx.forward(self._mjx_model, carry.data)
            return _RungeKutta(
                data=data.replace(
                    qpos=self._integrate(qpos, to_next * timestep, data.qvel),
                    qvel=qvel + to_next * timestep * data.qacc,
                ),
                velocity=carry.velocity + share * data.qvel,
                acceleration=carry.acceleration + share * data.qacc,
            ), None

        qpos, qvel = data.qpos, data.qvel
        zeros = jnp.zeros(self.nv)
        end, _ = jax.lax.scan(stage, _RungeKutta(data, zeros, zeros), jnp.asarray(_RK4_TABLEAU))
        return end.data.replace(
            qpos=self._integrate(qpos, timestep, end.velocity),
            qvel=qvel + timestep * end.acceleration,
            qacc_warmstart=end.data.qacc,
        )

    def _integrate(self, qpos: jax.Array, duration: jax.Array, qvel: jax.Array) -> jax.Array:
        """``qpos`` after moving at ``qvel``; a free root turns about its own axes."""
        if not self._free_root:
            return qpos + duration * qvel
        return jnp.concatenate(
            [
                qpos[:3] + duration * qvel[:3],
                quat_integrate(qpos[3:7], qvel[3:6], duration),
                qpos[7:] + duration * qvel[6:],
            ]
        )

    def state(
        self, qpos: jax.Array, qvel: jax.Array, qacc_warmstart: jax.Array, measured: jax.Array
    ) -> MjxState:
        """The state with these values, ``measured [2]`` in the world (for tests and tools)."""
        origin = jnp.zeros(2).at[: self._num_root].set(qpos[: self._num_root])
        return MjxState(
            qpos=qpos.at[: self._num_root].set(0.0),
            qvel=qvel,
            qacc_warmstart=qacc_warmstart,
            measured=measured - origin,
            origin=origin,
        )

    def _output(
        self, data: mjx.Data, origin: jax.Array, measured_before: jax.Array | None
    ) -> PhysicsOutput:
        measured = self._measure(data)
        root = data.qpos[: self._num_root]
        shift = jnp.zeros(2).at[: self._num_root].set(root)
        new_origin = origin + shift
        values = jnp.concatenate([data.qpos, data.qvel, data.qacc])
        quantities = Quantities(
            qpos=data.qpos.at[: self._num_root].set(new_origin[: self._num_root]),
            qvel=data.qvel,
            displacement=jnp.zeros(2) if measured_before is None else measured - measured_before,
            derived={name: self._derived(name, data, origin) for name in self.task.derived},
        )
        return PhysicsOutput(
            state=MjxState(
                qpos=data.qpos.at[: self._num_root].set(0.0),
                qvel=data.qvel,
                qacc_warmstart=data.qacc_warmstart,
                measured=measured - shift,
                origin=new_origin,
                act=data.act if self.model.na else None,
            ),
            quantities=quantities,
            bad=~jnp.all(jnp.abs(values) <= _BAD_VALUE),  # true of NaN, too
        )

    def _measure(self, data: mjx.Data) -> jax.Array:
        """``[2]``: xy of what the task measures; ``xpos`` and ``xipos`` lag ``qpos`` as in C."""
        if self.task.measure == "root":
            return jnp.stack([data.qpos[0], jnp.zeros(())])
        if self.task.measure == "torso":
            return data.xpos[1, :2]
        return (self._body_mass @ data.xipos / self._body_mass.sum())[:2]

    def _derived(self, name: str, data: mjx.Data, origin: jax.Array) -> jax.Array:
        values = getattr(data._impl if name in _NOT_PUBLIC else data, name)
        if self._num_root and name in _IN_THE_WORLD:
            values = values.at[_moving(self.model, name), :2].add(origin)
        return values


_NOT_PUBLIC = ("cinert", "cfrc_ext")
_IN_THE_WORLD = ("xpos", "xipos", "subtree_com", "geom_xpos", "site_xpos")
"""Positions that move with the root, where they are not the world's."""
_ACTUATION = ("qfrc_actuator", "actuator_force")


def _moving(model: mujoco.MjModel, name: str) -> np.ndarray:
    """The rows of a quantity of the world that are of bodies that are not fixed to it."""
    if name == "subtree_com":  # of the world, that of all bodies
        return np.arange(model.nbody)
    bodies = {"geom_xpos": model.geom_bodyid, "site_xpos": model.site_bodyid}
    return np.flatnonzero(model.body_weldid[bodies.get(name, np.arange(model.nbody))])


def _joints(model: mujoco.MjModel) -> tuple[bool, int]:
    """Whether the first joint is a free one, and how many joints have a quaternion."""
    kinds = [mujoco.mjtJoint(kind) for kind in model.jnt_type]
    with_quaternion = (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL)
    return kinds[0] == with_quaternion[0], sum(kind in with_quaternion for kind in kinds)


# --- plane-capsule contacts as C MuJoCo makes them ------------------------------------------------


@collider(ncon=2)
def _plane_capsule(plane: Any, capsule: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Contacts of a capsule with a plane, the first tangent along the capsule however steep it is.

    MJX turns to a fixed tangent where the capsule is within 30 degrees of the normal; C MuJoCo does
    not, and pyramidal friction cones feel the difference.
    """
    normal, axis = plane.mat[:, 2], capsule.mat[:, 2]
    along = axis - normal * jnp.dot(normal, axis)
    length = jnp.linalg.norm(along)
    upright = length < mujoco.mjMINVAL
    tangent = jnp.where(
        upright, jnp.array([1.0, 0.0, 0.0]), along / jnp.where(upright, 1.0, length)
    )
    frame = jnp.stack([normal, tangent, jnp.cross(normal, tangent)])
    ends = jnp.stack([capsule.pos + axis * capsule.size[1], capsule.pos - axis * capsule.size[1]])
    distance, position = jax.vmap(_plane_sphere, (None, None, 0, None))(
        normal, plane.pos, ends, capsule.size[0]
    )
    return distance, position, jnp.stack([frame, frame])


_PLANE_CAPSULE = (mjx.GeomType.PLANE, mjx.GeomType.CAPSULE)
_patching = threading.Lock()


@contextlib.contextmanager
def _traced_like_mujoco() -> Iterator[None]:
    """While MJX is traced: our plane-capsule contacts, and products in full float32.

    The table of collision functions is MJX's own, so it is changed only here and put back.
    """
    functions = collision_driver._COLLISION_FUNC
    with _patching, jax.default_matmul_precision("highest"):
        original = functions[_PLANE_CAPSULE]
        functions[_PLANE_CAPSULE] = _plane_capsule
        try:
            yield
        finally:
            functions[_PLANE_CAPSULE] = original

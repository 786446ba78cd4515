"""Tasks as pure functions of physics quantities, and the five Gymnasium-v5 ones.

A task sees only :class:`Quantities`, the physics quantities an engine reports after a step, and
knows nothing of the engine that produced them. The five follow ``gymnasium.envs.mujoco.*_v5``
with their default arguments; the tests compare every number with Gymnasium itself. How to write
one of your own: docs/own_task.md.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import flax.struct
import jax
import jax.numpy as jnp

Measure = Literal["root", "torso", "mass_center"]
Derived = Literal[
    "cinert", "cvel", "qfrc_actuator", "cfrc_ext", "xpos", "xquat", "xipos", "subtree_com",
    "geom_xpos", "site_xpos", "actuator_force", "sensordata",
]  # fmt: skip


@flax.struct.dataclass
class Quantities:
    """What an engine reports of one environment after a reset or a step (float32).

    Attributes:
      qpos: generalized positions, ``[nq]``.
      qvel: generalized velocities, ``[nv]``.
      displacement: metres moved in x and y over the step by what the task measures, ``[2]``,
        subtracted in float64 (native) so that it stays exact far from the origin; 0 at a reset.
      derived: the engine quantities the task asks for in :attr:`Task.derived`, by MuJoCo's name:
        ``xpos [nbody, 3]``, ``xquat [nbody, 4]``, ``xipos [nbody, 3]``, ``subtree_com [nbody, 3]``,
        ``geom_xpos [ngeom, 3]``, ``site_xpos [nsite, 3]``, ``sensordata [nsensordata]``,
        ``actuator_force [nu]``, ``qfrc_actuator [nv]``, ``cinert [nbody, 10]``,
        ``cvel [nbody, 6]``, ``cfrc_ext [nbody, 6]``. As ``mj_step`` leaves them, so in Gymnasium
        too, they belong to the last physics step's start: they lag ``qpos`` by one of
        ``frame_skip`` physics steps.
    """

    qpos: jax.Array
    qvel: jax.Array
    displacement: jax.Array
    derived: dict[str, jax.Array]


@flax.struct.dataclass
class Coordinates:
    """Where an episode starts: generalized ``qpos [nq]`` and ``qvel [nv]``, float32."""

    qpos: jax.Array
    qvel: jax.Array


RewardTerms = dict[str, jax.Array]
RewardFunction = Callable[[Quantities, jax.Array, jax.Array], RewardTerms]


def positions_and_velocities(q: Quantities) -> jax.Array:
    return jnp.concatenate([q.qpos, q.qvel])


def _never(q: Quantities) -> jax.Array:
    return jnp.zeros((), bool)


@dataclasses.dataclass(frozen=True)
class Task:
    """One MuJoCo task: everything of it that is not physics.

    Attributes:
      name: what it is called, e.g. ``"Reach"``.
      xml_file: the model: the ``Path`` of an MJCF file; or MJCF itself, a string that begins with
        ``<``; or a string, the name of a file among the assets of the installed ``gymnasium``.
      reward_terms: ``(Quantities, action [A], x_velocity) -> terms``, scalars by name that add up
        to the reward; ``x_velocity`` is that of what the task measures, in m/s. Gymnasium's names
        begin with ``reward_``.
      observe: ``Quantities -> obs [O]``; default: positions and velocities.
      terminated: ``Quantities -> bool``; default: never.
      frame_skip: physics steps per environment step.
      measure: what ``x_velocity`` measures: ``"root"`` (qpos[0]), ``"torso"`` (xpos of body 1)
        or ``"mass_center"`` (mass-weighted xipos).
      derived: engine quantities needed beyond positions and velocities.
      qpos_noise: half-width of the uniform noise added to qpos at a reset.
      qvel_noise: half-width (uniform) or standard deviation (normal) of the qvel noise.
      qvel_noise_normal: whether the qvel noise is normal.
      reset: ``(key, Coordinates of the model) -> Coordinates``, an episode's start; default: the
        model's with the noise above.
      recentre_root: on mjx, move the root back to the origin after every step, so that float32
        loses nothing however far it gets. Only for one tree on the first joint, a free one or a
        slide along x, where physics is the same everywhere: a plane for a floor, and nothing else
        that is fixed to the world.
      max_episode_steps: time limit, in environment steps.
      gymnasium_id: the same task in Gymnasium, e.g. ``"HalfCheetah-v5"``, or None.
      velocities: places of ``observe``'s vector that are velocities, each ``(start, stop)``, for
        ``hide_velocities``; of the default ``observe`` they are known.
    """

    name: str
    xml_file: str | Path
    reward_terms: RewardFunction
    observe: Callable[[Quantities], jax.Array] = positions_and_velocities
    terminated: Callable[[Quantities], jax.Array] = _never
    frame_skip: int = 1
    measure: Measure = "root"
    derived: tuple[Derived, ...] = ()
    qpos_noise: float = 0.0
    qvel_noise: float = 0.0
    qvel_noise_normal: bool = False
    reset: Callable[[jax.Array, Coordinates], Coordinates] | None = None
    recentre_root: bool = False
    max_episode_steps: int = 1000
    gymnasium_id: str | None = None
    velocities: tuple[tuple[int, int], ...] = ()

    def __post_init__(self) -> None:
        # Lists would do as well, but engines are found by their task, which must have a hash.
        object.__setattr__(self, "derived", tuple(self.derived))
        places = (tuple(place) if isinstance(place, list) else place for place in self.velocities)
        object.__setattr__(self, "velocities", tuple(places))


def _between(low: float, value: jax.Array, high: float) -> jax.Array:
    return (low < value) & (value < high)


# --- HalfCheetah -----------------------------------------------------------------------------


def _half_cheetah_obs(q: Quantities) -> jax.Array:
    return jnp.concatenate([q.qpos[1:], q.qvel])


def _half_cheetah_reward(q: Quantities, action: jax.Array, x_velocity: jax.Array) -> RewardTerms:
    return {"reward_forward": x_velocity, "reward_ctrl": -0.1 * jnp.sum(action**2)}


# --- Hopper and Walker2d ---------------------------------------------------------------------


def _planar_walker_obs(q: Quantities) -> jax.Array:
    return jnp.concatenate([q.qpos[1:], jnp.clip(q.qvel, -10.0, 10.0)])


def _planar_walker_reward(healthy: Callable[[Quantities], jax.Array]) -> RewardFunction:
    def reward_terms(q: Quantities, action: jax.Array, x_velocity: jax.Array) -> RewardTerms:
        return {
            "reward_forward": x_velocity,
            "reward_ctrl": -1e-3 * jnp.sum(action**2),
            "reward_survive": healthy(q).astype(jnp.float32),
        }

    return reward_terms


def _hopper_healthy(q: Quantities) -> jax.Array:
    rest_of_state = jnp.concatenate([q.qpos[2:], q.qvel])
    return (
        jnp.all(_between(-100.0, rest_of_state, 100.0))
        & (q.qpos[1] > 0.7)
        & _between(-0.2, q.qpos[2], 0.2)
    )


def _walker2d_healthy(q: Quantities) -> jax.Array:
    return _between(0.8, q.qpos[1], 2.0) & _between(-1.0, q.qpos[2], 1.0)


# --- Ant -------------------------------------------------------------------------------------


def _ant_contact_forces(q: Quantities) -> jax.Array:
    return jnp.clip(q.derived["cfrc_ext"], -1.0, 1.0)


def _ant_obs(q: Quantities) -> jax.Array:
    return jnp.concatenate([q.qpos[2:], q.qvel, _ant_contact_forces(q)[1:].reshape(-1)])


def _ant_healthy(q: Quantities) -> jax.Array:
    finite = jnp.all(jnp.isfinite(q.qpos)) & jnp.all(jnp.isfinite(q.qvel))
    return finite & (q.qpos[2] >= 0.2) & (q.qpos[2] <= 1.0)


def _ant_reward(q: Quantities, action: jax.Array, x_velocity: jax.Array) -> RewardTerms:
    return {
        "reward_forward": x_velocity,
        "reward_ctrl": -0.5 * jnp.sum(action**2),
        "reward_contact": -5e-4 * jnp.sum(_ant_contact_forces(q) ** 2),
        "reward_survive": _ant_healthy(q).astype(jnp.float32),
    }


# --- Humanoid --------------------------------------------------------------------------------


def _humanoid_obs(q: Quantities) -> jax.Array:
    return jnp.concatenate(
        [
            q.qpos[2:],
            q.qvel,
            q.derived["cinert"][1:].reshape(-1),
            q.derived["cvel"][1:].reshape(-1),
            q.derived["qfrc_actuator"][6:],
            q.derived["cfrc_ext"][1:].reshape(-1),
        ]
    )


def _humanoid_healthy(q: Quantities) -> jax.Array:
    return _between(1.0, q.qpos[2], 2.0)


def _humanoid_reward(q: Quantities, action: jax.Array, x_velocity: jax.Array) -> RewardTerms:
    contact_cost = jnp.minimum(5e-7 * jnp.sum(q.derived["cfrc_ext"] ** 2), 10.0)
    return {
        "reward_survive": 5.0 * _humanoid_healthy(q).astype(jnp.float32),
        "reward_forward": 1.25 * x_velocity,
        "reward_ctrl": -0.1 * jnp.sum(action**2),
        "reward_contact": -contact_cost,
    }


TASKS: dict[str, Task] = {
    task.name: task
    for task in (
        Task(
            name="HalfCheetah",
            xml_file="half_cheetah.xml",
            frame_skip=5,
            measure="root",
            qpos_noise=0.1,
            qvel_noise=0.1,
            qvel_noise_normal=True,
            observe=_half_cheetah_obs,
            reward_terms=_half_cheetah_reward,
            recentre_root=True,
            gymnasium_id="HalfCheetah-v5",
            velocities=((8, 17),),
        ),
        Task(
            name="Hopper",
            xml_file="hopper.xml",
            frame_skip=4,
            measure="root",
            qpos_noise=5e-3,
            qvel_noise=5e-3,
            qvel_noise_normal=False,
            observe=_planar_walker_obs,
            reward_terms=_planar_walker_reward(_hopper_healthy),
            terminated=lambda q: ~_hopper_healthy(q),
            recentre_root=True,
            gymnasium_id="Hopper-v5",
            velocities=((5, 11),),
        ),
        Task(
            name="Walker2d",
            xml_file="walker2d_v5.xml",
            frame_skip=4,
            measure="root",
            qpos_noise=5e-3,
            qvel_noise=5e-3,
            qvel_noise_normal=False,
            observe=_planar_walker_obs,
            reward_terms=_planar_walker_reward(_walker2d_healthy),
            terminated=lambda q: ~_walker2d_healthy(q),
            recentre_root=True,
            gymnasium_id="Walker2d-v5",
            velocities=((8, 17),),
        ),
        Task(
            name="Ant",
            xml_file="ant.xml",
            frame_skip=5,
            measure="torso",
            derived=("cfrc_ext",),
            qpos_noise=0.1,
            qvel_noise=0.1,
            qvel_noise_normal=True,
            observe=_ant_obs,
            reward_terms=_ant_reward,
            terminated=lambda q: ~_ant_healthy(q),
            recentre_root=True,
            gymnasium_id="Ant-v5",
            velocities=((13, 27),),
        ),
        Task(
            name="Humanoid",
            xml_file="humanoid.xml",
            frame_skip=5,
            measure="mass_center",
            derived=("cinert", "cvel", "qfrc_actuator", "cfrc_ext"),
            qpos_noise=1e-2,
            qvel_noise=1e-2,
            qvel_noise_normal=False,
            observe=_humanoid_obs,
            reward_terms=_humanoid_reward,
            terminated=lambda q: ~_humanoid_healthy(q),
            recentre_root=True,
            gymnasium_id="Humanoid-v5",
            velocities=((22, 45), (175, 253)),  # qvel, cvel
        ),
    )
}

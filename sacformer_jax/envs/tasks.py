"""The five Gymnasium-v5 MuJoCo tasks, each written once as pure functions.

A task sees only :class:`Quantities`, the physics quantities an engine reports after a step, and
knows nothing of the engine that produced them. Definitions follow ``gymnasium.envs.mujoco.*_v5``
with their default arguments; the tests compare every number with Gymnasium itself.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Literal

import flax.struct
import jax
import jax.numpy as jnp

Derived = Literal["cinert", "cvel", "qfrc_actuator", "cfrc_ext"]


@flax.struct.dataclass
class Quantities:
    """What an engine reports of one environment after a reset or a step (float32).

    Attributes:
      qpos: generalized positions, ``[nq]``.
      qvel: generalized velocities, ``[nv]``.
      displacement: metres moved in x and y over the step by what the task measures, ``[2]``,
        subtracted in float64 (native) so that it stays exact far from the origin; 0 at a reset.
      derived: the engine quantities the task asks for in :attr:`Task.derived`, by MuJoCo's name:
        ``cinert [nbody, 10]``, ``cvel [nbody, 6]``, ``qfrc_actuator [nv]``,
        ``cfrc_ext [nbody, 6]``.
    """

    qpos: jax.Array
    qvel: jax.Array
    displacement: jax.Array
    derived: dict[str, jax.Array]


RewardTerms = dict[str, jax.Array]
RewardFunction = Callable[[Quantities, jax.Array, jax.Array], RewardTerms]


@dataclasses.dataclass(frozen=True)
class Task:
    """One MuJoCo task: everything of it that is not physics.

    Attributes:
      name: Gymnasium's name without the version, e.g. ``"HalfCheetah"``.
      xml_file: file name of the model among the assets of the installed ``gymnasium`` package.
      frame_skip: physics steps per environment step.
      measure: what the forward reward measures: ``"root"`` (qpos[0]), ``"torso"`` (xpos of body 1)
        or ``"mass_center"`` (mass-weighted xipos).
      derived: engine quantities needed beyond positions and velocities.
      qpos_noise: half-width of the uniform noise added to qpos at a reset.
      qvel_noise: half-width (uniform) or standard deviation (normal) of the qvel noise.
      qvel_noise_normal: whether the qvel noise is normal.
      observe: ``Quantities -> obs [O]``.
      reward_terms: ``(Quantities, action [A], x_velocity) -> terms`` that add up to the reward,
        under the names Gymnasium's ``info`` uses.
      terminated: ``Quantities -> bool``.
    """

    name: str
    xml_file: str
    frame_skip: int
    measure: Literal["root", "torso", "mass_center"]
    derived: tuple[Derived, ...]
    qpos_noise: float
    qvel_noise: float
    qvel_noise_normal: bool
    observe: Callable[[Quantities], jax.Array]
    reward_terms: RewardFunction
    terminated: Callable[[Quantities], jax.Array]
    max_episode_steps: int = 1000

    @property
    def gymnasium_id(self) -> str:
        """The id of the same task in Gymnasium, e.g. ``"HalfCheetah-v5"``."""
        return f"{self.name}-v5"


def _between(low: float, value: jax.Array, high: float) -> jax.Array:
    return (low < value) & (value < high)


def _never(q: Quantities) -> jax.Array:
    return jnp.zeros((), bool)


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
            derived=(),
            qpos_noise=0.1,
            qvel_noise=0.1,
            qvel_noise_normal=True,
            observe=_half_cheetah_obs,
            reward_terms=_half_cheetah_reward,
            terminated=_never,
        ),
        Task(
            name="Hopper",
            xml_file="hopper.xml",
            frame_skip=4,
            measure="root",
            derived=(),
            qpos_noise=5e-3,
            qvel_noise=5e-3,
            qvel_noise_normal=False,
            observe=_planar_walker_obs,
            reward_terms=_planar_walker_reward(_hopper_healthy),
            terminated=lambda q: ~_hopper_healthy(q),
        ),
        Task(
            name="Walker2d",
            xml_file="walker2d_v5.xml",
            frame_skip=4,
            measure="root",
            derived=(),
            qpos_noise=5e-3,
            qvel_noise=5e-3,
            qvel_noise_normal=False,
            observe=_planar_walker_obs,
            reward_terms=_planar_walker_reward(_walker2d_healthy),
            terminated=lambda q: ~_walker2d_healthy(q),
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
        ),
    )
}

"""A task of your own: an MJCF file, and what is observed, rewarded and the end."""

from pathlib import Path

import jax
import jax.numpy as jnp

from sacformer_jax import Config, Coordinates, Quantities, Task, train

FINGERTIP, TARGET = 0, 1  # the sites of reach.xml, in their order


def to_target(q: Quantities) -> jax.Array:
    sites = q.derived["site_xpos"]
    return (sites[TARGET] - sites[FINGERTIP])[:2]


def observe(q: Quantities) -> jax.Array:
    arm = q.qpos[:2]
    return jnp.concatenate([jnp.cos(arm), jnp.sin(arm), q.qvel[:2], q.qpos[2:], to_target(q)])


def reward_terms(q: Quantities, action: jax.Array, x_velocity: jax.Array) -> dict[str, jax.Array]:
    distance = jnp.linalg.norm(to_target(q))
    return {"reward_distance": -distance, "reward_ctrl": -0.01 * jnp.sum(action**2)}


def reset(key: jax.Array, initial: Coordinates) -> Coordinates:
    angles = jax.random.uniform(key, (3,), minval=-2.5, maxval=2.5)  # shoulder, elbow, target
    target = 0.15 * jnp.stack([jnp.cos(angles[2]), jnp.sin(angles[2])])
    return Coordinates(qpos=jnp.concatenate([angles[:2], target]), qvel=initial.qvel)


reach = Task(
    name="Reach",
    xml_file=Path(__file__).with_name("reach.xml"),
    reward_terms=reward_terms,
    observe=observe,
    terminated=lambda q: jnp.linalg.norm(to_target(q)) < 0.01,
    derived=("site_xpos",),
    reset=reset,
    frame_skip=2,
    max_episode_steps=100,
)

if __name__ == "__main__":
    train(Config.from_preset("cpu", env="reach_task:reach", total_env_steps=20_000))

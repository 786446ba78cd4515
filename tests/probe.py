"""A tiny task that a working agent solves in seconds: bring a sliding point to the origin."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from sacformer_jax.config import Config
from sacformer_jax.envs.core import EnvSpec, EnvStep, JaxEnv, VectorEnv

EPISODE = 20


class PointEnv(JaxEnv):
    """``x' = x + 0.4 v``, ``v' = 0.8 v + 0.5 a``, reward ``-x'^2``; never terminates.

    The reward of a step does not depend on its action: without looking ahead nothing is learnt.
    """

    def __init__(self) -> None:
        self.spec = EnvSpec(
            name="point",
            obs_size=2,
            action_size=1,
            action_low=(-1.0,),
            action_high=(1.0,),
            max_episode_steps=EPISODE,
            engine="jax",
            engine_reason="a test",
        )

    def reset(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        x = jax.random.uniform(key, (1,), minval=-2.0, maxval=2.0)
        state = jnp.concatenate([x, jnp.zeros(1)])
        return state, state

    def step(self, state: jax.Array, action: jax.Array) -> tuple[jax.Array, EnvStep]:
        x, v = state
        state = jnp.stack([x + 0.4 * v, 0.8 * v + 0.5 * action[0]])
        reward = -(state[0] ** 2)
        no = jnp.zeros((), bool)
        step = EnvStep(obs=state, reward=reward, terminated=no, bad=no, reward_terms={"r": reward})
        return state, step


class KeepingEnv(PointEnv):
    """The same with more in its state, as physics engines have: an array of nothing, and a key."""

    def reset(self, key: jax.Array) -> tuple[Any, jax.Array]:
        state, obs = super().reset(key)
        return {"point": state, "contacts": jnp.zeros((0, 3)), "key": key}, obs

    def step(self, state: Any, action: jax.Array) -> tuple[Any, EnvStep]:
        point, step = super().step(state["point"], action)
        return {**state, "point": point, "key": jax.random.split(state["key"])[0]}, step


def point_env(num_envs: int) -> VectorEnv:
    return VectorEnv(PointEnv(), num_envs)


def point_config(**fields: object) -> Config:
    """A small SACFormer for the point task; the task named in it is not used."""
    settings = {
        "num_envs": 4,
        "max_episode_steps": EPISODE,
        "prefill_env_steps": 200,
        "total_env_steps": 100_000,
        "chunk_env_steps": 400,
        "buffer_capacity": 8_000,
        "batch_size": 32,
        "context_length": 2,
        "acting_context": "window",
        "actor_layers": 1,
        "actor_width": 16,
        "actor_heads": 1,
        "head_init_scale": 0.01,
        "critic_width": 32,
        "actor_learning_rate": 1e-3,
        "critic_learning_rate": 2e-3,
        "alpha_learning_rate": 1e-3,
        "target_return": 0.0,
        "return_scale": 10.0,
        "updates_per_env_step": 1.0,
        "normalize_obs": False,
        "tune_alpha": True,
        "actor_dropout": 0.0,
    }
    return Config.from_preset("paper", **{"return_conditioning": "commanded", **settings, **fields})

"""Small policies whose parameters and statistics are far from their start, without any training."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np

from sacformer_jax import agents
from sacformer_jax.config import Config
from sacformer_jax.envs.core import EnvSpec
from sacformer_jax.policy import Policy
from sacformer_jax.train import hyperparameters, policy_state
from sacformer_jax.types import Normalizer

OBS, ACT = 3, 1
"""Sizes of Gymnasium's Pendulum-v1."""
LIMIT = 2.0

_SACFORMER = {
    "context_length": 4, "actor_layers": 1, "actor_width": 16, "actor_heads": 2,
    "return_conditioning": "commanded", "target_return": 500.0, "return_scale": 100.0,
    "acting_context": "window", "head_init_scale": 1.0,
}  # fmt: skip


def small_policy(agent: str = "sacformer", episode_steps: int = 40, **fields: object) -> Policy:
    """A policy for Pendulum-v1's observations and actions."""
    own = _SACFORMER if agent == "sacformer" else {"actor_width": 16}
    config = Config.from_preset(
        "paper", agent=agent, env="Hopper", normalize_obs=True, **{**own, **fields}
    )
    spec = EnvSpec(
        "pendulum", OBS, ACT, (-LIMIT,), (LIMIT,), episode_steps, "jax", "a test", "Pendulum-v1"
    )
    made = agents.make(config, spec)
    shaped = jax.eval_shape(made.init, jax.random.key(0))
    rng = np.random.default_rng(1)
    learner = dataclasses.replace(
        shaped,
        actor_params=jax.tree.map(
            lambda x: rng.normal(scale=0.3, size=x.shape).astype(x.dtype), shaped.actor_params
        ),
        normalizer=Normalizer(
            count=np.int32(10),
            mean=np.array([0.1, -0.2, 0.3], np.float32),
            m2=np.array([20.0, 5.0, 10.0], np.float32),
        ),
    )
    return Policy(config, spec, made, policy_state(learner, hyperparameters(config, ACT)))

"""PPO: proximal policy optimization. Schulman et al., arXiv 1707.06347.

The details are those of CleanRL's ``ppo_continuous_action`` (Huang et al., "The 37 Implementation
Details of Proximal Policy Optimization", 2022); docs/baselines.md says where they differ.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from sacformer_jax import normalizer
from sacformer_jax.agents import ppo_policy, ppo_update
from sacformer_jax.agents.core import Agent
from sacformer_jax.agents.ppo_policy import PpoActor, PpoCritic, PpoParts
from sacformer_jax.agents.ppo_update import ADAM
from sacformer_jax.config import Config
from sacformer_jax.envs.core import EnvSpec
from sacformer_jax.parallel import DataAxis
from sacformer_jax.types import LearnerState


def make(config: Config, spec: EnvSpec, data: DataAxis) -> Agent:
    """Builds PPO for an environment."""
    dtype = config.precision.compute_dtype
    actor = PpoActor(
        widths=(config.actor.actor_width,) * config.actor.actor_layers,
        activation=config.actor.actor_activation,
        action_size=spec.action_size,
        head_init_scale=config.actor.head_init_scale,
        dtype=dtype,
    )
    critic = PpoCritic(
        widths=(config.critic.critic_width,) * config.critic.critic_layers,
        activation=config.critic.critic_activation,
        layer_norm=config.critic.critic_layer_norm,
        dtype=dtype,
    )
    num_chunks = -(-config.run.total_env_steps // config.env_steps_per_chunk)
    parts = PpoParts(
        actor=actor,
        critic=critic,
        settings=config.ppo,
        num_rounds=num_chunks * config.iterations_per_chunk,
        spec=spec,
        normalize_obs=config.context.normalize_obs,
        data=data,
    )
    return Agent(
        init=partial(_init, parts),
        init_cache=lambda num_envs: {},
        act=partial(ppo_policy.act, parts),
        update=partial(ppo_update.update, parts),
        checked=ppo_update.CHECKED,
        prepare=partial(ppo_update.prepare, parts),
    )


def _init(parts: PpoParts, key: jax.Array) -> LearnerState:
    actor_key, critic_key = jax.random.split(key)
    obs = jnp.zeros((1, parts.spec.obs_size))
    actor_params = parts.actor.init(actor_key, obs)
    critic_params = parts.critic.init(critic_key, obs)
    return LearnerState(
        actor_params=actor_params,
        critic_params=critic_params,
        target_critic_params=None,
        log_alpha=None,
        actor_opt=ADAM.init(actor_params),
        critic_opt=ADAM.init(critic_params),
        alpha_opt=None,
        normalizer=normalizer.init(parts.spec.obs_size),
        num_updates=jnp.zeros((), jnp.int32),
        reward_scale=normalizer.init(1),
    )

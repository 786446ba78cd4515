"""SAC: an MLP actor on the current state (K = 1). Haarnoja et al., arXiv 1812.05905."""

from __future__ import annotations

from sacformer_jax.agents.core import Agent
from sacformer_jax.agents.sac_policy import SACParts, sac_parts
from sacformer_jax.agents.sac_update import make_sac_agent
from sacformer_jax.config import Config
from sacformer_jax.envs.core import EnvSpec
from sacformer_jax.networks import MLPActor
from sacformer_jax.parallel import DataAxis


def make(config: Config, spec: EnvSpec, data: DataAxis) -> Agent:
    """Builds SAC for an environment."""
    return make_sac_agent(make_parts(config, spec, data))


def make_parts(config: Config, spec: EnvSpec, data: DataAxis) -> SACParts:
    """What SAC's functions are bound to."""
    actor = MLPActor(
        widths=(config.actor.actor_width,) * config.actor.actor_layers,
        activation=config.actor.actor_activation,
        action_size=spec.action_size,
        head_init_scale=config.actor.head_init_scale,
        dtype=config.precision.compute_dtype,
    )
    return sac_parts(config, spec, data, actor)

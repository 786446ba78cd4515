"""TD3: DDPG with twin critics, smoothed targets and a delayed policy. arXiv 1802.09477."""

from __future__ import annotations

from sacformer_jax.agents.core import Agent
from sacformer_jax.agents.deterministic import make_deterministic_agent
from sacformer_jax.config import Config
from sacformer_jax.distributions import NoisyPoint
from sacformer_jax.envs.core import EnvSpec
from sacformer_jax.parallel import DataAxis


def make(config: Config, spec: EnvSpec, data: DataAxis) -> Agent:
    """Builds TD3 (the paper's Algorithm 1) for an environment."""
    settings = config.td3
    return make_deterministic_agent(
        config,
        spec,
        data,
        num_critics=2,
        smoothing=NoisyPoint(
            spec.action_low, spec.action_high, settings.target_noise, settings.target_noise_clip
        ),
        policy_delay=settings.policy_delay,
    )

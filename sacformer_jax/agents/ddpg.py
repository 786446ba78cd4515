"""DDPG: one critic, one deterministic actor, a target of each. arXiv 1509.02971.

As later programs run it (CleanRL, Spinning Up): Gaussian noise in acting instead of the paper's
Ornstein-Uhlenbeck process, actions beside the state in the critic's first layer, no weight decay.
"""

from __future__ import annotations

from sacformer_jax.agents.core import Agent
from sacformer_jax.agents.deterministic import make_deterministic_agent
from sacformer_jax.config import Config
from sacformer_jax.envs.core import EnvSpec
from sacformer_jax.parallel import DataAxis


def make(config: Config, spec: EnvSpec, data: DataAxis) -> Agent:
    """Builds DDPG (the paper's Algorithm 1) for an environment."""
    return make_deterministic_agent(config, spec, data)

"""Algorithms by name, one file each."""

from __future__ import annotations

from sacformer_jax.agents import ddpg, ppo, sac, sacformer, td3
from sacformer_jax.agents.core import Agent
from sacformer_jax.config import Config
from sacformer_jax.envs.core import EnvSpec
from sacformer_jax.parallel import UNDIVIDED, DataAxis

_MAKERS = {
    "sacformer": sacformer.make,
    "sac": sac.make,
    "td3": td3.make,
    "ddpg": ddpg.make,
    "ppo": ppo.make,
}


def make(config: Config, spec: EnvSpec, data: DataAxis = UNDIVIDED) -> Agent:
    """Builds the agent ``config.agent`` names; ``data`` says how batches are split over devices."""
    return _MAKERS[config.agent](config, spec, data)

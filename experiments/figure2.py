"""Figure 2 of the paper: SACFormer beside SAC, TD3, DDPG and PPO on four tasks, three seeds.

python experiments/figure2.py --jobs 2                # preset cpu, 100,000 env steps
python experiments/figure2.py --scale full            # preset paper, 1 M env steps
"""

from __future__ import annotations

import itertools
import sys
from typing import Any

from study import Study, main_of_scales

from sacformer_jax import Config

TASKS = ("HalfCheetah", "Hopper", "Walker2d", "Ant")
AGENTS = ("sacformer", "sac", "td3", "ddpg", "ppo")
SETTINGS: dict[str, dict[str, Any]] = {
    "cpu": {"preset": "cpu", "total_env_steps": 100_000},
    "full": {"preset": "paper", "total_env_steps": 1_000_000},
}


def study(scale: str) -> Study:
    """All its runs."""
    configs = {
        f"{task}-{agent}": Config.from_preset(**SETTINGS[scale], agent=agent, env=task, seeds=3)
        for agent, task in itertools.product(AGENTS, TASKS)
    }
    return Study(f"figure2-{scale}", configs, __file__)


if __name__ == "__main__":
    sys.exit(main_of_scales(study))

"""The baselines against what the field knows of them: preset `paper`, 1 M env steps, two seeds.

python experiments/baselines.py --jobs 2
"""

from __future__ import annotations

import sys

from study import Study

from sacformer_jax import Config

RUNS = (
    ("HalfCheetah", "ppo"),
    ("Hopper", "ppo"),
    ("HalfCheetah", "td3"),
    ("HalfCheetah", "ddpg"),
    ("HalfCheetah", "sac"),
    ("Hopper", "td3"),
    ("Hopper", "sac"),
    ("Hopper", "ddpg"),
)


def study() -> Study:
    """All its runs."""
    configs = {
        f"{task}-{agent}": Config.from_preset(
            "paper", agent=agent, env=task, seeds=2, total_env_steps=1_000_000,
            eval_every=20_000, eval_episodes=10, checkpoint_every=100_000,
        )
        for task, agent in RUNS
    }  # fmt: skip
    return Study("baselines", configs, __file__)


if __name__ == "__main__":
    sys.exit(study().main())

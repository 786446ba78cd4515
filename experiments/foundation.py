"""SACFormer beside SAC: both with preset `cpu`, 100,000 env steps, 3 tasks, 2 seeds.

python experiments/foundation.py                      # all runs, one after the other
python experiments/foundation.py --jobs 2             # two side by side, half the cores each
python experiments/foundation.py --only Hopper-sac-0
"""

from __future__ import annotations

import itertools
import sys

from study import Study

from sacformer_jax import Config

ENV_STEPS = 100_000
TASKS = ("HalfCheetah", "Hopper", "Walker2d")
AGENTS = ("sacformer", "sac")
SEEDS = (0, 1)


def study() -> Study:
    """All its runs."""
    configs = {
        f"{task}-{agent}-{seed}": Config.from_preset(
            "cpu", agent=agent, env=task, seed=seed, total_env_steps=ENV_STEPS
        )
        for seed, task, agent in itertools.product(SEEDS, TASKS, AGENTS)
    }
    return Study("foundation", configs, __file__)


if __name__ == "__main__":
    sys.exit(study().main())

"""Is SACFormer better than SAC? Both with preset `best`, five tasks, seeds nothing was tuned on.

python experiments/arena.py --jobs 2

100,000 env steps, seeds 100 to 104 in one program, each run on a core of its own. Beside them both
agents with preset `cpu` (SAC as published: single steps, one-step targets), and presets `paper` and
`authors` at the sizes that make `cpu` fast, as variants.py has them, with the first three seeds.
"""

from __future__ import annotations

import itertools
import sys
from typing import Any

from study import Study
from variants import LIKE_CPU

from sacformer_jax import Config

TASKS = ("HalfCheetah", "Hopper", "Walker2d", "Ant", "Humanoid")
ENV_STEPS, FIRST_SEED = 100_000, 100
VARIANTS: dict[str, dict[str, Any]] = {
    "sacformer": {"preset": "best", "agent": "sacformer", "seeds": 5},
    "sac": {"preset": "best", "agent": "sac", "seeds": 5},
    "sacformer-cpu": {"preset": "cpu", "agent": "sacformer", "seeds": 5},
    "sac-cpu": {"preset": "cpu", "agent": "sac", "seeds": 5},
    "paper": {"preset": "paper", "agent": "sacformer", "seeds": 3, **LIKE_CPU},
    "authors": {"preset": "authors", "agent": "sacformer", "seeds": 3, **LIKE_CPU},
}


def study() -> Study:
    """All its runs."""
    configs = {
        f"{task}-{variant}": Config.from_preset(
            **settings, env=task, total_env_steps=ENV_STEPS, seed=FIRST_SEED
        )
        for (variant, settings), task in itertools.product(VARIANTS.items(), TASKS)
    }
    return Study("arena", configs, __file__)


if __name__ == "__main__":
    sys.exit(study().main())

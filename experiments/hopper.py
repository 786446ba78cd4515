"""What holds SACFormer back on Hopper: preset `cpu` with one thing changed, 60,000 env steps.

The preset itself is in the study `foundation` (the same runs up to 60,000 env steps).

python experiments/hopper.py --jobs 2
"""

from __future__ import annotations

import itertools
import sys
from typing import Any

from study import Study

from sacformer_jax import Config

ENV_STEPS = 60_000
VARIANTS: dict[str, dict[str, Any]] = {
    "64-windows": {"batch_size": 64},
    "single-steps": {"context_length": 1, "batch_size": 192},
    "no-return": {"return_conditioning": "none"},
    "slower-critic": {"critic_learning_rate": 3e-4},
}
SEEDS = (0, 1)


def study() -> Study:
    """All its runs."""
    configs = {
        f"{variant}-{seed}": Config.from_preset(
            "cpu", env="Hopper", seed=seed, total_env_steps=ENV_STEPS, **changes
        )
        for seed, (variant, changes) in itertools.product(SEEDS, VARIANTS.items())
    }
    return Study("hopper", configs, __file__)


if __name__ == "__main__":
    sys.exit(study().main())

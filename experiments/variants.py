"""Every option of the method by itself: preset `cpu` with smaller networks and one thing changed.

A check that all of them run and learn, on two tasks with two seeds; no verdict on any.

python experiments/variants.py --jobs 2
"""

from __future__ import annotations

import itertools
import sys
from typing import Any

from study import Study

from sacformer_jax import Config

SMALL: dict[str, Any] = {"total_env_steps": 50_000, "actor_width": 32, "critic_width": 128}
VARIANTS: dict[str, dict[str, Any]] = {
    "cpu": {},
    "hindsight": {"return_conditioning": "hindsight", "prefill_env_steps": 8_000},
    "no-return": {"return_conditioning": "none"},
    "auto-target": {"target_return": "auto"},
    "gsa": {"tokens": "gsa"},
    "transformer-critic": {"critic": "transformer", "critic_width": 32, "critic_heads": 2},
    "one-head": {"actor_heads": 1},
    "gelu": {"actor_activation": "gelu"},
    "dropout": {"actor_dropout": 0.1},
    "bfloat16": {"compute_dtype": "bfloat16"},
}
TASKS = ("HalfCheetah", "Hopper")
SEEDS = (0, 1)


def study() -> Study:
    """All its runs."""
    configs = {
        f"{task}-{variant}-{seed}": Config.from_preset(
            "cpu", env=task, seed=seed, **{**SMALL, **changes}
        )
        for seed, task, (variant, changes) in itertools.product(SEEDS, TASKS, VARIANTS.items())
    }
    return Study("variants", configs, __file__)


if __name__ == "__main__":
    sys.exit(study().main())

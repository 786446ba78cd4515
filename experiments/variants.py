"""The options of the paper and the authors' program, each by itself: one thing changed in `cpu`.

Of preset `cpu` with smaller networks; beside it the presets `paper` and `authors` at these sizes.
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
# What `cpu` sets for speed, for the other presets. The prefill is longer, as they replay only whole
# episodes.
LIKE_CPU: dict[str, Any] = {
    "num_envs": 8,
    "prefill_env_steps": 10_000,
    "eval_every": 4_000,
    "buffer_capacity": 200_000,
    "batch_size": 32,
    "updates_per_env_step": 0.5,
    "actor_layers": 2,
}
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
    "acting-episode": {"acting_context": "episode"},
    "scattered": {"window": "scattered", "prefill_env_steps": 8_000},
    "deterministic": {"policy": "deterministic", "tune_alpha": False},
    "paper": {"preset": "paper", **LIKE_CPU},
    "authors": {"preset": "authors", **LIKE_CPU},
}
TASKS = ("HalfCheetah", "Hopper")
SEEDS = (0, 1)


def study() -> Study:
    """All its runs."""
    configs = {
        f"{task}-{variant}-{seed}": Config.from_preset(
            **{"preset": "cpu", "env": task, "seed": seed, **SMALL, **changes}
        )
        for seed, task, (variant, changes) in itertools.product(SEEDS, TASKS, VARIANTS.items())
    }
    return Study("variants", configs, __file__)


if __name__ == "__main__":
    sys.exit(study().main())

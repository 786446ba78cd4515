"""Which parts of the method matter: SACFormer with one thing changed, two tasks, three seeds.

python experiments/ablations.py --jobs 2              # preset cpu, 60,000 env steps
python experiments/ablations.py --scale full          # preset paper, 1 M env steps

`sacformer` is the preset as it is: at scale cpu it is conditioned on the commanded return, acts on
the window and has no dropout; at scale full it is the paper, conditioned on the return that was
obtained, acting on the whole episode, with dropout.
"""

from __future__ import annotations

import itertools
import sys
from typing import Any

from study import Study, main_of_scales

from sacformer_jax import Config

TASKS = ("HalfCheetah", "Hopper")
LENGTH = 6
"""K of both presets on these tasks."""
COMMON: dict[str, dict[str, Any]] = {
    "sacformer": {},
    "no-return": {"return_conditioning": "none"},
    # None of its episodes may be unfinished, so that the first ones must be waited for.
    "scattered": {"window": "scattered"},
    # Two blocks of width 64; as wide as the MLP it would cost several times the time.
    "transformer-critic": {"critic": "transformer", "critic_width": 64, "critic_heads": 2},
    "acting-4K": {"acting_context": "episode", "acting_context_limit": 4 * LENGTH},
}
OF_FINISHED_EPISODES = {"hindsight", "scattered"}
VARIANTS: dict[str, dict[str, dict[str, Any]]] = {
    "cpu": {
        **COMMON,
        "hindsight": {"return_conditioning": "hindsight"},
        "acting-episode": {"acting_context": "episode"},
        "dropout": {"actor_dropout": 0.1},
    },
    "full": {
        **COMMON,
        "commanded": {"return_conditioning": "commanded"},
        "acting-K": {"acting_context": "window"},
        "no-dropout": {"actor_dropout": 0.0},
    },
}
SETTINGS: dict[str, dict[str, Any]] = {
    "cpu": {"preset": "cpu", "total_env_steps": 60_000},
    "full": {"preset": "paper", "total_env_steps": 1_000_000},
}


def study(scale: str) -> Study:
    """All its runs."""
    configs = {}
    for (variant, changes), task in itertools.product(VARIANTS[scale].items(), TASKS):
        if scale == "cpu" and variant in OF_FINISHED_EPISODES:
            # The first episodes of HalfCheetah end after 1,000 steps of each environment.
            changes = {**changes, "prefill_env_steps": 8_000}
        configs[f"{task}-{variant}"] = Config.from_preset(
            **{**SETTINGS[scale], "env": task, "seeds": 3, **changes}
        )
    return Study(f"ablations-{scale}", configs, __file__)


if __name__ == "__main__":
    sys.exit(main_of_scales(study))

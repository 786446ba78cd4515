"""Is SACFormer better than SAC? On seeds that nothing was tuned on.

python experiments/arena.py --jobs 2                   # five tasks, preset `best` of both
python experiments/arena.py --arena hidden --jobs 2    # velocities hidden, preset `memory` of both
python experiments/arena.py --arena delay --jobs 2     # actions two steps late, preset `memory`

100,000 env steps, seeds 100 to 104 in one program, each run on a core of its own. On the five tasks
these spread too far to bound the difference at -0.05; so preset `best` gets seeds 105 to 109, too,
which was written down before any of them was run: all ten are to be read together.
`sacformer-path` is what preset `best` was when the first five were run; what it is now was tuned
on other seeds (improve.py). Beside these both agents with preset `cpu` (SAC as published: single
steps, one-step targets), and presets `paper` and `authors` with the first three seeds, reduced to
what finishes: environments, blocks, number of windows and updates as of `cpu`, but their width of
128, and a prefill of 10,000 steps, not 4,000, as these presets wait for finished episodes.

With preset `memory` SAC sees the last 6 observations with the actions between them, SACFormer the
same in tokens, and neither of them a return-to-go. SAC's one-step targets are there, too: on the
seeds that were tuned on they were ahead of λ-returns with velocities hidden, behind them with
actions delayed. `sacformer-gsa` is what preset `memory` was when velocities were first hidden on
these seeds.
"""

from __future__ import annotations

import itertools
import sys
from typing import Any

import memory
from improve import LAMBDA_PATH
from study import Study, main_of_choices
from variants import LIKE_CPU

from sacformer_jax import Config

FULL = "full"
ENV_STEPS, FIRST_SEED = 100_000, 100
TASKS = ("HalfCheetah", "Hopper", "Walker2d", "Ant", "Humanoid")
VARIANTS: dict[str, dict[str, Any]] = {
    "sacformer": {"preset": "best", "agent": "sacformer", "seeds": 5},
    "sac": {"preset": "best", "agent": "sac", "seeds": 5},
    "sacformer-path": {"preset": "cpu", "agent": "sacformer", "seeds": 5, **LAMBDA_PATH},
    "sacformer-cpu": {"preset": "cpu", "agent": "sacformer", "seeds": 5},
    "sac-cpu": {"preset": "cpu", "agent": "sac", "seeds": 5},
    "paper": {"preset": "paper", "agent": "sacformer", "seeds": 3, **LIKE_CPU},
    "authors": {"preset": "authors", "agent": "sacformer", "seeds": 3, **LIKE_CPU},
}
MEMORY_VARIANTS: dict[str, dict[str, Any]] = {
    "sacformer": {"preset": "memory", "agent": "sacformer", "seeds": 5},
    "sac": {"preset": "memory", "agent": "sac", "seeds": 5},
    "sac-one-step": {"preset": "cpu", **memory.VARIANTS["sac"], "seeds": 5},
}
HIDDEN_VARIANTS: dict[str, dict[str, Any]] = {
    **MEMORY_VARIANTS,
    "sacformer-gsa": {**MEMORY_VARIANTS["sacformer"], "tokens": "gsa", "batch_size": 32},
}
MORE_SEEDS: dict[str, dict[str, Any]] = {
    f"{variant}-from-{FIRST_SEED + 5}": {**VARIANTS[variant], "seed": FIRST_SEED + 5}
    for variant in ("sacformer", "sac")
}
VARIANTS_OF = {FULL: VARIANTS | MORE_SEEDS, "hidden": HIDDEN_VARIANTS, "delay": MEMORY_VARIANTS}


def study(arena: str) -> Study:
    """All its runs."""
    full = arena == FULL
    tasks = TASKS if full else memory.TASKS
    kept_from_the_agent = {} if full else memory.ARENAS[arena]
    configs = {
        f"{task}-{variant}": Config.from_preset(
            env=task,
            total_env_steps=ENV_STEPS,
            **{"seed": FIRST_SEED, **settings},
            **kept_from_the_agent,
        )
        for (variant, settings), task in itertools.product(VARIANTS_OF[arena].items(), tasks)
    }
    return Study("arena" if full else f"arena-{arena}", configs, __file__)


if __name__ == "__main__":
    arenas = (FULL, *memory.ARENAS)
    sys.exit(main_of_choices(study, "arena", arenas, "what is kept from the agents"))

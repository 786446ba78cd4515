"""Figure 3 of the paper: the length K of the context on Humanoid, three seeds.

The paper shows K = 5, 10 and 15; 1, 2 and 20 are here for curiosity. A batch has the same number of
windows at every K, as in the paper, so that a longer one learns from more steps in each update.

python experiments/figure3.py --jobs 2                # preset cpu, 60,000 env steps
python experiments/figure3.py --scale full            # preset paper, 800,000 env steps
"""

from __future__ import annotations

import sys
from typing import Any

from study import Study, main_of_scales

from sacformer_jax import Config

LENGTHS = (5, 10, 15, 1, 2, 20)
SETTINGS: dict[str, dict[str, Any]] = {
    "cpu": {"preset": "cpu", "total_env_steps": 60_000},
    "full": {"preset": "paper", "total_env_steps": 800_000},
}


def study(scale: str) -> Study:
    """All its runs."""
    configs = {}
    for length in LENGTHS:
        fields = {**SETTINGS[scale], "env": "Humanoid", "context_length": length, "seeds": 3}
        if length == 1:
            fields["acting_context"] = "window"  # of one step is all that it ever sees
        configs[f"Humanoid-K={length}"] = Config.from_preset(**fields)
    return Study(f"figure3-{scale}", configs, __file__)


if __name__ == "__main__":
    sys.exit(main_of_scales(study))

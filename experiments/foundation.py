"""SACFormer beside SAC: both with preset `cpu`, 100,000 env steps, 3 tasks, 2 seeds.

    python experiments/foundation.py                 # all runs, one after the other
    python experiments/foundation.py --only Hopper-sac-0

Runs lie in runs/foundation/TASK-AGENT-SEED. A run that is done is skipped and one that was stopped
is resumed, so the script can be stopped and started at will. After each run the table
experiments/results/foundation.csv is written anew: one row an evaluation.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import subprocess
import sys
from pathlib import Path
from typing import Any

from sacformer_jax import Config, resume, train
from sacformer_jax.checkpoint import RunFolder
from sacformer_jax.logging import read_records

ENV_STEPS = 100_000
TASKS = ("HalfCheetah", "Hopper", "Walker2d")
AGENTS = ("sacformer", "sac")
SEEDS = (0, 1)
RUNS = Path("runs/foundation")
TABLE = Path(__file__).parent / "results" / "foundation.csv"


def all_runs() -> dict[str, Config]:
    """Every run's name and configuration."""
    configs = {}
    for seed, task, agent in itertools.product(SEEDS, TASKS, AGENTS):
        name = f"{task}-{agent}-{seed}"
        configs[name] = Config.from_preset(
            "cpu",
            agent=agent,
            env=task,
            seed=seed,
            total_env_steps=ENV_STEPS,
            run_dir=str(RUNS / name),
        )
    return configs


def run(config: Config) -> bool:
    """Starts, resumes or skips a run; whether it is done afterwards."""
    folder = RunFolder(config.run.run_dir)
    done = folder.latest_step()
    if done is not None and done >= ENV_STEPS:
        return True
    result = train(config) if done is None else resume(folder.path)
    return not result.interrupted


def rows(config: Config) -> list[dict[str, Any]]:
    """A run's evaluations as rows of the table."""
    folder = RunFolder(config.run.run_dir)
    seconds, total = {}, 0.0
    for record in read_records(folder.timings_path):
        total += record["chunk_seconds"]
        seconds[record["env_steps"]] = total
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
    ).stdout.strip()
    return [
        {
            "study": "foundation",
            "agent": config.agent,
            "preset": config.preset,
            "env": config.task.env,
            "engine": folder.read_spec().engine,
            "seed": config.seed,
            "env_steps": record["env_steps"],
            "return_mean": round(record["return_mean"], 2),
            "return_std": round(record["return_std"], 2),
            "episodes": record["episodes"],
            "wall_s": round(seconds.get(record["env_steps"], 0.0), 1),
            "commit": commit,
        }
        for record in read_records(folder.metrics_path, "eval")
    ]


def write_table(configs: dict[str, Config]) -> None:
    """Writes the evaluations of all runs that have any; rows of other runs stay."""
    started = [c for c in configs.values() if RunFolder(c.run.run_dir).metrics_path.exists()]
    new = [row for config in started for row in rows(config)]
    replaced = {(row["env"], row["agent"], str(row["seed"])) for row in new}
    kept = []
    if TABLE.exists():
        with TABLE.open(newline="") as file:
            kept = [
                row
                for row in csv.DictReader(file)
                if (row["env"], row["agent"], row["seed"]) not in replaced
            ]
    if not new:
        return
    TABLE.parent.mkdir(exist_ok=True)
    with TABLE.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(new[0]))
        writer.writeheader()
        writer.writerows([*kept, *new])


def main() -> int:
    """Runs what is asked for; 3 when stopped by Ctrl-C."""
    configs = all_runs()
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", choices=list(configs), help="some of the runs")
    chosen = parser.parse_args().only or list(configs)
    for name in chosen:
        done = run(configs[name])
        write_table(configs)
        if not done:
            return 3
    return 0


if __name__ == "__main__":
    sys.exit(main())

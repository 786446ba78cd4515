"""The table of a study: a row for each evaluation of each seed, in ``results/STUDY.csv``.

Needs no JAX; what makes the rows of a run is in study_rows.py.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from csv_files import write_csv
from report.scores import run_scores

COLUMNS = (
    "study", "run", "agent", "preset", "env", "engine", "seed", "env_steps", "return_mean",
    "return_std", "episodes", "wall_s", "commit", "cpu",
    "settings",
)  # fmt: skip

MORE = "+"
"""Between the commits, or processors, of a run that was resumed by, or on, another."""

Row = dict[str, Any]


def read_table(path: Path) -> list[Row]:
    """The rows of a table; none where there is no file."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [
            {
                **row,
                "env_steps": int(row["env_steps"]),
                "return_mean": float(row["return_mean"]),
            }
            for row in csv.DictReader(file)
        ]


def furthest(rows: Iterable[Row]) -> dict[str, int]:
    """Env steps of the last row of each run, by its name."""
    last: dict[str, int] = {}
    for row in rows:
        last[row["run"]] = max(last.get(row["run"], 0), row["env_steps"])
    return last


def write_table(path: Path, new: Mapping[str, Sequence[Row]], order: Sequence[str]) -> list[Row]:
    """Puts the rows of some runs in place of those they had; other runs' rows stay.

    Args:
      path: the table; at no time is it there in part.
      new: rows by name of the run.
      order: names of runs, in the order of the table; others come last.

    Returns:
      all rows of the table.
    """
    kept = [row for row in read_table(path) if row["run"] not in new]
    rows = [*kept, *(row for of_run in new.values() for row in of_run)]
    place = {name: number for number, name in enumerate(order)}
    rows.sort(
        key=lambda row: (place.get(row["run"], len(place)), int(row["seed"]), row["env_steps"])
    )
    if rows:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_csv(path, COLUMNS, rows)
    return rows


def summary(rows: Iterable[Row], runs: Iterable[str]) -> str:
    """A Markdown table of these runs, a line for each seed: return at the end, mean of the last
    five evaluations, best, and seconds of training (of all seeds of the run together).
    """
    lines = [
        "| run | seed | env steps | at the end | last five | best | training, s |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    wanted = set(runs)
    by_seed: dict[tuple[str, int], list[Row]] = {}
    for row in rows:
        by_seed.setdefault((row["run"], int(row["seed"])), []).append(row)
    for (run, seed), own in by_seed.items():
        if run in wanted:
            returns = np.array([row["return_mean"] for row in own])
            lines.append(
                f"| {run} | {seed} | {own[-1]['env_steps']:,} | {returns[-1]:.0f} "
                f"| {run_scores(returns):.0f} | {returns.max():.0f} "
                f"| {f'{float(seconds):,.0f}' if (seconds := own[-1]['wall_s']) else '?'} |"
            )
    return "\n".join(lines)

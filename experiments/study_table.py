"""The table of a study: a row for each evaluation of each seed, in ``results/STUDY.csv``."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sacformer_jax.checkpoint import RunFolder
from sacformer_jax.logging import read_records

COLUMNS = (
    "study", "run", "agent", "preset", "env", "engine", "seed", "env_steps", "return_mean",
    "return_std", "episodes", "wall_s", "commit",
)  # fmt: skip

Row = dict[str, Any]


def rows_of(study: str, run: str, folder: RunFolder, commits: Sequence[str]) -> list[Row]:
    """The evaluations in a run's folder, seed by seed; none if it has not begun.

    Args:
      study: name of the study.
      run: name of the run.
      folder: of the run.
      commits: by which versions of the code it was trained.
    """
    if not folder.timings_path.exists():
        return []
    seconds, total = {}, 0.0
    for record in read_records(folder.timings_path):
        total += record["chunk_seconds"]
        seconds[record["env_steps"]] = total
    file = folder.read_config()
    engine = folder.read_spec().engine
    return [
        {
            "study": study,
            "run": run,
            "agent": file.config.agent,
            "preset": file.config.preset,
            "env": file.config.task.env,
            "engine": engine,
            "seed": member.seed,
            "env_steps": record["env_steps"],
            "return_mean": round(record["return_mean"], 2),
            "return_std": round(record["return_std"], 2),
            "episodes": record["episodes"],
            "wall_s": round(seconds.get(record["env_steps"], 0.0), 1),
            "commit": "+".join(commits) or "unknown",
        }
        for member in file.members
        for record in read_records(folder.metrics_path(member.name), "eval")
    ]


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
                "wall_s": float(row["wall_s"]),
            }
            for row in csv.DictReader(file)
        ]


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
        part = path.with_suffix(".part")
        with part.open("w", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
        part.replace(path)
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
            returns = [row["return_mean"] for row in own]
            last = returns[-5:]
            lines.append(
                f"| {run} | {seed} | {own[-1]['env_steps']:,} | {returns[-1]:.0f} "
                f"| {sum(last) / len(last):.0f} | {max(returns):.0f} | {own[-1]['wall_s']:,.0f} |"
            )
    return "\n".join(lines)

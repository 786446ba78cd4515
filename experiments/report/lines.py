"""A study's table as lines: what one variant did on one task, seed by seed.

Reads results/STUDY.csv and nothing else, and needs no JAX.
"""

from __future__ import annotations

import csv
import dataclasses
import re
from collections import Counter
from collections.abc import Iterable
from functools import cached_property
from pathlib import Path

import numpy as np
from machine import UNKNOWN
from study_table import MORE, Row, read_table

from report.scores import REFERENCE_RETURNS, run_scores, variant_of

FINISHED_SHARE = 0.95
"""A line that ends before this share of the study's longest is in progress. Evaluations of
different agents do not end at the very same step."""
LABELS = {"sacformer": "SACFormer", "sac": "SAC", "td3": "TD3", "ddpg": "DDPG", "ppo": "PPO"}
_REDUCED = {name: f"preset {name} (reduced)" for name in ("paper", "authors")}
"""SACFormer, smaller than these presets make it: see variants.py."""
_NAMES = LABELS | _REDUCED | {"sacformer-path": "SACFormer (earlier)"}
_BASELINES = ("sac", "sac-lambda", "sacformer", "cpu", "K=10")
_NEEDED = {"run", "agent", "env", "engine", "seed", "env_steps", "return_mean", "episodes"}


def label_of(variant: str) -> str:
    """How a variant is written in figures and tables."""
    return _NAMES.get(variant, variant)


@dataclasses.dataclass(frozen=True)
class Program:
    """What a seed was trained in, on which its seconds depend.

    Attributes:
      cpu: the processor and the number of its cores, or all that a resumed run had.
      num_seeds: how many there were in it.
    """

    cpu: str
    num_seeds: int

    @property
    def known(self) -> bool:
        """Whether it is known which seconds are whose."""
        return self.cpu != UNKNOWN and MORE not in self.cpu


@dataclasses.dataclass
class Line:
    """A variant on a task.

    Attributes:
      task: its name.
      variant: its name.
      agent: the algorithm.
      curves: for each seed, the evaluation return by env steps.
      seconds: for each seed, those trained until an evaluation, by env steps; NaN if unknown.
      programs: for each seed, what it was trained in.
    """

    task: str
    variant: str
    agent: str
    curves: dict[int, dict[int, float]] = dataclasses.field(default_factory=dict)
    seconds: dict[int, dict[int, float]] = dataclasses.field(default_factory=dict)
    programs: dict[int, Program] = dataclasses.field(default_factory=dict)

    @property
    def seeds(self) -> list[int]:
        """In ascending order."""
        return sorted(self.curves)

    @cached_property
    def steps(self) -> np.ndarray:
        """Env steps ``[T]`` at which every seed was evaluated, ascending."""
        return np.array(sorted(set.intersection(*map(set, self.curves.values()))), int)

    @cached_property
    def returns(self) -> np.ndarray:
        """Evaluation returns ``[T, S]`` at ``steps``, a column for each seed."""
        return self.returns_at(self.steps)

    def returns_at(self, steps: Iterable[int]) -> np.ndarray:
        """Evaluation returns ``[len(steps), S]`` at some of ``steps``."""
        rows = [[self.curves[seed][int(step)] for seed in self.seeds] for step in steps]
        return np.array(rows, float).reshape(len(rows), len(self.curves))

    @cached_property
    def scores(self) -> np.ndarray:
        """Score ``[S]`` of each seed, by the last steps at which every seed was evaluated."""
        return run_scores(self.returns.T)

    @property
    def first_step(self) -> int:
        """Of the first evaluation of any seed, before it learnt anything."""
        return min(min(curve) for curve in self.curves.values())

    @property
    def last_step(self) -> int:
        """The last of ``steps``; 0 if there is none."""
        return int(self.steps[-1]) if self.steps.size else 0


@dataclasses.dataclass
class StudyLines:
    """All lines of a study.

    Attributes:
      name: of the study.
      lines: by task and variant.
      tasks: in the order of the reference table, others after them.
      variants: in the order of the table, but agents and numbers (NAME=NUMBER) in their own.
      episodes: of an evaluation, every number that occurs.
      engines: likewise.
      presets: likewise.
      added: env steps of runs that add seeds to a line, but not yet as far as it goes. They are
        left out of it.
    """

    name: str
    lines: dict[tuple[str, str], Line]
    tasks: list[str]
    variants: list[str]
    episodes: list[int]
    engines: list[str]
    presets: list[str]
    added: dict[str, int]

    @property
    def last_step(self) -> int:
        """That of the longest line."""
        return max(line.last_step for line in self.lines.values())

    def finished(self, task: str, variant: str) -> bool:
        """Whether there is such a line and it is as long as the study's longest."""
        line = self.lines.get((task, variant))
        return (
            line is not None
            and line.last_step > 0
            and line.last_step >= FINISHED_SHARE * self.last_step
        )

    def finished_tasks(self, variant: str) -> list[str]:
        """Those on which the variant is finished."""
        return [task for task in self.tasks if self.finished(task, variant)]

    def baseline(self) -> str:
        """The variant that others are compared with: SAC where it is among them, else the
        default, else the first.
        """
        return next((name for name in _BASELINES if name in self.variants), self.variants[0])


def is_study_table(path: Path) -> bool:
    """Whether a CSV has the columns of a study's evaluations."""
    with path.open(newline="") as file:
        return set(next(csv.reader(file), [])) >= _NEEDED


def read_study(path: Path) -> StudyLines | None:
    """The lines of ``results/STUDY.csv``; None if it has no rows."""
    rows = read_table(path)
    added = _unfinished_additions(rows)
    rows = [row for row in rows if row["run"] not in added]
    lines: dict[tuple[str, str], Line] = {}
    num_seeds = Counter(run for run, _ in {(row["run"], row["seed"]) for row in rows})
    for row in rows:
        task, variant = row["env"], variant_of(row)
        line = lines.setdefault((task, variant), Line(task, variant, row["agent"]))
        seed = int(row["seed"])
        curve = line.curves.setdefault(seed, {})
        curve[row["env_steps"]] = row["return_mean"]
        line.programs[seed] = Program(row.get("cpu") or UNKNOWN, num_seeds[row["run"]])
        seconds = line.seconds.setdefault(seed, {})
        seconds[row["env_steps"]] = float(row.get("wall_s") or "nan")
    if not lines:
        return None
    known = list(REFERENCE_RETURNS)
    tasks = list(dict.fromkeys(task for task, _ in lines))
    return StudyLines(
        name=path.stem,
        lines=lines,
        tasks=sorted(tasks, key=lambda task: known.index(task) if task in known else len(known)),
        variants=_ordered(list(dict.fromkeys(variant for _, variant in lines))),
        episodes=sorted({int(row["episodes"]) for row in rows}),
        engines=sorted({row["engine"] for row in rows}),
        presets=sorted({row.get("preset") or UNKNOWN for row in rows}),
        added=added,
    )


def _unfinished_additions(rows: Iterable[Row]) -> dict[str, int]:
    """Runs whose seeds belong to a line that another run has taken further, and how far they are.

    A line goes as far as all its seeds: seeds that are being added would cut it short.
    """
    lines: dict[tuple[str, str], dict[str, dict[str, int]]] = {}
    for row in rows:
        runs = lines.setdefault((row["env"], variant_of(row)), {})
        last = runs.setdefault(row["run"], {})
        last[row["seed"]] = max(last.get(row["seed"], 0), row["env_steps"])
    added: dict[str, int] = {}
    for runs in lines.values():
        done = {run: min(last.values()) for run, last in runs.items()}
        furthest = max(done.values())
        added |= {run: steps for run, steps in done.items() if steps < FINISHED_SHARE * furthest}
    return added


def _ordered(variants: list[str]) -> list[str]:
    """By number where all are NAME=NUMBER, agents as in ``LABELS``, else as they are."""
    if set(variants) <= LABELS.keys():
        return [agent for agent in LABELS if agent in variants]
    found = [re.fullmatch(r"[^=]+=(\d+(?:\.\d+)?)", variant) for variant in variants]
    numbers = {match.string: float(match.group(1)) for match in found if match}
    return sorted(variants, key=numbers.__getitem__) if len(numbers) == len(variants) else variants


def grouped(numbers: Iterable[int]) -> str:
    """Numbers as a caption gives them: ``3``, or ``2 to 3`` where they differ."""
    low, high = min(values := list(numbers)), max(values)
    return f"{low:,}" if low == high else f"{low:,} to {high:,}"

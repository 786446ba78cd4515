"""What variants come to in the time that the baseline takes for all of its env steps.

Seconds are those of training, all seeds of a run together, without compilation and evaluations:
they say something where runs had the same share of the same machine, as in the studies named here.
An env step takes a run's median over the stretches between its evaluations, all of them the same
work: a run that was held up for a while is no slower for it.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from report.lines import Line, StudyLines
from report.scores import (
    Estimate,
    can_normalize,
    iqm_difference,
    normalized,
    probability_of_improvement,
    run_scores,
)

TIMED = {"arena", "arena-hidden", "arena-delay"}
"""Studies whose runs had a core each."""


@dataclasses.dataclass(frozen=True)
class Timed:
    """A variant beside the baseline, both for the baseline's time.

    Attributes:
      variant: its name.
      slowdown: its seconds over the baseline's for the same env steps, geometric mean over tasks.
      difference: of the interquartile mean of normalized scores, less the baseline's.
      improvement: probability of, over the baseline.
      tasks: those that both have finished, with as many seeds and a scale.
    """

    variant: str
    slowdown: float
    difference: Estimate
    improvement: Estimate
    tasks: list[str]


def timed(study: StudyLines, baseline: str) -> list[Timed]:
    """Of every variant that has a task to be compared on, in their order."""
    made = []
    for variant in study.variants:
        tasks, slowdowns, of, over = [], [], [], []
        for task in study.finished_tasks(variant):
            if variant == baseline or not (can_normalize(task) and study.finished(task, baseline)):
                continue
            own, base = study.lines[task, variant], study.lines[task, baseline]
            # All seeds of a run are one program: of other numbers of seeds, times say nothing.
            if len(own.seeds) != len(base.seeds):
                continue
            slowdown = step_seconds(own) / step_seconds(base)
            tasks.append(task)
            slowdowns.append(slowdown)
            of.append(normalized(task, scores_until(own, _steps_for(base, slowdown))))
            over.append(normalized(task, base.scores))
        if tasks:
            mean_slowdown = float(np.exp(np.mean(np.log(slowdowns))))
            difference = iqm_difference(of, over)
            improvement = probability_of_improvement(of, over)
            made.append(Timed(variant, mean_slowdown, difference, improvement, tasks))
    return made


def step_seconds(line: Line) -> float:
    """What an env step of all seeds takes a line; NaN with fewer than two evaluations."""
    of_stretches: list[float] = []
    for of_seed in line.seconds.values():
        steps = np.array(sorted(of_seed), float)
        if steps.size > 1:
            of_stretches.extend(np.diff([of_seed[int(step)] for step in steps]) / np.diff(steps))
    return float(np.median(of_stretches)) if of_stretches else math.nan


def scores_until(line: Line, limit: float) -> np.ndarray:
    """Score ``[S]`` of each seed from its evaluations in the first ``limit`` env steps.

    The first evaluation, before anything was learnt, is always among them.
    """
    within = line.steps[line.steps <= max(limit, line.steps[0])]
    return run_scores(line.returns_at(within).T)


def _steps_for(base: Line, slowdown: float) -> float:
    """Env steps in the baseline's time. Those to the first evaluation are random, and free."""
    first = float(base.steps[0])
    return first + (base.last_step - first) / slowdown

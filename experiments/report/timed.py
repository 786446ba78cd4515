"""What variants come to in the time that the baseline takes for all of its env steps.

Seconds are those of training, all seeds of a run together, without compilation and evaluations:
they say something where runs had the same share of the same machine, as in the studies named here.
So they are compared among runs of as many seeds on as many cores of the same processor alone (which
need not be the same machine, nor a machine with nothing else to do). The stretches between
evaluations are all the same work, and what else a machine does only adds to it: an env step is
taken to cost what it did in the fastest tenth of them, so that a run that was held up, even for
most of the time, is no slower for it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from report.lines import Line, Program, StudyLines
from report.scores import (
    Estimate,
    can_normalize,
    iqm_difference,
    normalized,
    probability_of_improvement,
    run_scores,
)

TIMED = {"arena", "arena-hidden", "arena-delay", "improve-100k"}
"""Studies whose runs had a core each."""
_FASTEST = 0.1
"""The quantile of the stretches that stands for all."""


@dataclasses.dataclass(frozen=True)
class Timed:
    """A variant beside the baseline, both for the baseline's time.

    Attributes:
      variant: its name.
      slowdown: its seconds over the baseline's for the same env steps, geometric mean over tasks.
      difference: of the interquartile mean of normalized scores, less the baseline's.
      improvement: probability of, over the baseline.
      tasks: those that both have finished and that have a scale, where times can be compared.
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
            slowdown = _slowdown(own, base)
            if slowdown is None:
                continue
            tasks.append(task)
            slowdowns.append(slowdown)
            of.append(normalized(task, scores_until(own, _steps_for(own, base, slowdown))))
            over.append(normalized(task, base.scores))
        if tasks:
            difference = iqm_difference(of, over)
            improvement = probability_of_improvement(of, over)
            made.append(Timed(variant, _mean_ratio(slowdowns), difference, improvement, tasks))
    return made


def step_seconds(line: Line, program: Program) -> float:
    """What an env step of all seeds takes a line in such a program; NaN where no two evaluations
    tell.
    """
    of_stretches: list[float] = []
    for seed, of_seed in line.seconds.items():
        steps = np.array(sorted(of_seed), float)
        if line.programs[seed] == program and steps.size > 1:
            of_stretches.extend(np.diff([of_seed[int(step)] for step in steps]) / np.diff(steps))
    # Seconds are unknown, or begin anew, where a resumed run's records were lost.
    whole = [seconds for seconds in of_stretches if seconds > 0]
    return float(np.quantile(whole, _FASTEST)) if whole else math.nan


def _slowdown(own: Line, base: Line) -> float | None:
    """Seconds of a line over those of another, mean over the programs they share; None without."""
    shared = sorted({*own.programs.values()} & {*base.programs.values()}, key=repr)
    ratios = [step_seconds(own, each) / step_seconds(base, each) for each in shared if each.known]
    finite = [ratio for ratio in ratios if math.isfinite(ratio)]
    return _mean_ratio(finite) if finite else None


def _mean_ratio(ratios: Sequence[float]) -> float:
    """Their geometric mean."""
    return float(np.exp(np.mean(np.log(ratios))))


def scores_until(line: Line, limit: float) -> np.ndarray:
    """Score ``[S]`` of each seed from its evaluations in the first ``limit`` env steps.

    The first evaluation, before anything was learnt, is always among them.
    """
    within = line.steps[line.steps <= max(limit, line.steps[0])]
    return run_scores(line.returns_at(within).T)


def _steps_for(own: Line, base: Line, slowdown: float) -> float:
    """Env steps in the baseline's time. Those to the first evaluation are random, and free."""
    return own.first_step + (base.last_step - base.first_step) / slowdown

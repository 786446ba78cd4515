"""What variants come to in the time that the baseline takes for all of its env steps.

Seconds are those of training, all seeds of a run together, without compilation and evaluations:
they say something where runs had the same share of the same machine, as in the studies named here.
"""

from __future__ import annotations

import dataclasses

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
            limit = total_seconds(base)
            tasks.append(task)
            slowdowns.append(total_seconds(own) / limit)
            of.append(normalized(task, scores_within(own, limit)))
            over.append(normalized(task, base.scores))
        if tasks:
            slowdown = float(np.exp(np.mean(np.log(slowdowns))))
            difference = iqm_difference(of, over)
            improvement = probability_of_improvement(of, over)
            made.append(Timed(variant, slowdown, difference, improvement, tasks))
    return made


def total_seconds(line: Line) -> float:
    """Of a line's longest seed, or of all of them where they are one program."""
    return max(max(of_seed.values()) for of_seed in line.seconds.values())


def scores_within(line: Line, limit: float) -> np.ndarray:
    """Score ``[S]`` of each seed from the evaluations it had after ``limit`` seconds of training.

    The first evaluation, before anything was learnt, is always among them.
    """
    scores = []
    for seed in line.seeds:
        steps = sorted(step for step, at in line.seconds[seed].items() if at <= limit)
        scores.append(run_scores(np.array([line.curves[seed][step] for step in steps])))
    return np.array(scores, float)

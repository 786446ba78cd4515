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

TIMED = {"arena"}
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
        tasks = [
            task
            for task in study.finished_tasks(variant)
            if can_normalize(task) and study.finished(task, baseline)
        ]
        pairs = {task: (study.lines[task, variant], study.lines[task, baseline]) for task in tasks}
        # All seeds of a run are one program: of other numbers of seeds, times say nothing.
        pairs = {task: (a, b) for task, (a, b) in pairs.items() if len(a.seeds) == len(b.seeds)}
        if variant == baseline or not pairs:
            continue
        limits = {task: total_seconds(base) for task, (_, base) in pairs.items()}
        slowdowns = [total_seconds(own) / limits[task] for task, (own, _) in pairs.items()]
        of = [
            normalized(task, scores_within(own, limits[task])) for task, (own, _) in pairs.items()
        ]
        over = [normalized(task, base.scores) for task, (_, base) in pairs.items()]
        made.append(
            Timed(
                variant,
                float(np.exp(np.mean(np.log(slowdowns)))),
                iqm_difference(of, over),
                probability_of_improvement(of, over),
                list(pairs),
            )
        )
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

"""What variants come to over the tasks of several studies together: results/NAME.md."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from report.lines import StudyLines, label_of
from report.scores import (
    REFERENCE_SOURCE,
    Estimate,
    iqm_difference,
    iqm_estimate,
    normalized,
    probability_of_improvement,
)
from report.tables import bracketed, rated_tasks, table


def can_compare(study: StudyLines, baseline: str) -> bool:
    """Whether it has finished the baseline on all its tasks, and these have normalized scores."""
    return rated_tasks(study) == study.tasks == study.finished_tasks(baseline)


def together_markdown(name: str, studies: Sequence[StudyLines], baseline: str) -> str:
    """The text of ``NAME.md``: every variant that all studies have finished on all their tasks.

    Args:
      name: of the text.
      studies: their tasks count as different ones, each the same.
      baseline: the variant that others are compared with; see :func:`can_compare`.
    """
    variants = [
        variant
        for variant in studies[0].variants
        if all(study.finished_tasks(variant) == study.tasks for study in studies)
    ]

    def scores(variant: str) -> list[np.ndarray]:
        lines = [study.lines[task, variant] for study in studies for task in study.tasks]
        return [normalized(line.task, line.scores) for line in lines]

    rows = []
    for variant in variants:
        compared: list[Estimate | None] = [None, None]
        if variant != baseline:
            compared = [
                iqm_difference(scores(variant), scores(baseline)),
                probability_of_improvement(scores(variant), scores(baseline)),
            ]
        iqm = iqm_estimate(scores(variant))
        rows.append([label_of(variant), *(bracketed(one) for one in (iqm, *compared))])
    names = [study.name for study in studies]
    tasks = "; ".join(f"{study.name}: {', '.join(study.tasks)}" for study in studies)
    other = label_of(baseline)
    head = ["", "interquartile mean", f"less {other}'s", f"P(better than {other})"]
    return (
        f"# {name}\n\n"
        f"Made by `python experiments/figures.py {names[0]}` from the tables of these studies: "
        f"{', '.join(names)}.\n\n"
        f"Interquartile mean of normalized scores over all runs of all tasks ({tasks}): 0 is "
        f"random actions, 1 is {REFERENCE_SOURCE}. Its difference from {other}'s, and the "
        f"probability that a run is better than one of {other}, mean over tasks. In brackets 95 % "
        "stratified bootstrap intervals (arXiv 2108.13264).\n\n"
        f"{table(head, rows)}\n"
    )

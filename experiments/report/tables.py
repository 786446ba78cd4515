"""The tables of a study: results/STUDY.md to read and results/STUDY-scores.csv to go on from.

The CSV has a line for each number: ``study, task, variant, statistic, seed, value, low, high``.
``task`` is empty for statistics over all tasks, and names those they are of (``Hopper+Ant``) where
that is not all, ``seed`` is empty but for single runs, ``low`` and ``high`` where there is no 95 %
interval. Statistics: ``score`` of a run, ``mean`` and ``std`` over the seeds, ``env_steps`` at the
end, ``iqm`` of normalized scores, ``difference`` (of it, less the baseline's), ``improvement``
(probability of, over the baseline), ``ratio_to_cleanrl`` (study baselines).
"""

from __future__ import annotations

import csv
import dataclasses
import io
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from report.lines import Line, StudyLines, grouped, label_of
from report.published import ABOUT, PUBLISHED, ratio_to_cleanrl
from report.scores import (
    LAST_EVALUATIONS,
    REFERENCE_SOURCE,
    Estimate,
    can_normalize,
    iqm_difference,
    iqm_estimate,
    normalized,
    probability_of_improvement,
)
from report.timed import TIMED, Timed, timed

COMPARED_WITH_PUBLISHED = {"baselines"}
"""Studies whose agents are set beside published returns."""


@dataclasses.dataclass(frozen=True)
class Aggregate:
    """What a variant comes to over all tasks.

    Attributes:
      variant: its name.
      iqm: of normalized scores; None where a task of the study is not finished.
      difference: of the interquartile mean, less the baseline's; None for the baseline itself, and
        where the two have no finished task with normalized scores in common.
      improvement: probability of, over the baseline; likewise, of any task.
      tasks: those that the two have in common.
    """

    variant: str
    iqm: Estimate | None
    difference: Estimate | None
    improvement: Estimate | None
    tasks: list[str]


def aggregates(study: StudyLines, baseline: str) -> list[Aggregate]:
    """Of every variant, in their order."""
    rated = rated_tasks(study)

    def normalized_scores(variant: str, tasks: Sequence[str]) -> list[np.ndarray]:
        return [normalized(task, study.lines[task, variant].scores) for task in tasks]

    made = []
    for variant in study.variants:
        finished = study.finished_tasks(variant)
        iqm = difference = improvement = None
        if rated and set(rated) <= set(finished):
            iqm = iqm_estimate(normalized_scores(variant, rated))
        common = [task for task in finished if study.finished(task, baseline)]
        comparable = [task for task in common if task in rated]
        if variant != baseline and comparable:
            difference = iqm_difference(
                normalized_scores(variant, comparable), normalized_scores(baseline, comparable)
            )
        if variant != baseline and common:
            improvement = probability_of_improvement(
                [study.lines[task, variant].scores for task in common],
                [study.lines[task, baseline].scores for task in common],
            )
        made.append(Aggregate(variant, iqm, difference, improvement, common))
    return made


def rated_tasks(study: StudyLines) -> list[str]:
    """The tasks with normalized scores."""
    return [task for task in study.tasks if can_normalize(task)]


def _std(line: Line) -> float:
    """Sample standard deviation over the seeds; NaN of a single one."""
    return float(line.scores.std(ddof=1)) if line.scores.size > 1 else math.nan


# --- CSV -------------------------------------------------------------------------------------


def scores_csv(study: StudyLines, made: Sequence[Aggregate]) -> str:
    """The text of ``STUDY-scores.csv``; columns and statistics as above."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("study", "task", "variant", "statistic", "seed", "value", "low", "high"))
    writer.writerows((study.name, *row) for row in _csv_rows(study, made))
    return text.getvalue()


def _csv_rows(study: StudyLines, made: Sequence[Aggregate]) -> Iterator[tuple[Any, ...]]:
    for (task, variant), line in _in_order(study):
        for seed, score in zip(line.seeds, line.scores, strict=True):
            yield task, variant, "score", seed, _digits(score, 2), "", ""
        yield task, variant, "mean", "", _digits(line.scores.mean(), 2), "", ""
        yield task, variant, "std", "", _digits(_std(line), 2), "", ""
        yield task, variant, "env_steps", "", line.last_step, "", ""
        ratio = ratio_to_cleanrl(line.task, line.agent, float(line.scores.mean()))
        if study.name in COMPARED_WITH_PUBLISHED and ratio is not None:
            yield task, variant, "ratio_to_cleanrl", "", _digits(ratio, 4), "", ""
    for one in made:
        for name, estimate in (
            ("iqm", one.iqm),
            ("difference", one.difference),
            ("improvement", one.improvement),
        ):
            if estimate is not None:
                numbers = (estimate.value, estimate.low, estimate.high)
                of = [] if name == "iqm" else _only(study, one, rated=name == "difference")
                yield (
                    "+".join(of),
                    one.variant,
                    name,
                    "",
                    *(_digits(number, 4) for number in numbers),
                )


def _digits(value: float, digits: int) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}f}"


def _in_order(study: StudyLines) -> list[tuple[tuple[str, str], Line]]:
    keys = [(task, variant) for task in study.tasks for variant in study.variants]
    return [(key, study.lines[key]) for key in keys if key in study.lines]


# --- Markdown --------------------------------------------------------------------------------


def markdown(study: StudyLines, made: Sequence[Aggregate], baseline: str) -> str:
    """The text of ``STUDY.md``."""
    parts = [
        f"# Study {study.name}",
        f"Made of `{study.name}.csv` by `python experiments/figures.py {study.name}`: "
        f"{facts(study)}.",
        "## Scores",
        f"The score of a run is the mean of its last {LAST_EVALUATIONS} evaluations. "
        "Mean ± sample standard deviation over the seeds, then each seed's in ascending order.",
        _scores_table(study),
        *_unfinished(study),
        "## Over all tasks",
        _about_aggregates(study, baseline),
        _aggregates_table(study, made, baseline),
    ]
    if study.name in TIMED:
        parts += [
            "## At equal wall-clock",
            "The same two, with every run stopped after the seconds of training in which "
            f"{label_of(baseline)} makes all its env steps on the task. Only tasks count "
            "where both have runs of as many seeds on as many cores of the same processor.",
            _timed_table(study, baseline),
        ]
    if study.name in COMPARED_WITH_PUBLISHED:
        parts += [
            "## Beside published returns",
            "Mean score here beside returns at 1 M env steps that others published for earlier "
            f"versions of the tasks. {ABOUT}",
            _published_table(study),
        ]
    return "\n\n".join(parts) + "\n"


def facts(study: StudyLines) -> str:
    """Seeds, env steps, episodes, engine and preset, as the table has them."""
    lines = study.lines.values()
    seeds = grouped(len(line.seeds) for line in lines)
    ends = grouped(
        line.last_step for line in lines if study.finished(line.task, line.variant)
    )  # of lines in progress it is told apart
    engines = f"engine{'s' if len(study.engines) > 1 else ''} {', '.join(study.engines)}"
    presets = f"preset{'s' if len(study.presets) > 1 else ''} {', '.join(study.presets)}"
    return (
        f"{seeds} seed{'s' if seeds != '1' else ''}, {ends} env steps, "
        f"{grouped(study.episodes)} episodes an evaluation, {engines}, {presets}"
    )


def unfinished(study: StudyLines) -> list[str]:
    """Lines in progress or not begun: ``SAC on Ant (40,000 env steps)``."""
    return not_begun(study) + in_progress(study)


def not_begun(study: StudyLines) -> list[str]:
    """Tasks that a variant has no line of: ``SAC on Hopper, Ant (not begun)``."""
    told = []
    for variant in study.variants:
        tasks = [task for task in study.tasks if (task, variant) not in study.lines]
        if tasks:
            told.append(f"{label_of(variant)} on {', '.join(tasks)} (not begun)")
    return told


def in_progress(study: StudyLines) -> list[str]:
    """Lines that are shorter than the study's, and runs that are to add seeds to one:
    ``SAC on Ant (40,000 env steps)``, ``run Ant-sac-from-5 (8,000 env steps)``.
    """
    return [
        f"{label_of(variant)} on {task} ({study.lines[task, variant].last_step:,} env steps)"
        for variant in study.variants
        for task in study.tasks
        if (task, variant) in study.lines and not study.finished(task, variant)
    ] + [f"run {run} ({steps:,} env steps)" for run, steps in study.added.items()]


def _unfinished(study: StudyLines) -> list[str]:
    told = unfinished(study)
    return [f"† Not finished: {'; '.join(told)}. Left out below."] if told else []


def _scores_table(study: StudyLines) -> str:
    def cell(task: str, variant: str) -> str:
        line = study.lines.get((task, variant))
        if line is None or not line.steps.size:
            return "– †"
        spread = _std(line)
        mean = f"{line.scores.mean():,.0f}" + ("" if math.isnan(spread) else f" ± {spread:,.0f}")
        each = " / ".join(f"{score:,.0f}" for score in line.scores)
        mark = "" if study.finished(task, variant) else " †"
        return f"{mean} ({each}){mark}"

    rows = [
        [label_of(variant), *(cell(task, variant) for task in study.tasks)]
        for variant in study.variants
    ]
    return table(["", *study.tasks], rows)


def _about_aggregates(study: StudyLines, baseline: str) -> str:
    rated = rated_tasks(study)
    text = (
        f"Interquartile mean of normalized scores over all runs of {', '.join(rated)}: 0 is random "
        f"actions, 1 is {REFERENCE_SOURCE}. "
        if rated
        else ""
    )
    return (
        f"{text}Its difference from that of {label_of(baseline)}, on the tasks that both have "
        f"finished. Probability that a run is better than one of {label_of(baseline)}, mean over "
        "tasks. In brackets 95 % stratified bootstrap intervals (arXiv 2108.13264): none of single "
        "seeds, rough of few."
    )


def _aggregates_table(study: StudyLines, made: Sequence[Aggregate], baseline: str) -> str:
    rows = []
    for one in made:
        rows.append([label_of(one.variant), bracketed(one.iqm), *_compared(study, one)])
    name = label_of(baseline)
    return table(["", "interquartile mean", f"less {name}'s", f"P(better than {name})"], rows)


def _timed_table(study: StudyLines, baseline: str) -> str:
    rows = []
    for one in timed(study, baseline):
        rows.append([label_of(one.variant), f"{one.slowdown:.2f}", *_compared(study, one)])
    if not rows:
        return "Nothing to compare yet."
    name = label_of(baseline)
    head = ["", f"seconds, {name}'s = 1", f"interquartile mean less {name}'s"]
    return table([*head, f"P(better than {name})"], rows)


def _compared(study: StudyLines, one: Aggregate | Timed) -> tuple[str, str]:
    """Difference from the baseline, and probability of improvement, with the tasks these are of."""

    def cell(estimate: Estimate | None, rated: bool) -> str:
        only = _only(study, one, rated) if estimate is not None else []
        return bracketed(estimate) + (f" on {', '.join(only)} only" if only else "")

    return cell(one.difference, rated=True), cell(one.improvement, rated=False)


def _only(study: StudyLines, one: Aggregate | Timed, rated: bool) -> list[str]:
    """The tasks that a comparison is of, where that is not all (that have normalized scores)."""
    all_of_them = rated_tasks(study) if rated else study.tasks
    tasks = [task for task in one.tasks if task in all_of_them]
    return [] if tasks == all_of_them else tasks


def bracketed(estimate: Estimate | None) -> str:
    """``0.11 [0.01, 0.21]``; a dash for none."""
    if estimate is None:
        return "–"
    if math.isnan(estimate.low):
        return f"{estimate.value:z.2f}"
    return f"{estimate.value:z.2f} [{estimate.low:z.2f}, {estimate.high:z.2f}]"


def _published_table(study: StudyLines) -> str:
    rows = []
    for (task, variant), line in _in_order(study):
        published = [of.get(line.agent, {}).get(task) for of in PUBLISHED.values()]
        ratio = ratio_to_cleanrl(line.task, line.agent, float(line.scores.mean()))
        rows.append([
            task, label_of(variant), f"{line.scores.mean():,.0f}",
            "–" if ratio is None else f"{ratio:.2f}",
            *("–" if value is None else f"{value:,.0f}" for value in published),
            f"{line.last_step:,}",
        ])  # fmt: skip
    head = ["task", "agent", "here", "here / CleanRL", *PUBLISHED, "env steps here"]
    return table(head, rows)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)

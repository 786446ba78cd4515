"""Learning curves of a study: all variants in a panel for each task, or one row for each variant.

Nothing is smoothed. A line goes as far as all its seeds were evaluated.
"""

from __future__ import annotations

import dataclasses
import textwrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from report.lines import Line, StudyLines, label_of
from report.page import make_page, tidy
from report.scores import REFERENCE_SOURCE, Estimate, iqm_estimate, mean_estimate, normalized
from report.styles import AGENTS, Style, styles_of
from report.tables import facts, in_progress, not_begun, rated_tasks, unfinished

SEEDS_FOR_INTERVAL = 5
"""Seeds from which on a band is a bootstrap interval; of fewer it is their range."""
_RESAMPLES = 2_000
_MARKERS = 6
"""On each line."""
_MARKER_SIZE = 4.2
_MILLION = 1_000_000
_GREY = Style("#8c8c8c", (2.4, 1.2), "")
_BLACK = AGENTS["sacformer"]
_PANEL_HEIGHT, _ONLY_PANEL_HEIGHT = 1.9, 2.8
_ROW_HEIGHT, _ROWS_HEIGHT = 0.85, 8.6
"""Of a variant's row, at most, and of all rows of a page, at most."""
_AVERAGE = "IQM over tasks"
_LABEL_CHARACTERS = 16
"""Of a variant's name in a line beside its panels."""
_MOST_WORDY = 4
"""Columns up to which there is room for more than the task's name above each."""


@dataclasses.dataclass(frozen=True)
class _Curve:
    """A line with its band, by env steps ``[T]``."""

    steps: np.ndarray
    estimate: Estimate


def task_curve(line: Line) -> _Curve:
    """Mean over seeds; band from lowest to highest seed, or the mean's 95 % bootstrap interval."""
    returns = line.returns
    if len(line.seeds) >= SEEDS_FOR_INTERVAL and line.steps.size:
        return _Curve(line.steps, mean_estimate([returns], _RESAMPLES))
    mean = returns.mean(axis=-1)
    return _Curve(line.steps, Estimate(mean, returns.min(axis=-1), returns.max(axis=-1)))


def average_curve(study: StudyLines, variant: str) -> _Curve | None:
    """Interquartile mean of normalized returns over all runs of all tasks, where all of them were
    evaluated, with its stratified bootstrap interval; None where a task is not begun or there is no
    such step.
    """
    lines = [study.lines.get((task, variant)) for task in rated_tasks(study)]
    begun = [line for line in lines if line is not None]
    if not begun or len(begun) < len(lines):
        return None
    steps = sorted(set.intersection(*({int(step) for step in line.steps} for line in begun)))
    if not steps:
        return None
    by_task = [normalized(line.task, line.returns_at(steps)) for line in begun]
    return _Curve(np.array(steps), iqm_estimate(by_task, _RESAMPLES))


def panels_figure(study: StudyLines) -> Figure:
    """A panel for each task with all its lines, and one of their average where there are several
    tasks; for six variants at most.
    """
    styles = styles_of(study.variants)
    averages = _averages(study)
    titles = [*study.tasks, *([_AVERAGE] if averages else [])]
    columns = len(titles) if len(titles) < 4 else -(-len(titles) // 2)
    rows = -(-len(titles) // columns)
    page = make_page(
        rows, columns, _PANEL_HEIGHT if len(titles) > 1 else _ONLY_PANEL_HEIGHT,
        _caption(study, averages), [_handle(styles[name], name) for name in study.variants],
    )  # fmt: skip
    panels = [axes for row in page.axes for axes in row]
    first = [row[0] for row in page.axes]
    for axes in panels[len(titles) :]:
        axes.remove()
    for axes, title in zip(panels, titles, strict=False):
        for place, variant in enumerate(study.variants):
            curve = _find(study, averages, title, variant)
            if curve is not None:
                shift = place / len(study.variants)
                _plot(axes, curve, styles[variant], study, label_of(variant), shift)
        axes.set(title=title, xlabel=_steps_label(study))
        if axes in first or title == _AVERAGE:
            axes.set_ylabel(_value_label(title))
        _finish(axes, study)
    return page.figure


def grid_figure(study: StudyLines, baseline: str) -> Figure:
    """A row for each variant, a column for each task and the average; grey: the baseline."""
    averages = _averages(study)
    titles = [*study.tasks, *([_AVERAGE] if averages else [])]
    variants = [variant for variant in study.variants if variant != baseline]
    handles = [
        Line2D(
            [],
            [],
            label="the variant named at the left",
            **_BLACK.plot_arguments(),
            ms=_MARKER_SIZE,
        ),
        Line2D([], [], label=label_of(baseline), **_GREY.plot_arguments()),
    ]
    page = make_page(
        len(variants), len(titles), min(_ROW_HEIGHT, _ROWS_HEIGHT / len(variants)),
        _caption(study, averages, in_panels=True), handles,
        sharex="all", sharey="col",
    )  # fmt: skip
    crowded = len(titles) > _MOST_WORDY
    for row, variant in zip(page.axes, variants, strict=True):
        for axes, title in zip(row, titles, strict=True):
            for name, style in ((baseline, _GREY), (variant, _BLACK)):
                curve = _find(study, averages, title, name)
                if curve is not None:
                    _plot(axes, curve, style, study, label_of(name), band=name == variant)
            _finish(axes, study)
            axes.yaxis.set_major_locator(MaxNLocator(3))
        name = "\n".join(textwrap.wrap(label_of(variant), _LABEL_CHARACTERS))
        row[0].set_ylabel(name, rotation=0, ha="right", va="center", fontweight="bold")
    for axes, title in zip(page.axes[0], titles, strict=True):
        if crowded:
            axes.set_title(title.removesuffix(" over tasks"))
        else:
            axes.set_title(title if title == _AVERAGE else f"{title}, return")
    last = page.axes[-1]
    for axes in [last[len(last) // 2]] if crowded else last:
        axes.set_xlabel(_steps_label(study))
    return page.figure


def _averages(study: StudyLines) -> dict[str, _Curve]:
    """By variant; none where there is only one task."""
    if len(rated_tasks(study)) < 2:
        return {}
    curves = {variant: average_curve(study, variant) for variant in study.variants}
    return {variant: curve for variant, curve in curves.items() if curve is not None}


def _find(
    study: StudyLines, averages: dict[str, _Curve], title: str, variant: str
) -> _Curve | None:
    if title == _AVERAGE:
        return averages.get(variant)
    line = study.lines.get((title, variant))
    return None if line is None or not line.steps.size else task_curve(line)


def _plot(
    axes: Axes, curve: _Curve, style: Style, study: StudyLines, label: str,
    shift: float = 0.5, band: bool = True,
) -> None:  # fmt: skip
    steps = curve.steps / _unit(study)
    every = max(1, round(len(steps) / _MARKERS))
    arguments: dict[str, Any] = style.plot_arguments()
    axes.plot(
        steps, curve.estimate.value, **arguments, label=label, linewidth=1.2,
        markersize=_MARKER_SIZE, markeredgewidth=0,
        markevery=(min(int(shift * every), len(steps) - 1), every),
    )  # fmt: skip
    if band:
        axes.fill_between(
            steps, curve.estimate.low, curve.estimate.high, color=style.color, alpha=0.15,
            linewidth=0,
        )  # fmt: skip


def _finish(axes: Axes, study: StudyLines) -> None:
    tidy(axes)
    axes.set_xlim(0, 1.02 * study.last_step / _unit(study))


def _handle(style: Style, variant: str) -> Line2D:
    return Line2D(
        [], [], label=label_of(variant), linewidth=1.2, markersize=_MARKER_SIZE, markeredgewidth=0,
        **style.plot_arguments(),
    )  # fmt: skip


def _unit(study: StudyLines) -> int:
    return _MILLION if study.last_step >= _MILLION else 1_000


def _steps_label(study: StudyLines) -> str:
    return f"env steps ({'millions' if _unit(study) == _MILLION else 'thousands'})"


def _value_label(title: str) -> str:
    return "normalized score" if title == _AVERAGE else "evaluation return"


def _caption(study: StudyLines, averages: dict[str, _Curve], in_panels: bool = False) -> str:
    """``in_panels``: every line has a panel, which is empty where it has not begun."""
    text = f"Study {study.name}: {facts(study)}. Lines: mean over seeds, not smoothed."
    seeds = {len(line.seeds) for line in study.lines.values()}
    few = any(1 < number < SEEDS_FOR_INTERVAL for number in seeds)
    if any(number >= SEEDS_FOR_INTERVAL for number in seeds):
        text += " Bands: 95 % bootstrap interval of the mean"
        text += f", of fewer than {SEEDS_FOR_INTERVAL} seeds lowest to highest." if few else "."
    elif few:
        text += " Bands: lowest to highest seed."
    if averages:
        text += (
            f" {_AVERAGE}: interquartile mean of normalized scores of all runs "
            f"(0 random actions, 1 {REFERENCE_SOURCE})"
        )
        text += ", band 95 % stratified bootstrap." if max(seeds) > 1 else "."
        missing = [label_of(name) for name in study.variants if name not in averages]
        if missing and in_panels:
            text += " Only of variants that have begun on every task."
        elif missing:
            text += f" Without {', '.join(missing)}, not begun on every task."
    if in_panels and not_begun(study):
        text += " Empty panels: not begun."
    waiting = in_progress(study) if in_panels else unfinished(study)
    return text + (f" Not finished: {'; '.join(waiting)}." if waiting else "")

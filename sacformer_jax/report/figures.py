"""Pictures of a report, as SVG: curves of all its runs over each other."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from sacformer_jax.diagnostics import diagnostics_figure, line_style, tidy
from sacformer_jax.report.reading import Curve, Run

_APART = 10
"""Speeds that differ more are drawn on a logarithmic axis."""
_STYLE: Any = {
    "font.family": "DejaVu Sans", "font.size": 9, "axes.titlesize": 10, "legend.fontsize": 9,
    "svg.hashsalt": "sacformer-jax",
}  # fmt: skip


def returns_figure(runs: Sequence[Run]) -> str | None:
    """Evaluation returns over environment steps and over training time; a row for each task.

    Returns:
      SVG; None where no run was evaluated.
    """
    curves = [run.curve() for run in runs]
    tasks = list(dict.fromkeys(run.task for run in runs))
    if all(curve is None for curve in curves):
        return None
    styles = [line_style(place, len(runs)) for place in range(len(runs))]
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(10, 3.6 * len(tasks)), layout="constrained")
        panels = figure.subplots(len(tasks), 2, squeeze=False)
        for (left, right), task in zip(panels, tasks, strict=True):
            for place, (run, curve) in enumerate(zip(runs, curves, strict=True)):
                if curve is None or run.task != task:
                    continue
                _draw_curve(left, curve, curve.env_steps, styles[place], run.label)
                minutes = _minutes(run, curve)
                if minutes is not None:
                    _draw_curve(right, curve, minutes, styles[place], run.label)
            _label(left, f"{task}: evaluation return", "environment steps")
            _label(right, f"{task}: evaluation return", "training time (minutes)")
            if len(runs) > 1:
                left.legend(frameon=False)
        return _svg(figure)


def metrics_figure(runs: Sequence[Run]) -> str | None:
    """The sheet of diagnostics, of all runs over each other.

    Returns:
      SVG; None where nothing was trained.
    """
    if not any(own for run in runs for own in run.train.values()):
        return None
    groups = {run.label: list(run.records.values()) for run in runs}
    return _svg(diagnostics_figure(groups, "").figure)


def throughput_figure(runs: Sequence[Run]) -> str | None:
    """Environment steps a second, chunk by chunk.

    Returns:
      SVG; None without timings.
    """
    if not any(run.timings for run in runs):
        return None
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(10, 2.6), layout="constrained")
        axes = figure.subplots()
        for place, run in enumerate(runs):
            steps = [record["env_steps"] for record in run.timings]
            speeds = [record["steps_per_second"] for record in run.timings]
            axes.plot(steps, speeds, **line_style(place, len(runs)), linewidth=1.2, label=run.label)
        medians = [run.steps_per_second for run in runs if run.steps_per_second is not None]
        if max(medians) > _APART * min(medians):
            axes.set_yscale("log")
        else:
            axes.set_ylim(bottom=0)
        _label(axes, "environment steps a second, all members together", "environment steps")
        return _svg(figure)


def _draw_curve(axes: Axes, curve: Curve, x: np.ndarray, line: dict[str, Any], label: str) -> None:
    axes.fill_between(x, curve.low, curve.high, color=line["color"], alpha=0.18, linewidth=0)
    if len(curve.members) > 1:
        for values in curve.members:
            axes.plot(x, values, color=line["color"], linewidth=0.6, alpha=0.4)
    axes.plot(x, curve.mean, **line, linewidth=2, label=label)


def _minutes(run: Run, curve: Curve) -> np.ndarray | None:
    """Training time at each evaluation; None without timings."""
    if not run.timings:
        return None
    steps = [record["env_steps"] for record in run.timings]
    return np.interp(curve.env_steps, steps, run.training_seconds) / 60


def _label(axes: Axes, title: str, xlabel: str) -> None:
    axes.set(title=title, xlabel=xlabel)
    tidy(axes)
    if "minutes" not in xlabel:
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))


def _svg(figure: Figure) -> str:
    file = io.StringIO()
    figure.savefig(file, format="svg", metadata={"Date": None})
    return file.getvalue()

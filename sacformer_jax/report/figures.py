"""Pictures of a report, as SVG: curves of all its runs over each other."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from sacformer_jax.report.reading import Curve, Run

_APART = 10
"""Speeds that differ more are drawn on a logarithmic axis."""
_DASHES = ("-", "--", ":", "-.")
_STYLE: Any = {
    "font.family": "DejaVu Sans", "font.size": 9, "axes.titlesize": 10, "legend.fontsize": 9,
    "svg.hashsalt": "sacformer-jax",
}  # fmt: skip
METRICS = {
    "episode_return_mean": "return of training episodes",
    "episode_length_mean": "length of training episodes (steps)",
    "q_mean": "mean Q",
    "critic_loss": "critic loss",
    "actor_loss": "actor loss",
    "entropy": "entropy (nats)",
    "alpha": "temperature α",
    "actor_grad_norm": "actor gradient norm",
    "critic_grad_norm": "critic gradient norm",
    "approx_kl": "approximate KL (nats)",
    "clip_fraction": "clipped fraction",
    "explained_variance": "explained variance of values",
    "learning_rate": "actor learning rate",
}
"""Training metrics that are drawn, where a run has them, with their titles."""


def returns_figure(runs: Sequence[Run]) -> str | None:
    """Evaluation returns over environment steps and over training time; a row for each task.

    Returns:
      SVG; None where no run was evaluated.
    """
    curves = [run.curve() for run in runs]
    tasks = list(dict.fromkeys(run.config.task.env for run in runs))
    if all(curve is None for curve in curves):
        return None
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(10, 3.6 * len(tasks)), layout="constrained")
        panels = figure.subplots(len(tasks), 2, squeeze=False)
        for (left, right), task in zip(panels, tasks, strict=True):
            for place, (run, curve) in enumerate(zip(runs, curves, strict=True)):
                if curve is None or run.config.task.env != task:
                    continue
                _draw_curve(left, curve, curve.env_steps, place, run.label)
                minutes = _minutes(run, curve)
                if minutes is not None:
                    _draw_curve(right, curve, minutes, place, run.label)
            _tidy(left, f"{task}: evaluation return", "environment steps")
            _tidy(right, f"{task}: evaluation return", "training time (minutes)")
            if len(runs) > 1:
                left.legend(frameon=False)
        return _svg(figure)


def metrics_figure(runs: Sequence[Run]) -> str | None:
    """Training metrics over environment steps, a panel for each: means over the members.

    Returns:
      SVG; None where nothing was trained.
    """
    present = [name for name in METRICS if any(_metric(run, name)[0].size for run in runs)]
    if not present:
        return None
    with mpl.rc_context(_STYLE):
        rows = math.ceil(len(present) / 3)
        figure = Figure(figsize=(10, 2.3 * rows), layout="constrained")
        panels = figure.subplots(rows, 3, squeeze=False).ravel()
        for axes, name in zip(panels, present, strict=False):
            for place, run in enumerate(runs):
                steps, values = _metric(run, name)
                axes.plot(steps, values, **_line(place), linewidth=1.2, label=run.label)
            _tidy(axes, METRICS[name], "")
        for axes in panels[len(present) :]:
            axes.remove()
        return _svg(figure)


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
            axes.plot(steps, speeds, **_line(place), linewidth=1.2, label=run.label)
        medians = [run.steps_per_second for run in runs if run.steps_per_second is not None]
        if max(medians) > _APART * min(medians):
            axes.set_yscale("log")
        else:
            axes.set_ylim(bottom=0)
        _tidy(axes, "environment steps a second, all members together", "environment steps")
        return _svg(figure)


def _draw_curve(axes: Axes, curve: Curve, x: np.ndarray, place: int, label: str) -> None:
    line = _line(place)
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


def _metric(run: Run, name: str) -> tuple[np.ndarray, np.ndarray]:
    """A training metric's mean over the members that have it: env steps and values."""
    values: dict[int, list[float]] = {}
    for records in run.train.values():
        for record in records:
            if record.get(name) is not None:
                values.setdefault(record["env_steps"], []).append(record[name])
    steps = sorted(values)
    return np.array(steps), np.array([np.mean(values[step]) for step in steps])


def _line(place: int) -> dict[str, Any]:
    """Ten colours; dashes tell the lines apart in greyscale, too."""
    return {"color": f"C{place % 10}", "linestyle": _DASHES[place % len(_DASHES)]}


def _tidy(axes: Axes, title: str, xlabel: str) -> None:
    axes.set(title=title, xlabel=xlabel)
    if "minutes" not in xlabel:
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)


def _svg(figure: Figure) -> str:
    file = io.StringIO()
    figure.savefig(file, format="svg", metadata={"Date": None})
    return file.getvalue()

"""Pictures of how a run learns and of what its policy does; they can be read in grey, too."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from sacformer_jax.logging import Record

_DASHES = ("-", "--", ":", "-.")
_COLUMNS = 3
_MAX_NUMBERS = 80
"""Cells of a heat map up to which each has its number."""


@dataclasses.dataclass(frozen=True)
class Panel:
    """A metric of ``metrics.jsonl`` against environment steps.

    Attributes:
      kind: of the records, ``"train"`` or ``"eval"``.
      name: of the metric.
      title: above the panel.
      unit: beside it.
      log: a logarithmic scale.
      total: the sum so far, instead of each value; left out while it is 0 everywhere.
    """

    kind: str
    name: str
    title: str
    unit: str
    log: bool = False
    total: bool = False


PANELS = (
    Panel("eval", "return_mean", "evaluation return", "reward"),
    Panel("train", "episode_return_mean", "training return", "reward"),
    Panel("train", "episode_length_mean", "length of training episodes", "steps"),
    Panel("train", "q_mean", "Q, mean", "discounted reward"),
    Panel("train", "explained_variance", "explained variance of values", "share"),
    Panel("train", "entropy", "entropy", "nats"),
    Panel("train", "alpha", "temperature α", "reward per nat"),
    Panel("train", "approx_kl", "approximate KL", "nats"),
    Panel("train", "clip_fraction", "clipped ratios", "share"),
    Panel("train", "learning_rate", "learning rate", "step size"),
    Panel("train", "critic_loss", "critic loss", "squared error", log=True),
    Panel("train", "actor_loss", "actor loss", "loss"),
    Panel("train", "prediction_loss", "prediction loss", "share of variance", log=True),
    Panel("train", "critic_grad_norm", "critic gradient", "norm", log=True),
    Panel("train", "actor_grad_norm", "actor gradient", "norm", log=True),
    Panel("train", "skipped_updates", "updates skipped so far", "updates", total=True),
    Panel("train", "bad_physics", "steps of bad physics so far", "steps", total=True),
)
"""What a sheet has, as far as the records have it."""
_ALWAYS = ("skipped_updates",)

Curve = dict[int, float]


def _curve(records: list[Record], panel: Panel) -> Curve:
    """The metric by environment steps; empty without any number."""
    values = {
        int(record["env_steps"]): float(record[panel.name])
        for record in records
        if record["kind"] == panel.kind and record.get(panel.name) is not None
    }
    if not panel.total:
        return values
    sums = np.cumsum(list(values.values()))
    if panel.name not in _ALWAYS and (not sums.size or sums[-1] == 0):
        return {}
    return dict(zip(values, sums.tolist(), strict=True))


def diagnostics_sheet(groups: dict[str, list[list[Record]]], path: Path, title: str) -> list[str]:
    """Draws the metrics of one run, or of several to compare, into a PNG: a panel a metric.

    Thin lines are single members, a thick one is their mean at the steps that they have in common.

    Args:
      groups: by the run's label, the records of each of its members.
      path: file to write.
      title: above the panels.

    Returns:
      The metrics drawn.
    """
    sheet = diagnostics_figure(groups, title)
    _save(sheet.figure, path)
    return sheet.metrics


@dataclasses.dataclass(frozen=True)
class Sheet:
    """A figure and the metrics that it shows."""

    figure: Figure
    metrics: list[str]


def diagnostics_figure(groups: dict[str, list[list[Record]]], title: str) -> Sheet:
    """What :func:`diagnostics_sheet` draws, to be written elsewhere."""
    curves = {
        panel: {
            label: [curve for records in members if (curve := _curve(records, panel))]
            for label, members in groups.items()
        }
        for panel in PANELS
    }
    curves = {panel: by_label for panel, by_label in curves.items() if any(by_label.values())}
    rows = max(1, math.ceil(len(curves) / _COLUMNS))
    figure = _figure((4.0 * _COLUMNS, 2.5 * rows + (0.8 if len(groups) > 1 else 0.4)))
    panels = figure.subplots(rows, _COLUMNS, squeeze=False, sharex=True).reshape(-1).tolist()
    for axes, (panel, by_label) in zip(panels, curves.items(), strict=False):
        for place, (label, members) in enumerate(by_label.items()):
            _draw_group(axes, members, label, line_style(place, len(groups)))
        axes.set(title=panel.title, ylabel=panel.unit)
        if panel.log:
            _log_scale(axes)
        if panel.total:
            axes.set_ylim(top=max(1.0, axes.get_ylim()[1]))
            axes.set_ylim(bottom=-0.05 * axes.get_ylim()[1])
    for number, axes in enumerate(panels):
        tidy(axes)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.set_visible(number < len(curves))
        if number + _COLUMNS >= len(curves):
            axes.xaxis.set_tick_params(labelbottom=True)
            axes.set_xlabel("environment steps")
    _legend_below(figure, panels[: len(curves)], len(groups))
    figure.suptitle(title)
    return Sheet(figure, [panel.name for panel in curves])


def _draw_group(axes: Axes, members: list[Curve], label: str, style: dict[str, Any]) -> None:
    if not members:
        return
    several = len(members) > 1
    for curve in members:
        line, name = (0.7, None) if several else (1.2, label)
        alpha = 0.5 if several else 1.0
        values = list(curve.values())
        axes.plot(list(curve), values, **style, linewidth=line, alpha=alpha, label=name)
    if several:
        common = sorted(set.intersection(*(set(curve) for curve in members)))
        means = [sum(curve[step] for curve in members) / len(members) for step in common]
        axes.plot(common, means, **style, linewidth=2, label=f"{label}, {len(members)} seeds")


def achieved_returns(
    targets: Sequence[float], returns: np.ndarray, trained: float, path: Path, title: str
) -> None:
    """Draws the returns achieved against the target returns asked for, into a PNG.

    Args:
      targets: M target returns.
      returns: ``[M, E]`` returns of E episodes under each.
      trained: the target return of training.
      path: file to write.
      title: above the axes.
    """
    figure = _figure((5.4, 4.4))
    axes = figure.subplots()
    ends = [min(targets), max(targets)]
    axes.plot(ends, ends, "--", color="0.55", linewidth=1, label="achieved = target")
    axes.axvline(trained, color="0.55", linestyle=":", linewidth=1.2, label="target in training")
    for target, row in zip(targets, returns, strict=True):
        axes.plot([target] * len(row), row, "o", color="0.45", markersize=3, alpha=0.6)
    mean, spread = returns.mean(axis=1), returns.std(axis=1)
    axes.errorbar(
        list(targets), mean, yerr=spread, color="#0b3c5d", marker="s", markersize=5, linewidth=1.8,
        capsize=3, label=f"mean ± std of {returns.shape[1]} episodes",
    )  # fmt: skip
    axes.set(xlabel="target return (reward)", ylabel="achieved return (reward)", title=title)
    tidy(axes)
    axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.legend(frameon=False, fontsize=9)
    _save(figure, path)


def attention_map(
    attention: np.ndarray, tokens: Sequence[str], older: bool, path: Path, title: str
) -> None:
    """Draws how much the state acted on attends to each token of its context, into a PNG.

    Args:
      attention: ``[L, H, P, n]``, layers, heads, pairs from the newest back, tokens of a pair; the
        rows over the last two sum to 1.
      tokens: names of the n tokens.
      older: the last pair stands for all older ones.
      path: file to write.
      title: above the panels.
    """
    layers, heads, pairs, num_tokens = attention.shape
    rows = layers * heads
    width = 1.6 + num_tokens * min(5.0, 0.9 + 0.55 * pairs)
    figure = _figure((width + 0.8, 1.5 + 0.42 * rows))
    panels = figure.subplots(1, num_tokens, squeeze=False, sharey=True)[0]
    back = [f"−{step}" if step else "now" for step in range(pairs)]
    if older:
        back[-1] = f"≤ −{pairs - 1}"
    heaviest = max(float(attention.max()), 1e-9)
    for token, axes in enumerate(panels):
        # Oldest on the left, as they stand in the context.
        values = attention[:, :, ::-1, token].reshape(rows, pairs)
        image = axes.imshow(values, cmap="Greys", vmin=0.0, vmax=heaviest, aspect="auto")
        shown = range(0, pairs, max(1, pairs // 10))
        axes.set_xticks([pairs - 1 - step for step in shown], [back[step] for step in shown])
        axes.set(title=f"{tokens[token]} tokens", xlabel="environment steps before the state")
        if rows * pairs <= _MAX_NUMBERS:
            for row, column in np.ndindex(rows, pairs):
                value = values[row, column]
                color = "white" if value > 0.6 * heaviest else "black"
                text = f"{value:.2f}".removeprefix("0")
                axes.text(column, row, text, ha="center", va="center", color=color, fontsize=8)
    names = [
        f"layer {layer + 1}" + (f", head {head + 1}" if heads > 1 else "")
        for layer in range(layers)
        for head in range(heads)
    ]
    panels[0].set_yticks(range(rows), names)
    figure.colorbar(image, ax=list(panels), label="share of attention", pad=0.01)
    figure.suptitle(title)
    _save(figure, path)


# --- what they have in common --------------------------------------------------------------------


def _figure(size: tuple[float, float]) -> Figure:
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def line_style(place: int, num: int) -> dict[str, Any]:
    """Colours that get lighter from one to the next, and dashes: told apart in grey, too."""
    shade = 0.0 if num == 1 else 0.8 * place / (num - 1)
    color = "#0b3c5d" if num == 1 else matplotlib.colormaps["viridis"](shade)
    return {"color": color, "linestyle": _DASHES[place % len(_DASHES)]}


def tidy(axes: Axes) -> None:
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.title.set_fontsize(11)


def _log_scale(axes: Axes) -> None:
    """A logarithmic scale with plain numbers, also where it spans less than a decade."""
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    decades = math.log10(high / low)
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if decades < 3 else (1.0,)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def _legend_below(figure: Figure, panels: Sequence[Axes], num_groups: int) -> None:
    """One legend for all panels, where there is something to tell apart."""
    handles = {
        label: line
        for axes in panels
        for line, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    several = any(label.endswith(" seeds") for label in handles)
    if num_groups > 1 or several:
        figure.legend(
            handles.values(), handles.keys(), loc="outside lower center", ncols=4, frameon=False
        )


def _save(figure: Figure, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)

"""One picture of diagnoses, printed 17 cm wide, that can be read in grey."""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.ticker import LogLocator, NullFormatter
from report.page import FONTS, make_page, tidy

from diagnosis.measuring import Diagnosis, mean_numbers
from diagnosis.table import Runs

_DPI = 200
_PANELS = 4
_DARK, _PALE = "0.15", "0.65"
KINDS = {
    "return": ("0.15", "-", "o"),
    "state": ("0.45", "--", "s"),
    "action": ("0.7", ":", "^"),
    "joint": ("0.15", "-", "o"),
}
_MOST_POINTS = 1_500
_CAPTION = (
    "Gradients: signal-to-noise ratio of an update's gradient at the restored state, dark bars of "
    "the actor, pale and hatched ones of the critics; the dotted line is what pure noise gives. "
    "Attention: of the state acted on, mean over heads and blocks, by steps back and kind of "
    "token. Q: the smaller critic against the discounted return with entropy (soft) of the same "
    "policy. Return tokens: scaled, in training batches (filled) and in evaluation (line). All "
    "seeds together, bars and attention as means."
)


def draw(runs: Runs, num_batches: int, path: Path) -> None:
    """Writes a PNG: a column for each run, or of one run its four panels in a square.

    Args:
      runs: what was found.
      num_batches: M, whose gradients were compared.
      path: file to write.
    """
    shape = (2, 2) if len(runs) == 1 else (_PANELS, len(runs))
    with matplotlib.rc_context(FONTS):
        page = make_page(*shape, row_height=2.1, caption=_CAPTION, handles=[])
        for place, (label, members) in enumerate(runs.items()):
            if len(runs) == 1:
                panels = [axes for row in page.axes for axes in row]
            else:
                panels = [row[place] for row in page.axes]
            means = mean_numbers(members)
            _draw_signal(panels[0], means, num_batches)
            _draw_attention(panels[1], means)
            _draw_values(panels[2], members)
            _draw_tokens(panels[3], members)
            if len(runs) > 1:
                panels[0].set_title(f"{label}\n{panels[0].get_title()}", fontsize=8)
            if len(runs) > 1 and place > 0:  # as in the first column
                for axes in panels[1:]:
                    axes.set_ylabel("")
            for axes in panels:
                tidy(axes)
        if len(runs) == 1:
            page.figure.suptitle(next(iter(runs)), fontsize=9)
        FigureCanvasAgg(page.figure)
        page.figure.savefig(path, dpi=_DPI, metadata={"Software": None})


def _draw_signal(axes: Axes, means: dict[str, float], num_batches: int) -> None:
    names, values, critics = [], [], []
    for name, value in means.items():
        match = re.fullmatch(r"gradient/(actor|critics)/(.+)/snr", name)
        if match:
            names.append(f"{match[1]}, all" if match[2] == "whole" else match[2])
            values.append(value)
            critics.append(match[1] == "critics")
    bars = axes.barh(range(len(names)), values, color=_DARK, height=0.7)
    for bar, of_critics in zip(bars, critics, strict=True):
        if of_critics:
            bar.set(facecolor=_PALE, hatch="////", edgecolor="white")
    axes.axvline(1 / (num_batches - 1), color="0.4", linestyle=":", linewidth=1)
    axes.set_yticks(range(len(names)), names)
    axes.tick_params(axis="y", labelsize=5.5)
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set(title="gradients", xlabel="signal-to-noise ratio")


def _draw_attention(axes: Axes, means: dict[str, float]) -> None:
    axes.set(title="attention", xlabel="steps back", ylabel="share of attention")
    curves: dict[str, dict[int, list[float]]] = {}
    for name, value in means.items():
        match = re.fullmatch(r"attention/block_\d+/(\d+)_back/(\w+)", name)
        if match:
            curves.setdefault(match[2], {}).setdefault(int(match[1]), []).append(value)
    if not curves:
        return _say_nothing(axes, "sees one state")
    for kind, curve in curves.items():
        color, dashes, marker = KINDS[kind]
        heights = [float(np.mean(values)) for values in curve.values()]
        axes.plot(list(curve), heights, dashes, color=color, marker=marker, ms=3, label=kind)
    axes.set_ylim(bottom=0.0)
    axes.legend(frameon=False, fontsize=7)
    return None


def _draw_values(axes: Axes, members: list[Diagnosis]) -> None:
    axes.set(title="Q", xlabel="soft return", ylabel="min Q")
    returns = np.concatenate([one.steps.returns for one in members])
    q = np.concatenate([one.steps.q for one in members])
    if not q.size:
        return _say_nothing(axes, "no return is known")
    shown = np.linspace(0, q.size - 1, min(q.size, _MOST_POINTS)).astype(int)
    axes.plot(returns[shown], q[shown], "o", color="0.3", ms=1.5, alpha=0.35, markeredgewidth=0)
    ends = [min(returns.min(), q.min()), max(returns.max(), q.max())]
    axes.plot(ends, ends, "--", color="0.5", linewidth=0.8)
    return None


def _draw_tokens(axes: Axes, members: list[Diagnosis]) -> None:
    axes.set(title="return tokens", xlabel="return-to-go, scaled", ylabel="density")
    training = np.concatenate([one.tokens.training for one in members])
    acting = np.concatenate([one.tokens.acting for one in members])
    if not acting.size:
        return _say_nothing(axes, "sees no return-to-go")
    both = np.concatenate([training, acting])
    bins = np.linspace(both.min(), both.max() + 1e-6, 31).tolist()
    axes.hist(training, bins, density=True, color="0.75", label="training")
    axes.hist(acting, bins, density=True, histtype="step", color="0.1", label="acting")
    axes.legend(frameon=False, fontsize=7, loc="upper left")
    return None


def _say_nothing(axes: Axes, why: str) -> None:
    axes.text(
        0.5, 0.5, why, ha="center", va="center", transform=axes.transAxes, color="0.4", fontsize=7
    )
    axes.set_xticks([])
    axes.set_yticks([])

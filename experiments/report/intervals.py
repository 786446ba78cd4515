"""Intervals of a study: what each variant comes to over all tasks."""

from __future__ import annotations

import math
from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from report.lines import StudyLines, label_of
from report.page import make_page, tidy
from report.scores import LAST_EVALUATIONS, REFERENCE_SOURCE, Estimate
from report.tables import Aggregate, facts, rated_tasks

_ROW_HEIGHT, _AXIS_HEIGHT = 0.2, 0.55
_COLOR, _BASELINE_COLOR = "#0b1f66", "#8c8c8c"


def intervals_figure(study: StudyLines, made: Sequence[Aggregate], baseline: str) -> Figure:
    """Variants from best to worst: interquartile mean, and probability of improvement.

    Args:
      study: the study.
      made: its aggregates; those without an interquartile mean are left out.
      baseline: whose values the dashed lines show.
    """
    rated = sorted(
        ((one.iqm.value, one) for one in made if one.iqm is not None),
        key=lambda pair: pair[0], reverse=True,
    )  # fmt: skip
    shown = [one for _, one in rated]
    page = make_page(
        1, 2, _ROW_HEIGHT * len(shown) + _AXIS_HEIGHT, _caption(study, made, baseline), [],
        sharey="row", width_ratios=[1.2, 1.0],
    )  # fmt: skip
    left, right = page.axes[0]
    for place, one in enumerate(shown):
        is_baseline = one.variant == baseline
        if one.iqm is not None:
            _interval(left, place, one.iqm, is_baseline)
        if one.improvement is not None:
            _interval(right, place, one.improvement, False)
        if is_baseline and one.iqm is not None:
            left.axvline(one.iqm.value, color=_BASELINE_COLOR, linestyle="--", linewidth=0.8)
    right.axvline(0.5, color=_BASELINE_COLOR, linestyle="--", linewidth=0.8)
    left.set_yticks(range(len(shown)), [label_of(one.variant) for one in shown])
    left.set_ylim(len(shown) - 0.5, -0.5)
    left.set_xlabel("interquartile mean of normalized scores")
    right.set_xlabel(f"probability of improvement over {label_of(baseline)}")
    right.set_xlim(-0.02, 1.02)
    for axes in (left, right):
        tidy(axes)
        axes.tick_params(axis="y", length=0)
    return page.figure


def _interval(axes: Axes, place: int, estimate: Estimate, hollow: bool) -> None:
    """A point on its interval, the baseline's hollow."""
    if not math.isnan(estimate.low):
        axes.plot(
            [estimate.low, estimate.high], [place, place], color=_COLOR, linewidth=1.6,
            solid_capstyle="butt",
        )  # fmt: skip
    axes.plot(
        [estimate.value], [place], "o", color=_COLOR, markersize=5,
        markerfacecolor="white" if hollow else _COLOR,
    )  # fmt: skip


def _on_fewer_tasks(study: StudyLines, made: Sequence[Aggregate]) -> dict[str, list[str]]:
    """Which of those shown are compared with the baseline on how few tasks."""
    of: dict[str, list[str]] = {}
    for one in made:
        if one.iqm is not None and one.improvement is not None and one.tasks != study.tasks:
            of.setdefault(", ".join(one.tasks), []).append(label_of(one.variant))
    return of


def _caption(study: StudyLines, made: Sequence[Aggregate], baseline: str) -> str:
    text = (
        f"Study {study.name}: {facts(study)}. Scores: mean of a run's last {LAST_EVALUATIONS} "
        f"evaluations on {', '.join(rated_tasks(study))}, where 0 is random actions and 1 "
        f"{REFERENCE_SOURCE}. Lines: 95 % stratified bootstrap intervals; dashed: no better and no "
        f"worse than {label_of(baseline)}"
    )
    missing = [label_of(one.variant) for one in made if one.iqm is None]
    text += "." if label_of(baseline) in missing else " (hollow)."
    for tasks, of in _on_fewer_tasks(study, made).items():
        text += f" Improvement of {', '.join(of)}: on {tasks} only."
    return text + (f" Left out, not finished: {', '.join(missing)}." if missing else "")

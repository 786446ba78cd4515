"""Pictures of a run."""

from __future__ import annotations

from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sacformer_jax.logging import Record

_LEGEND_INSIDE = 8
"""Variants that a legend inside a panel has room for."""
_DASHES = ("-", "--", ":")


def learning_curve(records: list[Record], path: Path, title: str) -> None:
    """Draws evaluation and training returns against environment steps into a PNG.

    Args:
      records: lines of ``metrics.jsonl``.
      path: file to write.
      title: above the axes.
    """
    evaluations = [r for r in records if r["kind"] == "eval"]
    episodes = [r for r in records if r["kind"] == "train" and r["episode_return_mean"] is not None]
    figure = Figure(figsize=(7, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    if episodes:
        axes.plot(
            [r["env_steps"] for r in episodes],
            [r["episode_return_mean"] for r in episodes],
            color="0.65",
            linewidth=1,
            label="training episodes (sampled actions)",
        )
    if evaluations:
        steps = [r["env_steps"] for r in evaluations]
        mean = [r["return_mean"] for r in evaluations]
        low = [r["return_mean"] - r["return_std"] for r in evaluations]
        high = [r["return_mean"] + r["return_std"] for r in evaluations]
        axes.fill_between(steps, low, high, color="tab:blue", alpha=0.2, linewidth=0)
        axes.plot(
            steps, mean, color="tab:blue", marker="o", markersize=3, label="evaluation (mean ± std)"
        )
    axes.set(xlabel="environment steps", ylabel="episode return (reward)", title=title)
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    if episodes or evaluations:
        axes.legend(frameon=False)
    figure.savefig(path, dpi=130)


def comparison(rows: list[Record], path: Path, title: str) -> None:
    """Draws evaluation returns of several runs, a panel per task, into a PNG.

    Thin lines are single seeds, the thick line is their mean where all were evaluated.

    Args:
      rows: evaluations, each with ``env``, ``variant`` (a line each), ``seed``, ``env_steps`` and
        ``return_mean``.
      path: file to write.
      title: above the panels.
    """
    envs = list(dict.fromkeys(row["env"] for row in rows))
    variants = list(dict.fromkeys(row["variant"] for row in rows))
    many = len(variants) > _LEGEND_INSIDE
    figure = Figure(figsize=((6 if many else 4) * len(envs), 6 if many else 3.6))
    figure.set_layout_engine("constrained")
    FigureCanvasAgg(figure)
    for axes, env in zip(figure.subplots(1, len(envs), squeeze=False)[0], envs, strict=True):
        for place, variant in enumerate(variants):
            # Dashes tell apart in grey, too, and those whose colours (there are ten) are the same.
            color, dashes = f"C{place % 10}", _DASHES[(place + place // 10) % len(_DASHES)]
            curves: dict[str, dict[int, float]] = {}
            for row in rows:
                if (row["env"], row["variant"]) == (env, variant):
                    seed = curves.setdefault(str(row["seed"]), {})
                    seed[row["env_steps"]] = row["return_mean"]
            for curve in curves.values():
                values = list(curve.values())
                axes.plot(list(curve), values, dashes, color=color, lw=0.8, alpha=0.3)
            if curves:
                common = sorted(set.intersection(*(set(curve) for curve in curves.values())))
                means = [sum(c[step] for c in curves.values()) / len(curves) for step in common]
                seeds = f"{len(curves)} seed{'s' if len(curves) > 1 else ''}"
                axes.plot(common, means, dashes, color=color, lw=2, label=f"{variant}, {seeds}")
        axes.set(xlabel="environment steps", title=env)
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
        if not many:
            axes.legend(frameon=False)
    figure.axes[0].set_ylabel("evaluation return (reward)")
    if many:
        handles = {
            label: line
            for axes in figure.axes
            for line, label in zip(*axes.get_legend_handles_labels(), strict=True)
        }
        figure.legend(
            handles.values(), handles.keys(), loc="outside lower center", ncols=4, frameon=False
        )
    figure.suptitle(title)
    figure.savefig(path, dpi=110)

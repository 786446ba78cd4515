"""What came of a sweep: tables of members and settings, a picture, the best one by itself."""

from __future__ import annotations

import itertools
import math
import shutil
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from csv_files import write_csv
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from sacformer_jax import Member, extract
from sacformer_jax.checkpoint import RunFolder
from sacformer_jax.logging import Record, read_records

Row = dict[str, Any]

LAST = 3
"""Evaluations whose mean is a member's score; a setting's is the mean over its seeds."""


def member_row(member: Member, records: Sequence[Record]) -> Row:
    """What came of a member, from the lines of its ``metrics.jsonl``; no evaluation gives NaN."""
    returns = [
        math.nan if record["return_mean"] is None else record["return_mean"]
        for record in records
        if record["kind"] == "eval"
    ] or [math.nan]
    finite = [value for value in returns if math.isfinite(value)]
    return {
        "setting": member.name.rsplit("-seed-", 1)[0],
        "member": member.name,
        "seed": member.seed,
        **member.values,
        "score": statistics.fmean(returns[-LAST:]),
        "best_return": max(finite, default=math.nan),
        "final_return": returns[-1],
        "skipped_updates": sum(r["skipped_updates"] for r in records if r["kind"] == "train"),
    }


def setting_rows(rows: Sequence[Row], names: Sequence[str]) -> list[Row]:
    """Means over the seeds of each setting, the highest score first, NaN last.

    Args:
      rows: of :func:`member_row`.
      names: the fields that are swept.
    """
    by_setting: dict[str, list[Row]] = {}
    for row in rows:
        by_setting.setdefault(row["setting"], []).append(row)
    table = []
    for setting, own in by_setting.items():
        scores = [row["score"] for row in own]
        means = {
            what: statistics.fmean(row[what] for row in own)
            for what in ("best_return", "final_return")
        }
        table.append(
            {
                "setting": setting,
                **{name: own[0][name] for name in names},
                "seeds": len(own),
                "score": statistics.fmean(scores),
                "score_std": float(np.std(scores)),
                **means,
                "skipped_updates": sum(row["skipped_updates"] for row in own),
            }
        )
    return sorted(table, key=lambda row: (math.isnan(row["score"]), -row["score"]))


def print_table(table: Sequence[Row]) -> None:
    """The settings, best first."""
    shown = Table(title=f"settings by score, the mean of the last {LAST} evaluations and all seeds")
    for column in table[0]:
        shown.add_column(column, justify="left" if column == "setting" else "right")
    for row in table:
        shown.add_row(*(f"{v:.5g}" if isinstance(v, float) else str(v) for v in row.values()))
    # As wide as need be: nothing is cut off where there is no terminal.
    Console(highlight=False, width=1_000).print(shown)


def picture(rows: Sequence[Row], table: Sequence[Row], names: Sequence[str], path: Path) -> None:
    """Draws the score against each swept field into a PNG, with a logarithmic axis where it fits.

    Args:
      rows: of the members.
      table: of the settings, best first.
      names: the fields.
      path: file to write.
    """
    figure = Figure(figsize=(4 * len(names), 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, name in zip(figure.subplots(1, len(names), squeeze=False)[0], names, strict=True):
        levels = sorted({row[name] for row in table})
        axes.plot([r[name] for r in rows], [r["score"] for r in rows], "o", color="0.75", ms=4,
                  label="one seed")  # fmt: skip
        if len(names) == 1 or len(levels) < len(table):
            means = [
                statistics.fmean(row["score"] for row in table if row[name] == level)
                for level in levels
            ]
            axes.plot(levels, means, color="tab:blue", label="mean at this value")
        axes.plot([row[name] for row in table], [row["score"] for row in table], "o",
                  color="tab:blue", ms=5, label="a setting")  # fmt: skip
        axes.plot(table[0][name], table[0]["score"], "*", color="tab:red", ms=13, label="the best")
        if levels[0] > 0 and levels[-1] / levels[0] >= 8:
            axes.set_xscale("log")
        else:
            axes.locator_params(axis="x", nbins=5)
            axes.ticklabel_format(axis="x", scilimits=(-2, 4))
        axes.set(xlabel=name)
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel(f"return, mean of the last {LAST} evaluations")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(path, dpi=110)


def save_best(folder: RunFolder, names: Sequence[str]) -> Path:
    """Extracts members to ``best-setting``; what is there already is not lost.

    Args:
      folder: of the sweep.
      names: of the members.
    """
    target = RunFolder(folder.path / "best-setting")
    there, now = target.latest_step(), folder.latest_step()
    if there is None:
        shutil.rmtree(target.path, ignore_errors=True)  # an extraction that was killed
    else:
        same = [member.name for member in target.read_config().members] == list(names)
        if same and now is not None and there >= now:
            return target.path  # may have been trained further by itself
        places = (folder.path / f"best-setting-before-{n}" for n in itertools.count(1))
        target.path.rename(next(place for place in places if not place.exists()))
    return extract(folder.path, names, target.path)


def report(folder: RunFolder, members: Sequence[Member]) -> list[Row]:
    """Writes and prints the tables and draws the picture; returns the settings, best first."""
    names = list(members[0].values)
    rows = [member_row(each, read_records(folder.metrics_path(each.name))) for each in members]
    table = setting_rows(rows, names)
    write_csv(folder.path / "sweep.csv", list(rows[0]), rows)
    write_csv(folder.path / "sweep_settings.csv", list(table[0]), table)
    picture(rows, table, names, folder.path / "sweep.png")
    print_table(table)
    print(f"tables and picture: {folder.path}/sweep.csv, sweep_settings.csv, sweep.png")
    return table

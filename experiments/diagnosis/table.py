"""The numbers of a diagnosis as a table for the terminal and as rows for JSON."""

from __future__ import annotations

import math
import re
from typing import Any

from rich.table import Table

from diagnosis.measuring import Diagnosis, mean_numbers

Runs = dict[str, list[Diagnosis]]
"""By the run's label, its members."""

_SECTIONS = {
    "batch": "a batch",
    "gradient": "gradients: norm of the mean, signal-to-noise ratio",
    "entropy": "entropy of the policy, nats",
    "alpha": "temperature α",
    "q_bias": "min Q less soft return, over mean |return|",
    "srank": "effective rank of the features (δ = 0.01)",
    "dormant": "share of dormant units (τ = 0.025)",
    "attention": "attention of the state acted on",
    "return_tokens": "return tokens, scaled",
    "history": "what acting sees: evaluation return, change of actions",
    "window": "steps of a window beside acting: change of features, of actions",
}
_ONLY_IN_JSON = re.compile(r"attention/.*_back/")


def rows(runs: Runs) -> list[dict[str, Any]]:
    """A flat row for each member, and for the ``mean`` of each run; None where there is nothing."""
    found = []
    for label, members in runs.items():
        each = {one.member: one.numbers for one in members}
        for member, numbers in {**each, "mean": mean_numbers(members)}.items():
            plain = {k: v if math.isfinite(v) else None for k, v in numbers.items()}
            found.append({"run": label, "member": member, **plain})
    return found


def table(runs: Runs) -> Table:
    """A column for each run: the mean over its members and, of several, each in brackets."""
    made = Table("", *runs, title="Diagnosis", highlight=False)
    means = {label: mean_numbers(members) for label, members in runs.items()}
    names = dict.fromkeys(name for numbers in means.values() for name in numbers)
    for section in ("env_steps", "updates", *_SECTIONS):
        own = [name for name in names if name.split("/")[0] == section]
        own = [name for name in own if not _ONLY_IN_JSON.match(name)]
        own.sort(key=lambda name: "/critics" in name)
        if section in _SECTIONS and own:
            made.add_section()
            made.add_row(f"[bold]{_SECTIONS[section]}[/bold]")
        for name in own:
            cells = (_cell(name, means[label], members) for label, members in runs.items())
            made.add_row(_label(name), *cells)
    return made


def _label(name: str) -> str:
    parts = name.split("/")
    return " ".join(parts[1:] or parts).replace("_", " ")


def _cell(name: str, mean: dict[str, float], members: list[Diagnosis]) -> str:
    if name not in mean:
        return "–"
    if len(members) == 1:
        return _shown(mean[name])
    each = " / ".join(_shown(one.numbers.get(name, math.nan)) for one in members)
    return f"{_shown(mean[name])} ({each})"


def _shown(value: float) -> str:
    if math.isnan(value):
        return "–"
    return f"{value:,.0f}" if abs(value) >= 1_000 else f"{value:.3g}"

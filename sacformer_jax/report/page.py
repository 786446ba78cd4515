"""The page of a report: one HTML file that needs nothing else."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

from sacformer_jax.report.figures import metrics_figure, returns_figure, throughput_figure
from sacformer_jax.report.reading import Run
from sacformer_jax.version import __version__

VIDEO_LIMIT = 16 * 2**20
"""Bytes above which a video is named instead of embedded."""
_TRAINING_CAPTION = (
    "Means over a chunk's updates, and of episodes over those finished in it. Thin lines: single "
    "members."
)
_NEVER_COMPARED = ("run_dir",)
_STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 70rem; padding: 0 1rem;
  color: #1a1a1a; background: #fff; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.2rem; margin-top: 2.2rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
.wide { overflow-x: auto; }
th, td { padding: .25rem .8rem .25rem 0; text-align: left; vertical-align: top;
  border-bottom: 1px solid #ddd; }
figure { margin: 1rem 0; } figcaption, .note { color: #555; font-size: .9rem; }
img { width: 100%; height: auto; } video { max-width: 30rem; width: 100%; }
.videos { display: flex; flex-wrap: wrap; gap: 1rem; }
@media print { body { margin: 0; max-width: none; } details { display: none; } }
"""


def html_page(runs: Sequence[Run]) -> str:
    """The page, as text.

    Args:
      runs: at least one.
    """
    title = runs[0].label if len(runs) == 1 else f"{len(runs)} runs"
    parts = [
        f"<h1>{escape(title)}</h1>",
        _table(_RUN_COLUMNS, (_run_row(run) for run in runs)),
        _picture("Returns", returns_figure(runs), _returns_caption(runs)),
        _videos(runs),
        _faults(runs),
        _picture("Training", metrics_figure(runs), _TRAINING_CAPTION),
        _picture("Throughput", throughput_figure(runs), "Evaluations, checkpoints and compiling "
                 "are not in it."),
        _settings(runs),
        f"<p class=note>Made by <code>sacformer report</code>, sacformer-jax {__version__}.</p>",
    ]  # fmt: skip
    return (
        "<!doctype html>\n<html lang=en><head><meta charset=utf-8>"
        '<meta name=viewport content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{_STYLE}</style></head>\n<body>\n"
        + "\n".join(part for part in parts if part)
        + "\n</body></html>\n"
    )


# --- runs --------------------------------------------------------------------------------------

_RUN_COLUMNS = (
    "run", "agent", "task", "engine", "preset", "members", "env steps", "last return",
    "best return", "steps/s", "training time", "started", "faults",
)  # fmt: skip


def _run_row(run: Run) -> list[str]:
    curve, total = run.curve(), run.config.run.total_env_steps
    last = best = "–"
    if curve is not None:
        last = f"{curve.mean[-1]:,.1f} [{curve.low[-1]:,.1f}, {curve.high[-1]:,.1f}]"
        place = int(curve.mean.argmax())
        best = f"{curve.mean[place]:,.1f} at {curve.env_steps[place]:,}"
    done = f"{run.env_steps:,}" + ("" if run.env_steps >= total else f" of {total:,}")
    speed = "–" if run.steps_per_second is None else f"{run.steps_per_second:,.0f}"
    seconds = f"{run.training_seconds[-1] / 60:,.1f} min" if run.timings else "–"
    started = {0: "–", 1: "once"}.get(run.stretches, f"{run.stretches} times")
    return [
        run.label, run.config.agent, run.task, run.engine, run.config.preset,
        str(len(run.evaluations)), done, last, best, speed, seconds, started,
        str(run.faults.total),
    ]  # fmt: skip


def _returns_caption(runs: Sequence[Run]) -> str:
    kinds = dict.fromkeys(curve.interval for run in runs if (curve := run.curve()) is not None)
    episodes = sorted({run.config.run.eval_episodes for run in runs})
    counts = " or ".join(map(str, episodes))
    return f"Mean action, {counts} episodes an evaluation. Bands: {'; '.join(kinds)}." + (
        " Thin lines: single members." if any(len(run.evaluations) > 1 for run in runs) else ""
    )


def _faults(runs: Sequence[Run]) -> str:
    columns = ("run", "bad physics", "skipped updates", "damaged checkpoints", "given up")
    rows = []
    for run in runs:
        faults = run.faults
        given_up = ", ".join(f"{name} ({tensor})" for name, tensor in faults.given_up.items())
        counts = (faults.bad_physics, faults.skipped_updates, faults.damaged_checkpoints)
        rows.append([run.label, *(f"{count:,}" for count in counts), given_up or "none"])
    note = (
        "Steps dropped because the physics broke down; updates skipped because a tensor was not "
        "finite; checkpoints moved aside; members that learn no more, with the first such tensor."
    )
    return f"<h2>Faults</h2>{_table(columns, rows)}<p class=note>{note}</p>"


def _videos(runs: Sequence[Run]) -> str:
    shown = []
    for run in runs:
        if run.video is None:
            continue
        name = f"{escape(run.label)}: {escape(run.video.name)}"
        if run.video.stat().st_size > VIDEO_LIMIT:
            where = escape(str(run.video))
            shown.append(f"<p class=note>{name}: too large to embed, see <code>{where}</code></p>")
            continue
        data = base64.b64encode(run.video.read_bytes()).decode()
        shown.append(
            f'<figure><video controls loop muted src="data:video/mp4;base64,{data}"></video>'
            f"<figcaption>{name}</figcaption></figure>"
        )
    return f"<h2>Videos</h2><div class=videos>{''.join(shown)}</div>" if shown else ""


# --- settings ----------------------------------------------------------------------------------


def _settings(runs: Sequence[Run]) -> str:
    values = [run.config.flat() for run in runs]
    names = [name for name in values[0] if name not in _NEVER_COMPARED]
    columns = ["setting", *(run.label for run in runs)]

    def rows(chosen: Iterable[str]) -> list[list[str]]:
        return [[name, *(_shown(own[name]) for own in values)] for name in chosen]

    if len(runs) > 1:
        differing = [name for name in names if len({repr(own[name]) for own in values}) > 1]
        head = f"<h2>Differences</h2>{_table(columns, rows(differing))}"
        if not differing:
            head = "<h2>Differences</h2><p>All settings are equal.</p>"
    else:
        sources = runs[0].sources
        given = [name for name in names if sources[name] in ("given", "command line")]
        head = f"<h2>Settings that were given</h2>{_table(columns, rows(given))}"
        if not given:
            head = "<h2>Settings</h2><p>All as the preset has them.</p>"
    everything = [
        [name, *(f"{_shown(run.config.flat()[name])} ({run.sources[name]})" for run in runs)]
        for name in names
    ]
    return (
        f"{head}<details><summary>All settings, and where they come from</summary>"
        f"{_table(columns, everything)}</details>"
    )


def _shown(value: Any) -> str:
    return repr(value) if value in ("", None) else str(value)


# --- pieces ------------------------------------------------------------------------------------


def _picture(title: str, svg: str | None, caption: str) -> str:
    if svg is None:
        return f"<h2>{title}</h2><p class=note>Nothing yet.</p>"
    data = base64.b64encode(svg.encode()).decode()
    return (
        f'<h2>{title}</h2><figure><img alt="{escape(title)}" '
        f'src="data:image/svg+xml;base64,{data}"><figcaption>{escape(caption)}</figcaption>'
        "</figure>"
    )


def _table(columns: Iterable[str], rows: Iterable[Sequence[str]]) -> str:
    head = "".join(f"<th>{escape(column)}</th>" for column in columns)
    body = "".join(
        f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows
    )
    return f"<div class=wide><table><tr>{head}</tr>{body}</table></div>"

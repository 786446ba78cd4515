"""Figures and tables of studies, made of experiments/results/*.csv: nothing is trained.

python experiments/figures.py                     # of every study
python experiments/figures.py figure2-cpu         # of one

Beside STUDY.csv it writes STUDY.png and STUDY.svg (learning curves), STUDY-scores.png and .svg
(intervals, where there are six variants or more), STUDY.md and STUDY-scores.csv. The same table
gives the same bytes. Where a study is one of several in ``TOGETHER`` that are there, what these
come to over all their tasks is written, too.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox
from report.curves import grid_figure, panels_figure
from report.intervals import intervals_figure
from report.lines import is_study_table, read_study
from report.page import FONTS
from report.styles import MOST_LINES
from report.tables import aggregates, markdown, scores_csv
from report.together import can_compare, together_markdown

RESULTS = Path(__file__).parent / "results"
INTERVALS_FROM = 6
"""Variants from which on there is a figure of intervals."""
TOGETHER = {"arena-memory": ("arena-hidden", "arena-delay")}
"""Studies whose tasks are told of as one, too, by the name of what is written."""
_DPI = 200


def draw(table: Path, baseline: str | None = None) -> list[Path]:
    """Makes all figures and tables of a study, beside its table.

    Args:
      table: ``results/STUDY.csv``.
      baseline: the variant that others are compared with; default: SAC where it is among them,
        else the one without changes.

    Returns:
      the files; none where no line has an evaluation yet.
    """
    study = read_study(table)
    if study is None or not study.last_step:
        return []
    if baseline is not None and baseline not in study.variants:
        raise ValueError(f"baseline {baseline!r}: {table.name} has {', '.join(study.variants)}")
    baseline = baseline or study.baseline()
    made = aggregates(study, baseline)
    texts = {
        f"{study.name}.md": markdown(study, made, baseline),
        f"{study.name}-scores.csv": scores_csv(study, made),
    }
    paths = []
    for name, text in texts.items():
        paths.append(table.with_name(name))
        paths[-1].write_text(text)
    with matplotlib.rc_context(FONTS):
        many = len(study.variants) > MOST_LINES
        curves = grid_figure(study, baseline) if many else panels_figure(study)
        paths += _save(curves, table.with_name(study.name))
        rated = sum(one.iqm is not None for one in made)
        if len(study.variants) >= INTERVALS_FROM and rated > 1:
            intervals = intervals_figure(study, made, baseline)
            paths += _save(intervals, table.with_name(f"{study.name}-scores"))
    return paths + _draw_together(table, baseline)


def _draw_together(table: Path, baseline: str) -> list[Path]:
    """What the study and those that go with it come to, where they have finished the baseline."""
    paths = []
    for name, parts in TOGETHER.items():
        tables = [table.with_name(f"{part}.csv") for part in parts]
        if table.stem not in parts or not all(one.exists() for one in tables):
            continue
        studies = [study for study in map(read_study, tables) if study and study.last_step]
        if len(studies) == len(parts) and all(can_compare(one, baseline) for one in studies):
            paths.append(table.with_name(f"{name}.md"))
            paths[-1].write_text(together_markdown(name, studies, baseline))
    return paths


def _save(figure: Figure, stem: Path) -> list[Path]:
    """As PNG and SVG, without anything that differs from time to time."""
    FigureCanvasAgg(figure)
    _settle(figure)
    png, svg = stem.with_name(f"{stem.name}.png"), stem.with_name(f"{stem.name}.svg")
    figure.savefig(png, dpi=_DPI, metadata={"Software": None})
    with matplotlib.rc_context({"svg.hashsalt": stem.name}):
        figure.savefig(svg, metadata={"Date": None, "Creator": None})
    return [png, svg]


def _settle(figure: Figure) -> None:
    """Lays the figure out for good, with panels at rounded places.

    The last bits of what the layout's solver finds differ from time to time, and names in an SVG
    are made of them.
    """
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for axes in figure.axes:
        rounded = (round(number, 6) for number in axes.get_position().bounds)
        axes.set_position(Bbox.from_bounds(*rounded))


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description="Figures and tables of studies.")
    parser.add_argument("studies", nargs="*", metavar="STUDY", help="default: all in the folder")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the tables")
    parser.add_argument("--baseline", help="the variant that others are compared with")
    args = parser.parse_args(arguments)
    there = {path.stem: path for path in sorted(args.results.glob("*.csv")) if is_study_table(path)}
    unknown = [name for name in args.studies if name not in there]
    if unknown:
        parser.error(f"{', '.join(unknown)}: no such table; there are {', '.join(there)}")
    for name in args.studies or there:
        try:
            paths = draw(there[name], args.baseline)
        except ValueError as error:
            parser.error(str(error))
        print(f"{name}: {', '.join(path.name for path in paths) or 'nothing to draw yet'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

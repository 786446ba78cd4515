"""Size, fonts, legend and caption of figures that are printed 17 cm wide."""

from __future__ import annotations

import dataclasses
import textwrap
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

FONTS: Any = {
    "font.family": "DejaVu Sans",  # comes with Matplotlib: the same everywhere
    "font.size": 8,
    "axes.titlesize": 8.5,
    "axes.labelsize": 8,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 8,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "svg.fonttype": "path",
}
WIDTH = 17 / 2.54
_CAPTION_SIZE = 7.0
_CHARACTERS = 130
"""Of the caption in a line."""
_LINE_HEIGHT = 1.35 * _CAPTION_SIZE / 72
_LEGEND_ROW = 0.2
_MARGIN = 0.06


@dataclasses.dataclass(frozen=True)
class Page:
    """A figure with its panels, and room below them for legend and caption."""

    figure: Figure
    axes: list[list[Axes]]


def make_page(
    rows: int,
    columns: int,
    row_height: float,
    caption: str,
    handles: list[Line2D],
    legend_columns: int = 6,
    **subplots: Any,
) -> Page:
    """A page of ``rows`` times ``columns`` panels.

    Args:
      rows: of panels.
      columns: of panels.
      row_height: inches.
      caption: below everything, broken into lines here.
      handles: lines of the legend, with labels.
      legend_columns: entries beside each other.
      subplots: for ``Figure.subplots``.
    """
    text = textwrap.fill(caption, _CHARACTERS)
    caption_height = _LINE_HEIGHT * (text.count("\n") + 1)
    legend_height = _LEGEND_ROW * -(-len(handles) // legend_columns)
    below = caption_height + legend_height + 2 * _MARGIN
    height = rows * row_height + below
    figure = Figure(figsize=(WIDTH, height))
    figure.set_layout_engine(
        "constrained", rect=(0, below / height, 1, 1 - below / height), w_pad=0.04, h_pad=0.04
    )
    axes = figure.subplots(rows, columns, squeeze=False, **subplots)
    figure.text(
        0.012, _MARGIN / height, text, fontsize=_CAPTION_SIZE, ha="left", va="bottom",
        linespacing=1.3,
    )  # fmt: skip
    if handles:
        figure.legend(
            handles=handles, loc="lower center", ncols=min(legend_columns, len(handles)),
            bbox_to_anchor=(0.5, (caption_height + 1.5 * _MARGIN) / height), frameon=False,
            handlelength=4.2, columnspacing=1.6, borderpad=0, borderaxespad=0,
        )  # fmt: skip
    return Page(figure, [list(row) for row in axes])


def tidy(axes: Axes) -> None:
    """A light grid, and no frame but the axes."""
    axes.grid(color="0.9", linewidth=0.5)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)

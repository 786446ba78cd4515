"""Size, fonts, legend and caption of figures that are printed 17 cm wide."""

from __future__ import annotations

import dataclasses
import itertools
import textwrap
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.textpath import TextPath

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
_HANDLE, _HANDLE_PAD, _COLUMN_SPACING = 4.2, 0.8, 1.6
"""Of the legend, in font sizes."""
_MOST_LEGEND_COLUMNS = 6
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
    **subplots: Any,
) -> Page:
    """A page of ``rows`` times ``columns`` panels.

    Args:
      rows: of panels.
      columns: of panels.
      row_height: inches.
      caption: below everything, broken into lines here.
      handles: lines of the legend, with labels.
      subplots: for ``Figure.subplots``.
    """
    text = textwrap.fill(caption, _CHARACTERS)
    caption_height = _LINE_HEIGHT * (text.count("\n") + 1)
    legend_columns = _columns_that_fit([str(handle.get_label()) for handle in handles])
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
            handles=handles, loc="lower center", ncols=legend_columns,
            bbox_to_anchor=(0.5, (caption_height + 1.5 * _MARGIN) / height), frameon=False,
            handlelength=_HANDLE, handletextpad=_HANDLE_PAD, columnspacing=_COLUMN_SPACING,
            borderpad=0, borderaxespad=0,
        )  # fmt: skip
    return Page(figure, [list(row) for row in axes])


def _columns_that_fit(labels: list[str]) -> int:
    """How many entries of a legend go beside each other."""
    size = FONTS["legend.fontsize"]
    beside = size * (_HANDLE + _HANDLE_PAD)
    widths = [beside + TextPath((0, 0), label, size).get_extents().width for label in labels]
    for columns in range(min(_MOST_LEGEND_COLUMNS, len(labels)), 1, -1):
        # Entries go down the columns, whose number of rows differs by one at most.
        rows, longer = divmod(len(labels), columns)
        starts = [column * rows + min(column, longer) for column in range(columns + 1)]
        of_columns = [max(widths[a:b]) for a, b in itertools.pairwise(starts)]
        spaces = size * _COLUMN_SPACING * (columns - 1)
        if sum(of_columns) + spaces <= 72 * (WIDTH - 2 * _MARGIN):
            return columns
    return 1


def tidy(axes: Axes) -> None:
    """A light grid, and no frame but the axes."""
    axes.grid(color="0.9", linewidth=0.5)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)

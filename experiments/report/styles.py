"""How lines look: an agent the same in every figure, any two told apart without colour.

Within a figure no two lines share dashes, marker or lightness. The agents' colours can be told
apart with the common kinds of colour blindness and have lightness (L*) 16, 40, 49, 61 and 70.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import matplotlib
from matplotlib.colors import to_hex


@dataclasses.dataclass(frozen=True)
class Style:
    """Of a line; dashes as lengths on and off in line widths, none for a solid line."""

    color: str
    dashes: tuple[float, ...]
    marker: str

    def plot_arguments(self) -> dict[str, Any]:
        """For ``Axes.plot``."""
        return {
            "color": self.color,
            "linestyle": (0, self.dashes) if self.dashes else "-",
            "marker": self.marker,
        }


AGENTS = {
    "sacformer": Style("#0b1f66", (), "o"),
    "sac": Style("#b5262d", (5, 1.6), "s"),
    "td3": Style("#00837a", (1.2, 1.2), "^"),
    "ppo": Style("#c77cac", (6, 1.4, 1.2, 1.4), "D"),
    "ddpg": Style("#e0a01b", (3, 1.2, 1.2, 1.2, 1.2, 1.2), "v"),
}
_OTHERS = (
    ((), "p"),
    ((7, 2), "P"),
    ((1.2, 2.2), "X"),
    ((4, 1.4, 1.2, 1.4), "h"),
    ((2.4, 1.4), "<"),
    ((8, 1.4, 2.4, 1.4), ">"),
)
MOST_LINES = len(_OTHERS)
"""Lines that can be told apart in one panel."""
_PALEST = 0.82
"""Where the colour map ends: what is paler does not print."""
_DARKEST_BESIDE_AGENTS = 0.46
"""Where it begins beside two agents or more: SACFormer and SAC are darker."""


def styles_of(variants: Sequence[str]) -> dict[str, Style]:
    """A style for each of up to six variants: an agent's own, else by its place among the others,
    from dark to pale.
    """
    if len(variants) > MOST_LINES:
        raise ValueError(f"{len(variants)} lines in one panel; at most {MOST_LINES}")
    styles = {variant: AGENTS[variant] for variant in variants if variant in AGENTS}
    others = [variant for variant in variants if variant not in AGENTS]
    # Beside an agent the first, solid and darkest, is left out; beside more the darker ones, and
    # dashes like SAC's.
    offset, number = len(styles), max(1, len(others))
    darkest = (0.0, _PALEST / number, _DARKEST_BESIDE_AGENTS)[min(offset, 2)]
    colors = matplotlib.colormaps["viridis"]
    for place, variant in enumerate(others):
        dashes, marker = _OTHERS[offset + place]
        shade = darkest + (_PALEST - darkest) * place / max(1, number - 1)
        styles[variant] = Style(to_hex(colors(shade)), dashes, marker)
    return styles

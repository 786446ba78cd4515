"""What wrappers make of an environment, as plain facts: ours and Gymnasium's go by the same."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import numpy as np

Places = tuple[tuple[int, int], ...]
"""Parts of a vector, each ``(start, stop)``, in order."""


@dataclasses.dataclass(frozen=True)
class Wrapping:
    """The wrappers around an environment, innermost first; by default none.

    Attributes:
      hidden: places of the environment's own observation that are left out.
      action_delay: steps between choosing an action and its effect.
      stack_obs: K, observations seen as one, with the actions between them.
    """

    hidden: Places = ()
    action_delay: int = 0
    stack_obs: int = 1

    def words(self) -> tuple[str, ...]:
        """What a person reads of each."""
        hidden = sum(stop - start for start, stop in self.hidden)
        steps = "step" if self.action_delay == 1 else "steps"
        said = {
            f"{hidden} velocities hidden": bool(hidden),
            f"actions delayed by {self.action_delay} {steps}": self.action_delay > 0,
            f"{self.stack_obs} observations stacked": self.stack_obs > 1,
        }
        return tuple(words for words, holds in said.items() if holds)


UNWRAPPED = Wrapping()


def are_places(places: Any, size: int) -> bool:
    """Whether these are parts of a vector of ``size``, in order, none within another."""
    try:
        bounds = [0, *(bound for start, stop in places for bound in (start, stop)), size]
        rising = all(a <= b for a, b in itertools.pairwise(bounds))
        return rising and all(start < stop for start, stop in places)
    except (TypeError, ValueError):
        return False


def others(places: Places, size: int) -> Places:
    """The places of a vector of ``size`` that are not among these."""
    bounds = [0, *(bound for place in places for bound in place), size]
    between = zip(bounds[::2], bounds[1::2], strict=True)
    return tuple((start, stop) for start, stop in between if start < stop)


def neutral_action(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The action ``[A]`` that does least: 0, or the middle of bounds that leave 0 out."""
    return np.where((low <= 0) & (high >= 0), 0.0, (low + high) / 2).astype(np.float32)

"""Members of a run: what is trained side by side in one program, each from a seed of its own."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from sacformer_jax.config import Config


@dataclasses.dataclass(frozen=True)
class Member:
    """One of the trainings of a run.

    Attributes:
      name: unique within the run; its folder is called so.
      seed: of everything random.
      values: numeric settings in which it differs from the run's configuration, by field.
    """

    name: str
    seed: int
    values: dict[str, float] = dataclasses.field(default_factory=dict)

    def config(self, run: Config) -> Config:
        """The configuration that trains this member alone."""
        return run.replace(seeds=1, seed=self.seed, **self.values)


def seed_members(seeds: Sequence[int]) -> tuple[Member, ...]:
    """A member for each seed."""
    return tuple(Member(f"seed-{seed}", seed) for seed in seeds)

"""What every agent provides: pure functions, bound once to their static parts."""

from __future__ import annotations

import dataclasses
from typing import Protocol

import jax

from sacformer_jax.types import Context, Hyperparameters, LearnerState, PolicyState, Window

Metrics = dict[str, jax.Array]


class Act(Protocol):
    """``act(policy, context, key) -> action [N, A]``; the mean action where ``key`` is None."""

    def __call__(
        self, policy: PolicyState, context: Context, key: jax.Array | None
    ) -> jax.Array: ...


class Update(Protocol):
    """``update(learner, hyper, window, key) -> (learner, metrics)``: one gradient update."""

    def __call__(
        self, learner: LearnerState, hyper: Hyperparameters, window: Window, key: jax.Array
    ) -> tuple[LearnerState, Metrics]: ...


class Init(Protocol):
    """``init(key) -> learner``."""

    def __call__(self, key: jax.Array) -> LearnerState: ...


@dataclasses.dataclass(frozen=True)
class Agent:
    """An algorithm as three pure functions.

    Attributes:
      init: makes the learner state.
      act: chooses actions from contexts.
      update: one gradient update on a batch of windows.
    """

    init: Init
    act: Act
    update: Update

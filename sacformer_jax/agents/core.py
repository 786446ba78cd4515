"""What every agent provides: pure functions, bound once to their static parts."""

from __future__ import annotations

import dataclasses
from typing import Protocol

import jax

from sacformer_jax.types import (
    Acted,
    Cache,
    Context,
    Hyperparameters,
    LearnerState,
    PolicyState,
    Window,
)

Metrics = dict[str, jax.Array]


class Act(Protocol):
    """``act(policy, context, key, explore) -> Acted``: a random action, or the mean one.

    ``explore`` is static. Without it the key matters only where dropout is on in acting.
    """

    def __call__(
        self, policy: PolicyState, context: Context, key: jax.Array, explore: bool
    ) -> Acted: ...


class Update(Protocol):
    """``update(learner, hyper, window, key) -> (learner, metrics)``: one gradient update."""

    def __call__(
        self, learner: LearnerState, hyper: Hyperparameters, window: Window, key: jax.Array
    ) -> tuple[LearnerState, Metrics]: ...


class Init(Protocol):
    """``init(key) -> learner``."""

    def __call__(self, key: jax.Array) -> LearnerState: ...


class InitCache(Protocol):
    """``init_cache(num_envs) -> cache``: of contexts at the start of their episodes."""

    def __call__(self, num_envs: int) -> Cache: ...


@dataclasses.dataclass(frozen=True)
class Agent:
    """An algorithm as pure functions.

    Attributes:
      init: makes the learner state.
      init_cache: makes what a context keeps of its whole episode; empty where that is nothing.
      act: chooses actions from contexts.
      update: one gradient update on a batch of windows. Where a tensor is not finite the networks
        that it would reach stay as they are; the metric ``fault`` is its place in ``checked``, or
        -1.
      checked: names of the tensors that are looked at, in the order in which they come about.
    """

    init: Init
    init_cache: InitCache
    act: Act
    update: Update
    checked: tuple[str, ...]

"""What every agent provides: pure functions, bound once to their static parts."""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol

import flax.struct
import jax

from sacformer_jax import normalizer
from sacformer_jax.parallel import DataAxis
from sacformer_jax.types import (
    Acted,
    Cache,
    Context,
    Hyperparameters,
    LearnerState,
    Normalizer,
    PolicyState,
    Rollout,
)

Metrics = dict[str, jax.Array]


@dataclasses.dataclass(frozen=True)
class AgentParts:
    """What the static parts of every agent have.

    Attributes:
      normalize_obs: use the running observation statistics.
      data: how environments and batches are split over devices.
    """

    normalize_obs: bool
    data: DataAxis

    def normalized(self, statistics: Normalizer, obs: jax.Array) -> jax.Array:
        """Observations as the networks see them."""
        return normalizer.normalize(statistics, obs) if self.normalize_obs else obs


class Act(Protocol):
    """``act(policy, context, key, explore) -> Acted``: a random action, or the mean one.

    ``explore`` is static. Without it the key matters only where dropout is on in acting.
    """

    def __call__(
        self, policy: PolicyState, context: Context, key: jax.Array, explore: bool
    ) -> Acted: ...


class Update(Protocol):
    """``update(learner, hyper, batch, key) -> (learner, metrics)``: one gradient update.

    The batch is a :class:`~sacformer_jax.types.Window`, or rows of :attr:`Prepared.samples`.
    """

    def __call__(
        self, learner: LearnerState, hyper: Hyperparameters, batch: Any, key: jax.Array, /
    ) -> tuple[LearnerState, Metrics]: ...


@flax.struct.dataclass
class Prepared:
    """What an agent without a replay makes of a rollout of T steps before it learns from them.

    Attributes:
      learner: with the statistics of rewards moved on.
      samples: what its updates learn from: leaves ``[T * N, ...]``, a row for each step.
      discounted_return: ``[N]`` of the running episodes, after the last step.
      metrics: of the rollout as a whole.
    """

    learner: LearnerState
    samples: Any
    discounted_return: jax.Array
    metrics: Metrics


class Prepare(Protocol):
    """``prepare(learner, hyper, rollout, discounted_return) -> Prepared``.

    The learner's observation statistics are those to learn with; ``discounted_return [N]`` is that
    of the running episodes before the first step.
    """

    def __call__(
        self,
        learner: LearnerState,
        hyper: Hyperparameters,
        rollout: Rollout,
        discounted_return: jax.Array,
    ) -> Prepared: ...


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
      update: one gradient update on a batch. Where a tensor is not finite the networks that it
        would reach stay as they are; the metric ``fault`` is its place in ``checked``, or -1.
      checked: names of the tensors that are looked at, in the order in which they come about.
      prepare: makes a rollout ready to learn from, of an agent that keeps no replay; None for those
        that do.
      pretrain: like ``update``, but the actor does as the steps of the batch show; None for agents
        that cannot.
    """

    init: Init
    init_cache: InitCache
    act: Act
    update: Update
    checked: tuple[str, ...]
    prepare: Prepare | None = None
    pretrain: Update | None = None

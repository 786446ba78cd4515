"""Learning from a replay: every update draws a batch of windows."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp

from sacformer_jax.agents.core import Agent, Metrics, Update
from sacformer_jax.buffer import TrajectoryBuffer, weighted_by_share
from sacformer_jax.parallel import DataAxis
from sacformer_jax.types import BufferState, Hyperparameters, LearnerState, TrainState


@dataclasses.dataclass(frozen=True)
class ReplayLearning:
    """The updates of an iteration, on what the replay holds.

    Attributes:
      agent: the algorithm.
      buffer: the replay's functions.
      batch_size: windows in a batch, over all shards.
      data: how replay and batch are split over devices.
    """

    agent: Agent
    buffer: TrajectoryBuffer
    batch_size: int
    data: DataAxis

    def learn(
        self, state: TrainState, key: jax.Array, num_updates: int
    ) -> tuple[TrainState, Metrics, jax.Array]:
        """The state after ``num_updates`` updates, their metrics, and how many count (int32)."""
        return self._many(self.agent.update, state, key, num_updates)

    def pretrain(
        self, state: TrainState, key: jax.Array, num_updates: int
    ) -> tuple[TrainState, Metrics, jax.Array]:
        """The same with updates of pretraining."""
        assert self.agent.pretrain is not None
        return self._many(self.agent.pretrain, state, key, num_updates)

    def _many(
        self, update: Update, state: TrainState, key: jax.Array, num_updates: int
    ) -> tuple[TrainState, Metrics, jax.Array]:
        assert state.buffer is not None
        learner, metrics = jax.lax.scan(
            partial(self._one, update, state.buffer, state.hyper),
            state.learner,
            jax.random.split(key, num_updates),
        )
        done = jnp.int32(num_updates)
        if self.buffer.scattered:
            # Episodes shorter than K may leave nothing to learn from; momentum must not move on.
            learnt = self.data.count(self.buffer.num_drawable(state.buffer)) > 0
            learner = jax.tree.map(partial(jnp.where, learnt), learner, state.learner)
            done = jnp.where(learnt, done, 0)
        return dataclasses.replace(state, learner=learner), metrics, done

    def update(
        self, buffer: BufferState, hyper: Hyperparameters, learner: LearnerState, key: jax.Array
    ) -> tuple[LearnerState, Metrics]:
        """One update, on a batch drawn for it."""
        return self._one(self.agent.update, buffer, hyper, learner, key)

    def _one(
        self,
        update: Update,
        buffer: BufferState,
        hyper: Hyperparameters,
        learner: LearnerState,
        key: jax.Array,
    ) -> tuple[LearnerState, Metrics]:
        sample_key, update_key = jax.random.split(key)
        batch_size = self.batch_size // self.data.size
        window = self.buffer.sample(
            buffer, self.data.own_key(sample_key), batch_size, hyper.rtg_discount
        )
        if self.data.size > 1:
            window = weighted_by_share(window, self.buffer.num_drawable(buffer))
        return update(learner, hyper, window, update_key)

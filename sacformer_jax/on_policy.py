"""Learning from an agent's own newest steps: all of them, several times over, then never again.

Letters: T steps of N environments, M = T · N of them in all, E epochs, P minibatches of each.
"""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp

from sacformer_jax.agents.core import Agent, Metrics
from sacformer_jax.parallel import DataAxis
from sacformer_jax.types import LearnerState, Normalizer, Rollout, TrainState


@dataclasses.dataclass(frozen=True)
class RolloutLearning:
    """A round of updates on a rollout.

    Over several devices each has its own environments' steps, shuffles them by itself and takes
    its share of every minibatch from them.

    Attributes:
      agent: the algorithm, with ``prepare``.
      epochs: E.
      minibatches: P, must divide M.
      data: how environments and minibatches are split over devices.
    """

    agent: Agent
    epochs: int
    minibatches: int
    data: DataAxis

    def learn(
        self, state: TrainState, acted_with: Normalizer, rollout: Rollout, key: jax.Array
    ) -> tuple[TrainState, Metrics]:
        """The state after a round, and the metrics of its updates, ``[E · P]``.

        A round learns with the observation statistics that it was acted with, so that the
        probability ratio compares the policies and nothing else; those that the rollout has been
        added to are for the next one. Only the first round, acted without any, learns with its own:
        its policy, whose head starts near zero, hardly looks at observations yet.

        Args:
          state: after collecting.
          acted_with: the observation statistics before.
          rollout: what was collected.
          key: typed PRNG key of the shuffling.
        """
        prepare = self.agent.prepare
        assert prepare is not None
        assert state.discounted_return is not None
        seen = state.learner.normalizer
        used = jax.tree.map(partial(jnp.where, acted_with.count > 0), acted_with, seen)
        prepared = prepare(
            dataclasses.replace(state.learner, normalizer=used),
            state.hyper,
            rollout,
            state.discounted_return,
        )

        def update(learner: LearnerState, rows: jax.Array) -> tuple[LearnerState, Metrics]:
            samples = jax.tree.map(lambda leaf: leaf[rows], prepared.samples)
            return self.agent.update(learner, state.hyper, samples, key)

        shuffled = self.shuffled(key, rollout.reward.size)  # [E · P, M / P]
        learner, metrics = jax.lax.scan(update, prepared.learner, shuffled)
        of_round = {
            name: jnp.broadcast_to(value, shuffled.shape[:1])
            for name, value in prepared.metrics.items()
        }
        state = dataclasses.replace(
            state,
            learner=dataclasses.replace(learner, normalizer=seen),
            discounted_return=prepared.discounted_return,
        )
        return state, {**metrics, **of_round}

    def shuffled(self, key: jax.Array, num: int) -> jax.Array:
        """int32 ``[E · P, num / P]``: which of this shard's ``num`` steps each update learns from.

        The P of an epoch have every step once.
        """
        # Sorted by one draw of 32 bits each: twice as fast as jax.random.permutation, which sorts
        # again to part the few that are equal.
        bits = jax.random.bits(self.data.own_key(key), (self.epochs, num))
        order = jnp.argsort(bits, axis=-1).astype(jnp.int32)  # [E, num]
        return order.reshape(self.epochs * self.minibatches, -1)

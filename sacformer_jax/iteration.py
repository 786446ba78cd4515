"""What a training program does: initial state, prefill, iterations, and what they count.

One iteration collects a few steps of all environments and then makes the gradient updates that
``updates_per_env_step`` asks for, on batches from the replay; or, for an agent without a replay, a
rollout of more steps and then a round of updates on it. A chunk scans many iterations.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from sacformer_jax import normalizer, rollout
from sacformer_jax.agents.core import Agent, Metrics
from sacformer_jax.agents.faults import NO_FAULT
from sacformer_jax.buffer import TrajectoryBuffer
from sacformer_jax.config import Config
from sacformer_jax.envs import VectorEnv
from sacformer_jax.on_policy import RolloutLearning
from sacformer_jax.replay_learning import ReplayLearning
from sacformer_jax.rollout import RolloutState, RolloutStats
from sacformer_jax.types import (
    Acted,
    Context,
    Counters,
    Hyperparameters,
    LearnerState,
    PolicyState,
    Rollout,
    TrainState,
)

_LOOKING_STREAM = 2**31
"""Folded into a key of prefill, apart from the random action."""


def policy_of(state: TrainState) -> PolicyState:
    """What acting needs of a train state."""
    return policy_state(state.learner, state.hyper)


def policy_state(learner: LearnerState, hyper: Hyperparameters) -> PolicyState:
    """What acting needs of a learner."""
    return PolicyState(
        actor_params=learner.actor_params,
        normalizer=learner.normalizer,
        target_return=hyper.target_return,
        return_scale=hyper.return_scale,
    )


@dataclasses.dataclass(frozen=True)
class TrainingFunctions:
    """The pure functions behind a :class:`~sacformer_jax.train.Program`.

    Attributes:
      config: the configuration.
      env: the vectorized training environment.
      agent: the algorithm.
      learning: what it learns from.
    """

    config: Config
    env: VectorEnv
    agent: Agent
    learning: ReplayLearning | RolloutLearning

    @property
    def buffer(self) -> TrajectoryBuffer | None:
        return self.learning.buffer if isinstance(self.learning, ReplayLearning) else None

    def init(self, key: jax.Array, hyper: Hyperparameters) -> TrainState:
        key, learner_key, env_key = jax.random.split(key, 3)
        start = self._start(env_key)
        zero = jnp.zeros((), jnp.int32)
        learner = self.agent.init(learner_key)
        if learner.log_alpha is not None:
            learner = dataclasses.replace(learner, log_alpha=jnp.log(hyper.alpha))
        return TrainState(
            learner=learner,
            hyper=hyper,
            env=start.env,
            context=start.context,
            buffer=start.buffer,
            counters=Counters(zero, zero, zero, jnp.int32(NO_FAULT), zero, zero),
            key=key,
            discounted_return=jnp.zeros(self.env.num_envs) if start.buffer is None else None,
        )

    def _start(self, key: jax.Array) -> RolloutState:
        cache = self.agent.init_cache(self.env.num_envs)
        context_length = self.config.context.context_length
        return rollout.start(self.env, self.buffer, context_length, cache, key)

    def _exploring(self, policy: PolicyState) -> rollout.ChooseAction:
        return lambda context, key: self.agent.act(policy, context, key, explore=True)

    def refill(self, state: TrainState) -> tuple[TrainState, Metrics]:
        key, env_key = jax.random.split(state.key)
        start, exploring = self._start(env_key), self._exploring(policy_of(state))
        state = dataclasses.replace(
            state, env=start.env, context=start.context, buffer=start.buffer, key=key
        )

        state, stats, _ = self._collect(state, exploring, self.config.prefill_vector_steps)
        return state, stats.metrics()

    def prefill(self, state: TrainState) -> tuple[TrainState, Metrics]:
        if self.buffer is None:
            return state, {}

        def random_action(context: Context, key: jax.Array) -> Acted:
            if self.config.context.acting_context == "episode":
                # The policy looks on, so that it knows the episodes that it will go on with.
                policy, look_key = policy_of(state), jax.random.fold_in(key, _LOOKING_STREAM)
                context = self.agent.act(policy, context, look_key, explore=False).context
            return Acted(self.env.random_action(key), context)

        state, stats, _ = self._collect(state, random_action, self.config.prefill_vector_steps)
        return state, stats.metrics()

    def pretrain_chunk(self, state: TrainState) -> tuple[TrainState, Metrics]:
        learning, num_updates = self.learning, self.config.updates_per_pretrain_chunk
        assert isinstance(learning, ReplayLearning)
        key, updates_key = jax.random.split(state.key)
        state, metrics, done = learning.pretrain(state, updates_key, num_updates)
        counters = _counted(state.counters, metrics["fault"], done)
        return dataclasses.replace(state, counters=counters, key=key), _update_means(metrics)

    def train_chunk(self, state: TrainState) -> tuple[TrainState, Metrics]:
        def scanned(state: TrainState, _: None) -> tuple[TrainState, Any]:
            return self._iteration(state)

        state, (stats, update_metrics) = jax.lax.scan(
            scanned, state, length=self.config.iterations_per_chunk
        )
        return state, {**stats.total().metrics(), **_update_means(update_metrics)}

    def _iteration(self, state: TrainState) -> tuple[TrainState, tuple[RolloutStats, Metrics]]:
        """Collects, then updates; metrics lead with the update axis."""
        num_steps, num_updates = self.config.steps_and_updates
        policy = policy_of(state)
        exploring = self._exploring(policy)
        state, stats, steps = self._collect(state, exploring, num_steps)
        key, updates_key = jax.random.split(state.key)
        if isinstance(self.learning, ReplayLearning):
            state, metrics, done = self.learning.learn(state, updates_key, num_updates)
        else:
            assert steps is not None
            state, metrics = self.learning.learn(state, policy.normalizer, steps, updates_key)
            done = jnp.int32(num_updates)
        counters = _counted(state.counters, metrics["fault"], done)
        return dataclasses.replace(state, counters=counters, key=key), (stats, metrics)

    def _collect(
        self, state: TrainState, choose_action: rollout.ChooseAction, num_steps: int
    ) -> tuple[TrainState, RolloutStats, Rollout | None]:
        """The steps are given only where no replay holds them."""
        key, collect_key = jax.random.split(state.key)
        start = RolloutState(state.env, state.context, state.buffer)
        env, steps = self.env, None
        if self.buffer is None:
            collected, stats, steps = rollout.collect_rollout(
                env, choose_action, start, collect_key, num_steps
            )
            obs = steps.obs
        else:
            collected, stats, obs = rollout.collect(
                env, self.buffer, choose_action, start, collect_key, num_steps
            )
        learner = state.learner
        if self.config.context.normalize_obs:
            learner = dataclasses.replace(
                learner,
                normalizer=normalizer.update(learner.normalizer, obs, self.env.data),
            )
        hyper, counters = state.hyper, state.counters
        if self.config.context.target_return == "auto":
            best = jnp.maximum(hyper.target_return, stats.return_max)
            hyper = dataclasses.replace(hyper, target_return=best)
        counters = dataclasses.replace(
            counters,
            env_steps=counters.env_steps + num_steps * self.env.num_envs * self.env.data.size,
            episodes=counters.episodes + stats.episodes,
            bad_physics=counters.bad_physics + stats.bad_physics,
        )
        state = dataclasses.replace(
            state,
            learner=learner,
            hyper=hyper,
            env=collected.env,
            context=collected.context,
            buffer=collected.buffer,
            counters=counters,
            key=key,
        )
        return state, stats, steps


def _counted(counters: Counters, fault: jax.Array, done: jax.Array) -> Counters:
    """With ``done`` more updates, whose faults are ``[U]``; none of them counts if it is 0."""
    skipped = (fault != NO_FAULT) & (done > 0)
    first_here = jnp.where(jnp.any(skipped), fault[jnp.argmax(skipped)], NO_FAULT)
    return dataclasses.replace(
        counters,
        updates=counters.updates + done,
        skipped_updates=counters.skipped_updates + jnp.sum(skipped, dtype=jnp.int32),
        first_fault=jnp.where(counters.first_fault == NO_FAULT, first_here, counters.first_fault),
    )


def _update_means(metrics: Metrics) -> Metrics:
    """Means over the updates that were not skipped (NaN without any), and how many were."""
    fault = metrics.pop("fault")
    sound = fault == NO_FAULT
    means = {
        name: jnp.sum(jnp.where(sound, values, 0.0)) / jnp.sum(sound)
        for name, values in metrics.items()
    }
    return {**means, "skipped_updates": jnp.sum(~sound, dtype=jnp.int32)}

"""The training program: ``init``, ``prefill`` and ``train_chunk``, pure and jitted once.

One iteration collects a few steps of all environments and then makes the gradient updates that
``updates_per_env_step`` asks for; a chunk scans many iterations in one donated call.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from sacformer_jax import agents, normalizer, rollout
from sacformer_jax.agents.core import Agent
from sacformer_jax.agents.faults import NO_FAULT
from sacformer_jax.buffer import TrajectoryBuffer, weighted_by_share
from sacformer_jax.config import Config
from sacformer_jax.envs import VectorEnv, make_env
from sacformer_jax.parallel import UNDIVIDED, DataAxis
from sacformer_jax.rollout import RolloutState, RolloutStats
from sacformer_jax.types import (
    Acted,
    BufferState,
    Context,
    Counters,
    Hyperparameters,
    LearnerState,
    PolicyState,
    TrainState,
)

Metrics = dict[str, jax.Array]
UpdateFromReplay = Callable[
    [BufferState, Hyperparameters, LearnerState, jax.Array], tuple[LearnerState, Metrics]
]

_LOOKING_STREAM = 2**31
"""Folded into a key of prefill, apart from the random action."""


@dataclasses.dataclass(frozen=True)
class Program:
    """A configuration compiled into pure functions.

    Attributes:
      config: what it was made from.
      env: the vectorized training environment.
      agent: the algorithm.
      buffer: the replay's functions.
      init: ``(key, hyper) -> TrainState``; without ``hyper`` it is :func:`hyperparameters`.
      prefill: ``TrainState -> (TrainState, metrics)``, random actions; the argument is donated.
      refill: the same as ``prefill`` from fresh episodes, under the policy, whatever the state's
        environments and replay were (None perhaps); the argument is not donated.
      train_chunk: ``TrainState -> (TrainState, metrics)``, one chunk; the argument is donated.
      update: ``(buffer state, hyper, learner, key) -> (learner, metrics)``, one gradient update on
        a batch from the replay; part of ``train_chunk``, not jitted by itself.
    """

    config: Config
    env: VectorEnv
    agent: Agent
    buffer: TrajectoryBuffer
    init: jax.stages.Wrapped
    prefill: jax.stages.Wrapped
    refill: jax.stages.Wrapped
    train_chunk: jax.stages.Wrapped
    update: UpdateFromReplay


def make_training_env(
    config: Config, num_envs: int | None = None, data: DataAxis = UNDIVIDED
) -> VectorEnv:
    """The configuration's environment, vectorized; ``num_envs`` other than its own if given."""
    task = config.task
    env = make_env(task.env, task.engine, task.brax_backend, task.mjx_preset, task.mjx_impl)
    num_envs = task.num_envs if num_envs is None else num_envs
    return VectorEnv(env, num_envs, task.max_episode_steps, data)


def make_program(
    config: Config, env: VectorEnv | None = None, data: DataAxis = UNDIVIDED
) -> Program:
    """Binds a valid configuration to its pure functions.

    Args:
      config: see :meth:`Config.validated`.
      env: use this vectorized environment instead of the one ``config.task`` names.
      data: how environments, replay and batch are split; with more than one shard the functions
        are those of a shard (see :class:`~sacformer_jax.parallel.DataAxis`), and ``env``, where
        given, must be split alike.

    Raises:
      ConfigError: a setting cannot work.
      ValueError: the environment does not exist.
    """
    config.validated()
    env = make_training_env(config, data=data) if env is None else env
    agent = agents.make(config, env.spec, data)
    buffer = TrajectoryBuffer(
        num_envs=env.num_envs,
        length=config.replay.buffer_capacity // (env.num_envs * data.size),
        obs_size=env.spec.obs_size,
        action_size=env.spec.action_size,
        context_length=config.context.context_length,
        max_episode_steps=env.max_episode_steps,
        hindsight=config.context.return_conditioning == "hindsight",
        scattered=config.context.window == "scattered",
    )
    functions = _TrainingFunctions(config, env, agent, buffer)
    return Program(
        config=config,
        env=env,
        agent=agent,
        buffer=buffer,
        init=jax.jit(functions.init),
        prefill=jax.jit(functions.prefill, donate_argnums=0),
        refill=jax.jit(functions.refill),
        train_chunk=jax.jit(functions.train_chunk, donate_argnums=0),
        update=functions.update,
    )


def hyperparameters(config: Config, action_size: int) -> Hyperparameters:
    """The numeric settings as arrays of the train state."""
    sac, context = config.sac, config.context
    target_entropy = -float(action_size) if sac.target_entropy is None else sac.target_entropy
    numbers = {
        "actor_learning_rate": sac.actor_learning_rate,
        "critic_learning_rate": sac.critic_learning_rate,
        "alpha_learning_rate": sac.alpha_learning_rate,
        "discount": sac.discount,
        "tau": sac.tau,
        "target_entropy": target_entropy,
        "target_return": 0.0 if context.target_return == "auto" else context.target_return,
        "return_scale": context.return_scale,
        "hindsight_scale": context.hindsight_scale or context.return_scale,
        "rtg_discount": context.rtg_discount,
        "alpha": sac.alpha,
    }
    return Hyperparameters(**{name: jnp.float32(value) for name, value in numbers.items()})


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
class _TrainingFunctions:
    """The pure functions behind a :class:`Program`."""

    config: Config
    env: VectorEnv
    agent: Agent
    buffer: TrajectoryBuffer

    def init(self, key: jax.Array, hyper: Hyperparameters | None = None) -> TrainState:
        if hyper is None:
            hyper = hyperparameters(self.config, self.env.spec.action_size)
        key, learner_key, env_key = jax.random.split(key, 3)
        start = self._start(env_key)
        zero = jnp.zeros((), jnp.int32)
        learner = self.agent.init(learner_key)
        return TrainState(
            learner=dataclasses.replace(learner, log_alpha=jnp.log(hyper.alpha)),
            hyper=hyper,
            env=start.env,
            context=start.context,
            buffer=start.buffer,
            counters=Counters(zero, zero, zero, jnp.int32(NO_FAULT), zero, zero),
            key=key,
        )

    def _start(self, key: jax.Array) -> RolloutState:
        cache = self.agent.init_cache(self.env.num_envs)
        return rollout.start(self.env, self.buffer, cache, key)

    def refill(self, state: TrainState) -> tuple[TrainState, Metrics]:
        key, env_key = jax.random.split(state.key)
        start, policy = self._start(env_key), policy_of(state)
        state = dataclasses.replace(
            state, env=start.env, context=start.context, buffer=start.buffer, key=key
        )

        def choose_action(context: Context, key: jax.Array) -> Acted:
            return self.agent.act(policy, context, key, explore=True)

        state, stats = self._collect(state, choose_action, self.config.prefill_vector_steps)
        return state, _episode_metrics(stats)

    def prefill(self, state: TrainState) -> tuple[TrainState, Metrics]:
        def random_action(context: Context, key: jax.Array) -> Acted:
            if self.config.context.acting_context == "episode":
                # The policy looks on, so that it knows the episodes that it will go on with.
                policy, look_key = policy_of(state), jax.random.fold_in(key, _LOOKING_STREAM)
                context = self.agent.act(policy, context, look_key, explore=False).context
            return Acted(self.env.random_action(key), context)

        state, stats = self._collect(state, random_action, self.config.prefill_vector_steps)
        return state, _episode_metrics(stats)

    def train_chunk(self, state: TrainState) -> tuple[TrainState, Metrics]:
        def scanned(state: TrainState, _: None) -> tuple[TrainState, Any]:
            return self._iteration(state)

        state, (stats, update_metrics) = jax.lax.scan(
            scanned, state, length=self.config.iterations_per_chunk
        )
        return state, {**_episode_metrics(stats.total()), **_update_means(update_metrics)}

    def _iteration(self, state: TrainState) -> tuple[TrainState, tuple[RolloutStats, Metrics]]:
        """Collects, then updates; metrics lead with the update axis."""
        num_steps, num_updates = self.config.steps_and_updates
        policy = policy_of(state)

        def choose_action(context: Context, key: jax.Array) -> Acted:
            return self.agent.act(policy, context, key, explore=True)

        state, stats = self._collect(state, choose_action, num_steps)

        key, updates_key = jax.random.split(state.key)
        learner, metrics = jax.lax.scan(
            partial(self.update, state.buffer, state.hyper),
            state.learner,
            jax.random.split(updates_key, num_updates),
        )
        done, skipped = jnp.int32(num_updates), metrics["fault"] != NO_FAULT
        if self.buffer.scattered:
            # Episodes shorter than K may leave nothing to learn from; momentum must not move on.
            learnt = self.env.data.count(self.buffer.num_drawable(state.buffer)) > 0
            learner = jax.tree.map(partial(jnp.where, learnt), learner, state.learner)
            done, skipped = jnp.where(learnt, done, 0), skipped & learnt
        counters = state.counters
        first_here = jnp.where(jnp.any(skipped), metrics["fault"][jnp.argmax(skipped)], NO_FAULT)
        counters = dataclasses.replace(
            counters,
            updates=counters.updates + done,
            skipped_updates=counters.skipped_updates + jnp.sum(skipped, dtype=jnp.int32),
            first_fault=jnp.where(
                counters.first_fault == NO_FAULT, first_here, counters.first_fault
            ),
        )
        return dataclasses.replace(state, learner=learner, counters=counters, key=key), (
            stats,
            metrics,
        )

    def update(
        self, buffer: BufferState, hyper: Hyperparameters, learner: LearnerState, key: jax.Array
    ) -> tuple[LearnerState, Metrics]:
        data = self.env.data
        sample_key, update_key = jax.random.split(key)
        batch_size = self.config.replay.batch_size // data.size
        window = self.buffer.sample(
            buffer, data.own_key(sample_key), batch_size, hyper.rtg_discount
        )
        if data.size > 1:
            window = weighted_by_share(window, self.buffer.num_drawable(buffer))
        return self.agent.update(learner, hyper, window, update_key)

    def _collect(
        self, state: TrainState, choose_action: rollout.ChooseAction, num_steps: int
    ) -> tuple[TrainState, RolloutStats]:
        key, collect_key = jax.random.split(state.key)
        collected, stats, obs = rollout.collect(
            self.env,
            self.buffer,
            choose_action,
            RolloutState(state.env, state.context, state.buffer),
            collect_key,
            num_steps,
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
        return state, stats


def _update_means(metrics: Metrics) -> Metrics:
    """Means over the updates that were not skipped (NaN without any), and how many were."""
    fault = metrics.pop("fault")
    sound = fault == NO_FAULT
    means = {
        name: jnp.sum(jnp.where(sound, values, 0.0)) / jnp.sum(sound)
        for name, values in metrics.items()
    }
    return {**means, "skipped_updates": jnp.sum(~sound, dtype=jnp.int32)}


def _episode_metrics(stats: RolloutStats) -> Metrics:
    """Means over the finished episodes; NaN where none finished."""
    episodes = stats.episodes.astype(jnp.float32)
    return {
        "episodes": stats.episodes,
        "episode_return_mean": stats.return_sum / episodes,
        "episode_return_max": jnp.where(episodes > 0, stats.return_max, jnp.nan),
        "episode_length_mean": stats.length_sum / episodes,
        "bad_physics": stats.bad_physics,
    }

"""The training program: ``init``, ``prefill`` and ``train_chunk``, pure and jitted once.

What they do is in :mod:`sacformer_jax.iteration`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp

from sacformer_jax import agents
from sacformer_jax.agents.core import Agent, Metrics
from sacformer_jax.buffer import TrajectoryBuffer
from sacformer_jax.config import Config
from sacformer_jax.envs import VectorEnv, make_env, wrapped
from sacformer_jax.iteration import TrainingFunctions, policy_of, policy_state
from sacformer_jax.on_policy import RolloutLearning
from sacformer_jax.parallel import UNDIVIDED, DataAxis
from sacformer_jax.replay_learning import ReplayLearning
from sacformer_jax.types import BufferState, Hyperparameters, LearnerState, TrainState

__all__ = [
    "Metrics",
    "Program",
    "hyperparameters",
    "make_program",
    "make_training_env",
    "policy_of",
    "policy_state",
]

UpdateFromReplay = Callable[
    [BufferState, Hyperparameters, LearnerState, jax.Array], tuple[LearnerState, Metrics]
]


@dataclasses.dataclass(frozen=True)
class Program:
    """A configuration compiled into pure functions.

    Attributes:
      config: what it was made from.
      env: the vectorized training environment.
      agent: the algorithm.
      replay: how it learns from its replay; None for an agent that keeps none.
      init: ``(key, hyper) -> TrainState``; without ``hyper`` it is :func:`hyperparameters`.
      prefill: ``TrainState -> (TrainState, metrics)``, random actions (none without a replay); the
        argument is donated.
      refill: the same as ``prefill`` from fresh episodes, under the policy, whatever the state's
        environments and replay were (None perhaps); the argument is not donated.
      train_chunk: ``TrainState -> (TrainState, metrics)``, one chunk; the argument is donated.
      pretrain_chunk: ``TrainState -> (TrainState, metrics)``, imitation of what the replay holds,
        without a step of the environments; the argument is donated. None where the configuration
        asks for none.
    """

    config: Config
    env: VectorEnv
    agent: Agent
    replay: ReplayLearning | None
    init: jax.stages.Wrapped
    prefill: jax.stages.Wrapped
    refill: jax.stages.Wrapped
    train_chunk: jax.stages.Wrapped
    pretrain_chunk: jax.stages.Wrapped | None

    @property
    def buffer(self) -> TrajectoryBuffer:
        """The replay's functions.

        Raises:
          ValueError: the agent keeps no replay.
        """
        return self._kept_replay().buffer

    @property
    def update(self) -> UpdateFromReplay:
        """``(buffer state, hyper, learner, key) -> (learner, metrics)``, not jitted by itself: one
        gradient update on a batch from the replay, a part of ``train_chunk``.

        Raises:
          ValueError: the agent keeps no replay.
        """
        return self._kept_replay().update

    def _kept_replay(self) -> ReplayLearning:
        if self.replay is None:
            raise ValueError(f"agent={self.config.agent} keeps no replay")
        return self.replay


def make_training_env(
    config: Config, num_envs: int | None = None, data: DataAxis = UNDIVIDED
) -> VectorEnv:
    """The configuration's environment with its wrappers, vectorized; ``num_envs`` other than its
    own if given.
    """
    task = config.task
    env = make_env(
        task.env,
        task.engine,
        task.brax_backend,
        task.mjx_preset,
        task.mjx_impl,
        task.max_episode_steps,
    )
    env = wrapped(env, task.hide_velocities, task.action_delay, task.stack_obs)
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
    learning = _learning(config, env, agent)
    functions = TrainingFunctions(config, env, agent, learning)

    def init(key: jax.Array, hyper: Hyperparameters | None = None) -> TrainState:
        if hyper is None:
            hyper = hyperparameters(config, env.spec.action_size)
        return functions.init(key, hyper)

    return Program(
        config=config,
        env=env,
        agent=agent,
        replay=learning if isinstance(learning, ReplayLearning) else None,
        init=jax.jit(init),
        prefill=jax.jit(functions.prefill, donate_argnums=0),
        refill=jax.jit(functions.refill),
        train_chunk=jax.jit(functions.train_chunk, donate_argnums=0),
        pretrain_chunk=jax.jit(functions.pretrain_chunk, donate_argnums=0)
        if config.offline.pretrain_updates
        else None,
    )


def _learning(config: Config, env: VectorEnv, agent: Agent) -> ReplayLearning | RolloutLearning:
    """What the agent learns from."""
    if agent.prepare is not None:
        return RolloutLearning(agent, config.ppo.epochs, config.ppo.minibatches, env.data)
    buffer = TrajectoryBuffer(
        num_envs=env.num_envs,
        length=config.replay.buffer_capacity // (env.num_envs * env.data.size),
        obs_size=env.spec.obs_size,
        action_size=env.spec.action_size,
        context_length=config.context.steps_to_learn,
        burn_in=config.context.burn_in,
        max_episode_steps=env.max_episode_steps,
        hindsight=config.context.return_conditioning == "hindsight",
        scattered=config.context.window == "scattered",
    )
    return ReplayLearning(agent, buffer, config.replay.batch_size, env.data)


def hyperparameters(config: Config, action_size: int) -> Hyperparameters:
    """The numeric settings as arrays of the train state."""
    learning, context = config.learning, config.context
    target_entropy = (
        -float(action_size) if learning.target_entropy is None else learning.target_entropy
    )
    numbers = {
        "actor_learning_rate": learning.actor_learning_rate,
        "critic_learning_rate": learning.critic_learning_rate,
        "alpha_learning_rate": learning.alpha_learning_rate,
        "discount": learning.discount,
        "tau": learning.tau,
        "target_entropy": target_entropy,
        "target_return": 0.0 if context.target_return == "auto" else context.target_return,
        "return_scale": context.return_scale,
        "hindsight_scale": context.hindsight_scale or context.return_scale,
        "rtg_discount": context.rtg_discount,
        "alpha": learning.alpha,
    }
    return Hyperparameters(**{name: jnp.float32(value) for name, value in numbers.items()})

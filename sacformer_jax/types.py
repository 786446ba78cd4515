"""The structs that flow through training, with their shapes.

Letters: N environments, T ring length per environment, B windows, K context length, O observation
size, A action size. Everything is float32 unless said otherwise.
"""

from __future__ import annotations

from typing import Any

import flax.struct
import jax

from sacformer_jax.envs.core import VectorEnvState

Params = Any
Cache = Any


@flax.struct.dataclass
class Context:
    """The last K (return, state) pairs of each running episode, left-padded.

    The newest pair, the state to act on, is the last one. ``[N]`` leads every shape.

    Attributes:
      obs: ``[N, K, O]`` raw observations.
      action: ``[N, K, A]`` the actions taken; zero at the newest pair.
      return_so_far: ``[N, K]`` reward collected in the episode before that state.
      time_step: int32 ``[N, K]`` steps taken in the episode before that state.
      mask: bool ``[N, K]`` whether the pair exists.
      cache: with ``acting_context="episode"``, the keys and values of the episode's tokens up to
        the pair before the newest, ``[N, ...]``; otherwise empty. It needs no clearing: the time
        step tells what belongs to the running episode.
    """

    obs: jax.Array
    action: jax.Array
    return_so_far: jax.Array
    time_step: jax.Array
    mask: jax.Array
    cache: Cache


@flax.struct.dataclass
class Acted:
    """What an agent did at the newest pair of each context.

    Attributes:
      action: ``[N, A]``.
      context: the context it acted on, whose cache now holds that pair too.
      sample: ``[N, A]`` what it drew, where it explored and the action is that clipped (PPO).
    """

    action: jax.Array
    context: Context
    sample: jax.Array | None = None


@flax.struct.dataclass
class States:
    """The states that followed the K steps of a scattered window, ``[B, K]`` leading.

    Attributes:
      obs: ``[B, K, O]`` raw observations; zero where ``mask`` is false.
      return_so_far: ``[B, K]``, as in :class:`Window`.
      return_to_go: ``[B, K]``, as in :class:`Window`.
      time_step: int32 ``[B, K]``.
      mask: bool ``[B, K]`` whether the state is known.
    """

    obs: jax.Array
    return_so_far: jax.Array
    return_to_go: jax.Array
    time_step: jax.Array
    mask: jax.Array


@flax.struct.dataclass
class Window:
    """A batch of K steps of one episode each, those of a burn-in included.

    Contiguous steps come with the K+1 states around them. Scattered steps (``following`` is there)
    come with their own K states, ``[B, K]`` instead of ``[B, K+1]`` below, and those that followed.

    Attributes:
      obs: ``[B, K+1, O]`` raw observations; zero where ``state_mask`` is false.
      action: ``[B, K, A]``.
      reward: ``[B, K]``.
      discount: ``[B, K]`` 0 where the task terminated, else 1 (γ is not in it).
      return_so_far: ``[B, K+1]`` reward collected in the episode before that state.
      return_to_go: ``[B, K+1]`` obtained from that state to the episode's end, discounted by
        ``rtg_discount``; zero unless asked for (hindsight).
      time_step: int32 ``[B, K+1]``.
      state_mask: bool ``[B, K+1]`` whether the state belongs to the window's episode.
      mask: bool ``[B, K]`` a real step that is to be learnt from, for the actor loss.
      bootstrap_mask: bool ``[B, K]`` its successor is known, or it terminated: for the critic loss.
      weight: ``[B]`` one over the number of real steps after the burn-in: makes the expected weight
        of every stored step the same although windows at the ends of episodes are short. For
        scattered windows 1.
      following: the states that followed the steps of a scattered window; None where contiguous.
    """

    obs: jax.Array
    action: jax.Array
    reward: jax.Array
    discount: jax.Array
    return_so_far: jax.Array
    return_to_go: jax.Array
    time_step: jax.Array
    state_mask: jax.Array
    mask: jax.Array
    bootstrap_mask: jax.Array
    weight: jax.Array
    following: States | None = None


@flax.struct.dataclass
class Transition:
    """One step of N environments, as the buffer stores it.

    Attributes:
      obs: ``[N, O]`` the observation acted on.
      action: ``[N, A]``.
      reward: ``[N]``.
      terminated: bool ``[N]``.
      truncated: bool ``[N]``.
      bad: bool ``[N]`` bad physics: never to be learnt from.
      time_step: int32 ``[N]`` steps taken in the episode before this one.
      return_so_far: ``[N]`` reward collected in the episode before this step.
    """

    obs: jax.Array
    action: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    bad: jax.Array
    time_step: jax.Array
    return_so_far: jax.Array


@flax.struct.dataclass
class Rollout:
    """T steps in a row of N environments, for an agent without a replay. ``[T, N]`` leads.

    Attributes:
      obs: ``[T, N, O]`` raw observations acted on.
      sample: ``[T, N, A]`` what the agent drew, before it was clipped to the bounds.
      reward: ``[T, N]``.
      terminated: bool ``[T, N]``.
      truncated: bool ``[T, N]``.
      bad: bool ``[T, N]`` bad physics: never to be learnt from.
      next_obs: ``[T, N, O]`` raw observations after the step, before any reset.
    """

    obs: jax.Array
    sample: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    bad: jax.Array
    next_obs: jax.Array

    @property
    def done(self) -> jax.Array:
        """The episode ended, whichever way: bool ``[T, N]``."""
        return self.terminated | self.truncated


@flax.struct.dataclass
class EpisodeTable:
    """The finished episodes of each column that are all in the ring, oldest first.

    Attributes:
      start: int32 ``[N, E]`` ring position of the first step.
      length: int32 ``[N, E]`` steps.
      first: int32 ``[N]`` where the oldest entry of a column lies.
      count: int32 ``[N]`` entries of a column.
    """

    start: jax.Array
    length: jax.Array
    first: jax.Array
    count: jax.Array


@flax.struct.dataclass
class BufferState:
    """A ring over time for each environment column.

    Attributes:
      steps: :class:`Transition` with leaves ``[N, T, ...]``.
      head: int32, the ring position written next (common to all columns).
      size: int32, steps stored in each column.
      running: int32 ``[N]``, newest steps of the column that belong to an unfinished episode.
      episodes: what scattered windows are drawn from; None where windows are contiguous.
    """

    steps: Transition
    head: jax.Array
    size: jax.Array
    running: jax.Array
    episodes: EpisodeTable | None


@flax.struct.dataclass
class Normalizer:
    """Running mean and variance of observations (Welford, integer count).

    Attributes:
      count: int32 observations seen.
      mean: ``[O]``.
      m2: ``[O]`` sum of squared deviations from the mean.
    """

    count: jax.Array
    mean: jax.Array
    m2: jax.Array


@flax.struct.dataclass
class Hyperparameters:
    """Settings that are plain numbers: part of the train state, so they can be vmapped (scalars).

    Attributes:
      actor_learning_rate: Adam step size of the actor.
      critic_learning_rate: Adam step size of the critics.
      alpha_learning_rate: Adam step size of log α, where α is tuned.
      discount: γ.
      tau: soft-update coefficient of the target critics.
      target_entropy: what tuning α aims at, in nats.
      target_return: G_1, in units of reward; with ``target_return="auto"`` it rises with the best
        training return.
      return_scale: every return-to-go is divided by it before the network sees it.
      hindsight_scale: hindsight return-to-go is divided by this instead of ``return_scale``.
      rtg_discount: discount of hindsight return-to-go.
      alpha: entropy temperature at the start, or for good where it is not tuned.
    """

    actor_learning_rate: jax.Array
    critic_learning_rate: jax.Array
    alpha_learning_rate: jax.Array
    discount: jax.Array
    tau: jax.Array
    target_entropy: jax.Array
    target_return: jax.Array
    return_scale: jax.Array
    hindsight_scale: jax.Array
    rtg_discount: jax.Array
    alpha: jax.Array


@flax.struct.dataclass
class PolicyState:
    """All that acting needs: actor parameters, normalizer, and the return it is conditioned on."""

    actor_params: Params
    normalizer: Normalizer
    target_return: jax.Array
    return_scale: jax.Array


@flax.struct.dataclass
class LearnerState:
    """Networks, optimizers, temperature.

    Attributes:
      actor_params: actor parameters.
      critic_params: twin critics, leaves ``[2, ...]``.
      target_critic_params: their slow copies.
      log_alpha: log of the entropy temperature.
      actor_opt: Adam state of the actor.
      critic_opt: Adam state of the critics.
      alpha_opt: Adam state of log α.
      normalizer: observation statistics.
      target_actor_params: slow copy of the actor (TD3, DDPG).
      num_updates: int32 scalar, updates so far (TD3, PPO).
      reward_scale: statistics of discounted returns, by whose spread rewards are divided (PPO).

    What an agent has no use for is None.
    """

    actor_params: Params
    critic_params: Params
    target_critic_params: Params
    log_alpha: jax.Array | None
    actor_opt: Any
    critic_opt: Any
    alpha_opt: Any
    normalizer: Normalizer
    target_actor_params: Params = None
    num_updates: jax.Array | None = None
    reward_scale: Normalizer | None = None


@flax.struct.dataclass
class Counters:
    """Totals since the start of training (int32 scalars).

    Attributes:
      env_steps: environment steps, prefill included.
      updates: gradient updates, those skipped included.
      skipped_updates: updates skipped, wholly or in part, because a tensor was not finite.
      first_fault: which tensor that was the first time, by its place in ``Agent.checked``; or -1.
      episodes: finished episodes.
      bad_physics: steps dropped because the simulation broke down.
    """

    env_steps: jax.Array
    updates: jax.Array
    skipped_updates: jax.Array
    first_fault: jax.Array
    episodes: jax.Array
    bad_physics: jax.Array


@flax.struct.dataclass
class TrainState:
    """Everything training is: restoring it continues the run bit for bit.

    Attributes:
      learner: networks, optimizers, temperature, normalizer.
      hyper: numeric hyperparameters.
      env: states of the N environments.
      context: the acting contexts.
      buffer: the trajectory replay; None for an agent that keeps none.
      counters: totals.
      key: typed PRNG key.
      discounted_return: ``[N]`` of the running episodes so far (PPO); None for the others.
    """

    learner: LearnerState
    hyper: Hyperparameters
    env: VectorEnvState
    context: Context
    buffer: BufferState | None
    counters: Counters
    key: jax.Array
    discounted_return: jax.Array | None = None

"""Deterministic policy gradients: DDPG's update, and what TD3 adds to it.

TD3 is DDPG with the smaller of two critics as the target, noise on the target's actions, and an
actor and targets that move less often than the critics; without any of these it is DDPG.

Letters: N environments, B windows of K = 1 step, C critics, A action size.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from sacformer_jax import normalizer
from sacformer_jax.agents.core import Agent, Metrics
from sacformer_jax.agents.faults import first_fault
from sacformer_jax.agents.off_policy import (
    ADAM,
    CHECKED,
    Backup,
    OffPolicyParts,
    StepWeights,
    init_critics,
    soft_update,
    step_actor,
    step_critics,
    step_weights,
)
from sacformer_jax.config import Config
from sacformer_jax.critics import CriticInputs, Critics, make_critics
from sacformer_jax.distributions import NoisyPoint
from sacformer_jax.envs.core import EnvSpec
from sacformer_jax.networks import DeterministicActor, max_time_step
from sacformer_jax.parallel import DataAxis, any_of_all
from sacformer_jax.types import (
    Acted,
    Cache,
    Context,
    Hyperparameters,
    LearnerState,
    Params,
    PolicyState,
    Window,
)

Updated = tuple[LearnerState, Metrics, jax.Array]
"""A learner, metrics of its actor, and the update's ``fault``."""


@dataclasses.dataclass(frozen=True)
class DeterministicParts(OffPolicyParts):
    """The static parts of the update; its actor is a ``DeterministicActor``.

    Attributes:
      first_critic: the first of the critics by itself, by which the actor is judged.
      exploration: the actor's action with the noise of acting.
      smoothing: the target actor's with the noise of targets; None: without any.
      policy_delay: updates of the critics to one of the actor and of the targets.
    """

    first_critic: Critics
    exploration: NoisyPoint
    smoothing: NoisyPoint | None
    policy_delay: int


def make_deterministic_agent(
    config: Config,
    spec: EnvSpec,
    data: DataAxis,
    num_critics: int = 1,
    smoothing: NoisyPoint | None = None,
    policy_delay: int = 1,
) -> Agent:
    """Builds the agent for an environment: by default DDPG; see :class:`DeterministicParts`."""
    dtype, context_length = config.precision.compute_dtype, config.context.context_length
    critics = partial(make_critics, config.critic, dtype, context_length, max_time_step(spec))
    parts = DeterministicParts(
        actor=DeterministicActor(
            widths=(config.actor.actor_width,) * config.actor.actor_layers,
            activation=config.actor.actor_activation,
            action_size=spec.action_size,
            head_init_scale=config.actor.head_init_scale,
            dtype=dtype,
        ),
        critics=critics(num_critics),
        first_critic=critics(1),
        obs_size=spec.obs_size,
        action_size=spec.action_size,
        context_length=context_length,
        normalize_obs=config.context.normalize_obs,
        data=data,
        exploration=NoisyPoint(
            spec.action_low, spec.action_high, config.policy.action_noise, noise_clip=math.inf
        ),
        smoothing=smoothing,
        policy_delay=policy_delay,
    )
    return Agent(
        init=partial(_init, parts),
        init_cache=_no_cache,
        act=partial(_act, parts),
        update=partial(_update, parts),
        checked=CHECKED,
    )


def _init(parts: DeterministicParts, key: jax.Array) -> LearnerState:
    actor_key, critic_key = jax.random.split(key)
    actor_params = parts.actor.init(actor_key, jnp.zeros((1, parts.obs_size)))
    critic_params = init_critics(parts, critic_key)
    return LearnerState(
        actor_params=actor_params,
        critic_params=critic_params,
        # Copies, never aliases: all are donated.
        target_critic_params=jax.tree.map(jnp.copy, critic_params),
        log_alpha=None,
        actor_opt=ADAM.init(actor_params),
        critic_opt=ADAM.init(critic_params),
        alpha_opt=None,
        normalizer=normalizer.init(parts.obs_size),
        target_actor_params=jax.tree.map(jnp.copy, actor_params),
        num_updates=jnp.zeros((), jnp.int32) if parts.policy_delay > 1 else None,
    )


# --- acting ----------------------------------------------------------------------------------


def _no_cache(num_envs: int) -> Cache:
    return {}


def _act(
    parts: DeterministicParts, policy: PolicyState, context: Context, key: jax.Array, explore: bool
) -> Acted:
    """``μ(s)``, in exploring plus Gaussian noise, within the bounds."""
    mean: Any = parts.actor.apply(
        policy.actor_params, parts.normalized(policy.normalizer, context.obs[:, -1])
    )
    if explore:
        action = _noisy(parts.exploration, parts.data.normal(key, mean.shape), mean)
    else:
        action = parts.exploration.mode(mean)
    return Acted(action, context)


def _noisy(point: NoisyPoint, noise: jax.Array, mean: jax.Array) -> jax.Array:
    # A point looks at no standard deviation.
    return point.sample_and_log_prob(noise, mean, log_std=jnp.zeros_like(mean))[0]


# --- the update ------------------------------------------------------------------------------


def _update(
    parts: DeterministicParts,
    learner: LearnerState,
    hyper: Hyperparameters,
    window: Window,
    key: jax.Array,
) -> tuple[LearnerState, Metrics]:
    obs = parts.normalized(learner.normalizer, window.obs)
    inputs = CriticInputs(
        obs[:, :-1], obs[:, 1:], window.action, window.time_step, window.state_mask
    )
    weights = step_weights(parts, window)
    backup = _backup(parts, learner, hyper, window, inputs, key)
    learner, critic_metrics, non_finite = step_critics(
        parts, learner, hyper, window, inputs, weights, backup
    )
    update_policy = partial(_update_policy, parts, hyper, inputs, weights, non_finite)
    if learner.num_updates is None:  # no delay
        learner, actor_metrics, fault = update_policy(learner)
    else:
        num_updates = learner.num_updates + 1
        learner, actor_metrics, fault = jax.lax.cond(
            # Members are in step: what is due for one is due for all.
            any_of_all(num_updates % parts.policy_delay == 0),
            partial(_weighing, parts.policy_delay, update_policy),
            partial(_leave_policy, non_finite),
            dataclasses.replace(learner, num_updates=num_updates),
        )
    return learner, {**critic_metrics, **actor_metrics, "fault": fault}


def _backup(
    parts: DeterministicParts,
    learner: LearnerState,
    hyper: Hyperparameters,
    window: Window,
    inputs: CriticInputs,
    key: jax.Array,
) -> Backup:
    """``y = r + γ d min_i Q̄_i(s', μ̄(s') + ε)``, ``d = 0`` where the task terminated."""
    mean: Any = parts.actor.apply(learner.target_actor_params, inputs.next_obs)
    if parts.smoothing is None:
        next_action = parts.exploration.mode(mean)
    else:
        next_action = _noisy(parts.smoothing, parts.data.normal(key, mean.shape), mean)
    next_q = parts.critics.following(learner.target_critic_params, inputs, next_action)
    y = window.reward + hyper.discount * window.discount * jnp.min(next_q, axis=0)
    return Backup(policy=mean, next_q=next_q, y=y)


def _update_policy(
    parts: DeterministicParts,
    hyper: Hyperparameters,
    inputs: CriticInputs,
    weights: StepWeights,
    non_finite: list[jax.Array],
    learner: LearnerState,
) -> Updated:
    """One Adam step on ``-Q_1(s, μ(s))``; then all targets follow."""
    first = jax.tree.map(lambda leaf: leaf[:1], learner.critic_params)

    def loss(params: Params) -> jax.Array:
        mean: Any = parts.actor.apply(params, inputs.obs)
        q = parts.first_critic.now(first, inputs, parts.exploration.mode(mean))[0]
        return -jnp.sum(weights.actor * q)

    value, grads = parts.data.sum(jax.value_and_grad(loss)(learner.actor_params))
    learner, metrics, fault = step_actor(
        learner, value, grads, non_finite, hyper.actor_learning_rate
    )

    def follow(sound: jax.Array, target: Params, online: Params) -> Params:
        return soft_update(target, online, jnp.where(sound, hyper.tau, 0.0))

    learner = dataclasses.replace(
        learner,
        target_actor_params=follow(fault < 0, learner.target_actor_params, learner.actor_params),
        target_critic_params=follow(
            first_fault(non_finite) < 0, learner.target_critic_params, learner.critic_params
        ),
    )
    return learner, metrics, fault


def _weighing(
    delay: int, update_policy: Callable[[LearnerState], Updated], learner: LearnerState
) -> Updated:
    """The policy's update; its metrics weigh as much as those of ``delay`` updates.

    The others report 0, so that the mean over all is that over the policy's.
    """
    learner, metrics, fault = update_policy(learner)
    return learner, {name: delay * value for name, value in metrics.items()}, fault


def _leave_policy(non_finite: list[jax.Array], learner: LearnerState) -> Updated:
    """Actor and targets stay as they are."""
    zero = jnp.zeros(())
    return learner, {"actor_loss": zero, "actor_grad_norm": zero}, first_fault(non_finite)

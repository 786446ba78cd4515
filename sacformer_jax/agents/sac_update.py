"""The SAC update over windows, shared by SACFormer and SAC (paper, Eq. 6-13).

Letters: B windows, K steps, A action size. Losses are weighted means over the real steps. Over
several devices B is one's share of the batch; losses and gradients are summed over them, in one
reduction for each network.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import optax

from sacformer_jax import normalizer
from sacformer_jax.agents import sac_policy
from sacformer_jax.agents.core import Agent, Metrics
from sacformer_jax.agents.faults import adam_where, first_fault, num_non_finite
from sacformer_jax.agents.sac_policy import SACParts, prepare_obs, window_policies
from sacformer_jax.critics import CriticInputs
from sacformer_jax.networks import GaussianParams
from sacformer_jax.types import Hyperparameters, LearnerState, Params, Window

_ADAM = optax.scale_by_adam()

CHECKED = (
    "obs", "reward", "return_to_go", "policy", "next_q", "critic_loss", "critic_gradient",
    "actor_loss", "actor_gradient",
)  # fmt: skip
"""Tensors of an update that must be finite, in the order in which they come about."""


@dataclasses.dataclass(frozen=True)
class StepWeights:
    """Weight of each step in the losses, ``[B, K]``, which sum to 1 (over all devices), or to 0."""

    critic: jax.Array
    actor: jax.Array


def step_weights(parts: SACParts, window: Window) -> StepWeights:
    weight = window.weight[:, None]
    weights = StepWeights(critic=weight * window.bootstrap_mask, actor=weight * window.mask)
    totals = parts.data.sum((jnp.sum(weights.critic), jnp.sum(weights.actor)))
    critic_total, actor_total = (jnp.maximum(total, 1e-8) for total in totals)
    return StepWeights(weights.critic / critic_total, weights.actor / actor_total)


def soft_update(target: Params, online: Params, tau: jax.Array) -> Params:
    """``target + tau * (online - target)``."""
    return jax.tree.map(lambda t, o: t + tau * (o - t), target, online)


def bellman_target(
    reward: jax.Array,
    discount: jax.Array,
    next_q: jax.Array,
    next_log_prob: jax.Array,
    alpha: jax.Array,
) -> jax.Array:
    """``y = r + discount (min_i Q_i(s', a') - α log π(a'|s'))`` (Eq. 6-8).

    Args:
      reward: ``[B, K]``.
      discount: ``[B, K]``, γ included, 0 where terminated.
      next_q: ``[2, B, K]`` target critics.
      next_log_prob: ``[B, K]``.
      alpha: scalar.
    """
    return reward + discount * (jnp.min(next_q, axis=0) - alpha * next_log_prob)


def make_sac_agent(parts: SACParts) -> Agent:
    """Binds the parts to the shared SAC functions."""
    return Agent(
        init=partial(_init, parts),
        init_cache=partial(sac_policy.init_cache, parts),
        act=partial(sac_policy.act, parts),
        update=partial(_update, parts),
        checked=CHECKED,
    )


def _init(parts: SACParts, key: jax.Array) -> LearnerState:
    actor_key, critic_key = jax.random.split(key)
    states = (1, parts.context_length + 1)
    obs = jnp.zeros((*states, parts.obs_size))
    actor_params = parts.actor.init(
        actor_key,
        obs,
        jnp.zeros((*states, parts.action_size)),
        jnp.zeros(states),
        jnp.zeros(states, jnp.int32),
        jnp.ones(states, bool),
    )
    critic_params = parts.critics.init(
        critic_key,
        CriticInputs(
            obs=obs[:, :-1],
            next_obs=obs[:, 1:],
            action=jnp.zeros((1, parts.context_length, parts.action_size)),
            time_step=jnp.zeros(states, jnp.int32),
            state_mask=jnp.ones(states, bool),
        ),
    )
    log_alpha = jnp.log(jnp.float32(parts.initial_alpha))
    return LearnerState(
        actor_params=actor_params,
        critic_params=critic_params,
        # A copy, never an alias: both are donated.
        target_critic_params=jax.tree.map(jnp.copy, critic_params),
        log_alpha=log_alpha,
        actor_opt=_ADAM.init(actor_params),
        critic_opt=_ADAM.init(critic_params),
        alpha_opt=_ADAM.init(log_alpha),
        normalizer=normalizer.init(parts.obs_size),
    )


def _update(
    parts: SACParts, learner: LearnerState, hyper: Hyperparameters, window: Window, key: jax.Array
) -> tuple[LearnerState, Metrics]:
    keys = jax.random.split(key, 3)
    # Both in one draw: a draw costs time however small it is.
    next_noise, noise = jax.vmap(lambda key: parts.data.normal(key, window.action.shape))(keys[1:])

    def policies(actor_params: Params) -> tuple[GaussianParams, GaussianParams]:
        dropout_key = parts.data.own_key(keys[0])
        both = window_policies(parts, actor_params, learner, hyper, window, dropout_key)
        return both.now, both.following

    gaussian, pull_back, next_gaussian = jax.vjp(policies, learner.actor_params, has_aux=True)
    inputs, weights = _critic_inputs(parts, learner, window), step_weights(parts, window)
    learner, critic_metrics, non_finite = _update_critics(
        parts, learner, hyper, window, inputs, weights, gaussian, next_gaussian, next_noise
    )
    learner, actor_metrics, non_finite = _update_actor(
        parts, learner, hyper, inputs, weights, non_finite, gaussian, pull_back, noise
    )
    fault = first_fault(non_finite)
    # Temperature: J(α) = E[-α (log π + target entropy)].
    alpha = jnp.exp(learner.log_alpha)
    if parts.tune_alpha:
        alpha_grad = alpha * (actor_metrics["entropy"] - hyper.target_entropy)
        log_alpha, alpha_opt = adam_where(
            fault < 0, _ADAM, learner.log_alpha, alpha_grad, learner.alpha_opt,
            hyper.alpha_learning_rate,
        )  # fmt: skip
        learner = dataclasses.replace(learner, log_alpha=log_alpha, alpha_opt=alpha_opt)
    return learner, {**critic_metrics, **actor_metrics, "alpha": alpha, "fault": fault}


def _critic_inputs(parts: SACParts, learner: LearnerState, window: Window) -> CriticInputs:
    obs = prepare_obs(parts, learner, window.obs)
    if window.following is None:
        now, following = obs[:, :-1], obs[:, 1:]
    else:
        now, following = obs, prepare_obs(parts, learner, window.following.obs)
    return CriticInputs(now, following, window.action, window.time_step, window.state_mask)


def _update_critics(
    parts: SACParts,
    learner: LearnerState,
    hyper: Hyperparameters,
    window: Window,
    inputs: CriticInputs,
    weights: StepWeights,
    gaussian: GaussianParams,
    next_gaussian: GaussianParams,
    noise: jax.Array,
) -> tuple[LearnerState, Metrics, list[jax.Array]]:
    """Eq. 6-8, and the soft update of the targets. Nothing is differentiated through the actor.

    Returns also how many numbers were not finite in each tensor of ``CHECKED`` so far.
    """
    next_action, next_log_prob = parts.distribution.sample_and_log_prob(
        noise, next_gaussian.mean, next_gaussian.log_std
    )
    next_q = parts.critics.following(learner.target_critic_params, inputs, next_action)
    y = bellman_target(
        window.reward,
        hyper.discount * window.discount,
        next_q,
        next_log_prob,
        jnp.exp(learner.log_alpha),
    )

    def loss(params: Params) -> tuple[jax.Array, jax.Array]:
        q = parts.critics.now(params, inputs, window.action)
        return jnp.sum(weights.critic * jnp.sum((q - y) ** 2, axis=0)), q

    (value, q), grads = jax.value_and_grad(loss, has_aux=True)(learner.critic_params)
    given = [
        num_non_finite(window.obs),
        num_non_finite(window.reward),
        num_non_finite(window.return_to_go),
        num_non_finite(*jax.tree.leaves((gaussian, next_gaussian))),
        num_non_finite(next_q),
    ]
    q_mean = jnp.sum(weights.critic * q.mean(axis=0))
    value, q_mean, grads, given = parts.data.sum((value, q_mean, grads, given))
    grad_norm = optax.global_norm(grads)
    non_finite = [*given, num_non_finite(value), num_non_finite(grad_norm)]
    sound = first_fault(non_finite) < 0
    params, opt = adam_where(
        sound, _ADAM, learner.critic_params, grads, learner.critic_opt, hyper.critic_learning_rate
    )
    tau = jnp.where(sound, hyper.tau, 0.0)
    learner = dataclasses.replace(
        learner,
        critic_params=params,
        target_critic_params=soft_update(learner.target_critic_params, params, tau),
        critic_opt=opt,
    )
    metrics = {"critic_loss": value, "q_mean": q_mean, "critic_grad_norm": grad_norm}
    return learner, metrics, non_finite


def _update_actor(
    parts: SACParts,
    learner: LearnerState,
    hyper: Hyperparameters,
    inputs: CriticInputs,
    weights: StepWeights,
    non_finite: list[jax.Array],
    gaussian: GaussianParams,
    pull_back: Callable[[GaussianParams], tuple[Params]],
    noise: jax.Array,
) -> tuple[LearnerState, Metrics, list[jax.Array]]:
    """Eq. 10-13, through the distributions whose gradient ``pull_back`` takes to the parameters."""
    alpha = jnp.exp(learner.log_alpha)

    def loss(gaussian: GaussianParams) -> tuple[jax.Array, jax.Array]:
        action, log_prob = parts.distribution.sample_and_log_prob(
            noise, gaussian.mean, gaussian.log_std
        )
        min_q = jnp.min(parts.critics.now(learner.critic_params, inputs, action), axis=0)
        return jnp.sum(weights.actor * (alpha * log_prob - min_q)), log_prob

    (value, log_prob), gaussian_grads = jax.value_and_grad(loss, has_aux=True)(gaussian)
    (grads,) = pull_back(gaussian_grads)
    entropy = -jnp.sum(weights.actor * log_prob)
    value, entropy, grads = parts.data.sum((value, entropy, grads))
    grad_norm = optax.global_norm(grads)
    non_finite = [*non_finite, num_non_finite(value), num_non_finite(grad_norm)]
    params, opt = adam_where(
        first_fault(non_finite) < 0, _ADAM, learner.actor_params, grads, learner.actor_opt,
        hyper.actor_learning_rate,
    )  # fmt: skip
    learner = dataclasses.replace(learner, actor_params=params, actor_opt=opt)
    metrics = {"actor_loss": value, "entropy": entropy, "actor_grad_norm": grad_norm}
    return learner, metrics, non_finite

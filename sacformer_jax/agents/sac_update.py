"""The SAC update over windows, shared by SACFormer and SAC (paper, Eq. 6-13).

Letters: B windows, K steps, A action size. Losses are weighted means over the real steps.
"""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import optax

from sacformer_jax import normalizer
from sacformer_jax.agents import sac_policy
from sacformer_jax.agents.core import Agent, Metrics
from sacformer_jax.agents.sac_policy import SACParts, prepare_obs, window_policies
from sacformer_jax.critics import CriticInputs
from sacformer_jax.networks import GaussianParams
from sacformer_jax.types import Hyperparameters, LearnerState, Params, Window


def weighted_mean(values: jax.Array, weights: jax.Array) -> jax.Array:
    """``Σ weights·values / Σ weights``; 0 where no weight is left."""
    return jnp.sum(values * weights) / jnp.maximum(jnp.sum(weights), 1e-8)


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
    actor, critics, distribution = parts.actor, parts.critics, parts.distribution
    adam = optax.scale_by_adam()

    def apply_adam(
        params: Params, grads: Params, opt_state: optax.OptState, learning_rate: jax.Array
    ) -> tuple[Params, optax.OptState]:
        direction, opt_state = adam.update(grads, opt_state)
        return jax.tree.map(lambda p, d: p - learning_rate * d, params, direction), opt_state

    def critic_inputs(learner: LearnerState, window: Window) -> CriticInputs:
        obs = prepare_obs(parts, learner, window.obs)
        if window.following is None:
            now, following = obs[:, :-1], obs[:, 1:]
        else:
            now, following = obs, prepare_obs(parts, learner, window.following.obs)
        return CriticInputs(now, following, window.action, window.time_step, window.state_mask)

    def init(key: jax.Array) -> LearnerState:
        actor_key, critic_key = jax.random.split(key)
        states = (1, parts.context_length + 1)
        obs = jnp.zeros((*states, parts.obs_size))
        actor_params = actor.init(
            actor_key,
            obs,
            jnp.zeros((*states, parts.action_size)),
            jnp.zeros(states),
            jnp.zeros(states, jnp.int32),
            jnp.ones(states, bool),
        )
        critic_params = critics.init(
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
            actor_opt=adam.init(actor_params),
            critic_opt=adam.init(critic_params),
            alpha_opt=adam.init(log_alpha),
            normalizer=normalizer.init(parts.obs_size),
        )

    def update(
        learner: LearnerState, hyper: Hyperparameters, window: Window, key: jax.Array
    ) -> tuple[LearnerState, Metrics]:
        dropout_key, next_key, action_key = jax.random.split(key, 3)
        alpha = jnp.exp(learner.log_alpha)
        actor_weight = window.weight[:, None] * window.mask
        critic_weight = window.weight[:, None] * window.bootstrap_mask

        def policies(actor_params: Params) -> tuple[GaussianParams, GaussianParams]:
            both = window_policies(parts, actor_params, learner, hyper, window, dropout_key)
            return both.now, both.following

        gaussian, pull_back, next_gaussian = jax.vjp(policies, learner.actor_params, has_aux=True)

        # Critics (Eq. 6-8). Nothing here is differentiated with respect to the actor.
        next_action, next_log_prob = distribution.sample_and_log_prob(
            next_key, next_gaussian.mean, next_gaussian.log_std
        )
        inputs = critic_inputs(learner, window)
        next_q = critics.following(learner.target_critic_params, inputs, next_action)
        y = bellman_target(
            window.reward, hyper.discount * window.discount, next_q, next_log_prob, alpha
        )

        def critic_loss(critic_params: Params) -> tuple[jax.Array, jax.Array]:
            q = critics.now(critic_params, inputs, window.action)
            return weighted_mean(jnp.sum((q - y) ** 2, axis=0), critic_weight), q

        (critic_loss_value, q), critic_grads = jax.value_and_grad(critic_loss, has_aux=True)(
            learner.critic_params
        )
        critic_params, critic_opt = apply_adam(
            learner.critic_params, critic_grads, learner.critic_opt, hyper.critic_learning_rate
        )

        # Actor (Eq. 10-13), through the distributions above.
        def actor_loss(gaussian: GaussianParams) -> tuple[jax.Array, jax.Array]:
            action, log_prob = distribution.sample_and_log_prob(
                action_key, gaussian.mean, gaussian.log_std
            )
            min_q = jnp.min(critics.now(critic_params, inputs, action), axis=0)
            return weighted_mean(alpha * log_prob - min_q, actor_weight), log_prob

        (actor_loss_value, log_prob), gaussian_grads = jax.value_and_grad(actor_loss, has_aux=True)(
            gaussian
        )
        (actor_grads,) = pull_back(gaussian_grads)
        actor_params, actor_opt = apply_adam(
            learner.actor_params, actor_grads, learner.actor_opt, hyper.actor_learning_rate
        )

        # Temperature: J(α) = E[-α (log π + target entropy)].
        entropy = -weighted_mean(log_prob, actor_weight)
        log_alpha, alpha_opt = learner.log_alpha, learner.alpha_opt
        if parts.tune_alpha:
            alpha_grad = alpha * (entropy - hyper.target_entropy)
            log_alpha, alpha_opt = apply_adam(
                log_alpha, alpha_grad, alpha_opt, hyper.alpha_learning_rate
            )

        new_learner = dataclasses.replace(
            learner,
            actor_params=actor_params,
            critic_params=critic_params,
            target_critic_params=soft_update(
                learner.target_critic_params, critic_params, hyper.tau
            ),
            log_alpha=log_alpha,
            actor_opt=actor_opt,
            critic_opt=critic_opt,
            alpha_opt=alpha_opt,
        )
        metrics = {
            "critic_loss": critic_loss_value,
            "actor_loss": actor_loss_value,
            "q_mean": weighted_mean(q.mean(axis=0), critic_weight),
            "entropy": entropy,
            "alpha": alpha,
            "actor_grad_norm": optax.global_norm(actor_grads),
            "critic_grad_norm": optax.global_norm(critic_grads),
        }
        return new_learner, metrics

    return Agent(
        init=init,
        init_cache=partial(sac_policy.init_cache, parts),
        act=partial(sac_policy.act, parts),
        update=update,
    )

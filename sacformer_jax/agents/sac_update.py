"""The SAC update over windows, shared by SACFormer and SAC (paper, Eq. 6-13).

Letters: B windows, K steps, A action size. Losses are weighted means over the real steps.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax

from sacformer_jax import normalizer
from sacformer_jax.agents.core import Agent, Metrics
from sacformer_jax.config import Conditioning, Config
from sacformer_jax.context import commanded_return_to_go
from sacformer_jax.critics import CriticInputs, TwinCritics, make_critics
from sacformer_jax.distributions import TanhGaussian
from sacformer_jax.envs.core import EnvSpec
from sacformer_jax.networks import GaussianParams, max_time_step
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


@dataclasses.dataclass(frozen=True)
class SACParts:
    """The static parts of the update.

    Attributes:
      actor: network of the signature of :class:`~sacformer_jax.networks.TransformerActor`.
      acting_actor: the same network, as it acts: with a cache or without.
      critics: twin critics over windows.
      distribution: the policy's distribution over the action bounds.
      obs_size: O.
      action_size: A.
      context_length: K.
      return_conditioning: what the actor is conditioned on in training.
      tune_alpha: tune α to the target entropy; otherwise it stays at ``initial_alpha``.
      initial_alpha: α at the start.
      normalize_obs: use the running observation statistics.
    """

    actor: nn.Module
    acting_actor: nn.Module
    critics: TwinCritics
    distribution: TanhGaussian
    obs_size: int
    action_size: int
    context_length: int
    return_conditioning: Conditioning
    tune_alpha: bool
    initial_alpha: float
    normalize_obs: bool


def sac_parts(
    config: Config, spec: EnvSpec, actor: nn.Module, acting_actor: nn.Module | None = None
) -> SACParts:
    """The parts that a configuration and an environment ask for, around ``actor``."""
    return SACParts(
        actor=actor,
        acting_actor=acting_actor or actor,
        critics=make_critics(
            config.critic,
            config.precision.compute_dtype,
            config.context.context_length,
            max_time_step(spec),
        ),
        distribution=TanhGaussian(spec.action_low, spec.action_high),
        obs_size=spec.obs_size,
        action_size=spec.action_size,
        context_length=config.context.context_length,
        return_conditioning=config.context.return_conditioning,
        tune_alpha=config.sac.tune_alpha,
        initial_alpha=config.sac.alpha,
        normalize_obs=config.context.normalize_obs,
    )


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
    apply_actor: Callable[..., GaussianParams] = actor.apply  # type: ignore[assignment]
    apply_acting: Callable[..., tuple[GaussianParams, Params]]
    apply_acting = parts.acting_actor.apply
    adam = optax.scale_by_adam()

    def apply_adam(
        params: Params, grads: Params, opt_state: optax.OptState, learning_rate: jax.Array
    ) -> tuple[Params, optax.OptState]:
        direction, opt_state = adam.update(grads, opt_state)
        return jax.tree.map(lambda p, d: p - learning_rate * d, params, direction), opt_state

    def prepare_obs(learner_or_policy: LearnerState | PolicyState, obs: jax.Array) -> jax.Array:
        if parts.normalize_obs:
            return normalizer.normalize(learner_or_policy.normalizer, obs)
        return obs

    def training_return_to_go(window: Window, hyper: Hyperparameters) -> jax.Array:
        if parts.return_conditioning == "hindsight":
            return window.return_to_go / hyper.return_scale
        if parts.return_conditioning == "commanded":
            return commanded_return_to_go(
                window.return_so_far, hyper.target_return, hyper.return_scale
            )
        return jnp.zeros_like(window.return_to_go)

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
                obs=obs,
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

    def init_cache(num_envs: int) -> Cache:
        pairs = (num_envs, parts.context_length)
        variables = jax.eval_shape(
            parts.acting_actor.init,
            jax.random.key(0),
            jnp.zeros((*pairs, parts.obs_size)),
            jnp.zeros((*pairs, parts.action_size)),
            jnp.zeros(pairs),
            jnp.zeros(pairs, jnp.int32),
            jnp.ones(pairs, bool),
        )
        return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), variables.get("cache", {}))

    def act(policy: PolicyState, context: Context, key: jax.Array, explore: bool) -> Acted:
        return_to_go = commanded_return_to_go(
            context.return_so_far, policy.target_return, policy.return_scale
        )
        if parts.return_conditioning == "none":
            return_to_go = jnp.zeros_like(return_to_go)
        gaussian, changed = apply_acting(
            {**policy.actor_params, "cache": context.cache},
            prepare_obs(policy, context.obs),
            context.action,
            return_to_go,
            context.time_step,
            context.mask,
            mutable=["cache"],
        )
        mean, log_std = gaussian.mean[:, -1], gaussian.log_std[:, -1]
        if explore:
            action = distribution.sample_and_log_prob(key, mean, log_std)[0]
        else:
            action = distribution.mode(mean)
        return Acted(action, dataclasses.replace(context, cache=changed.get("cache", {})))

    def update(
        learner: LearnerState, hyper: Hyperparameters, window: Window, key: jax.Array
    ) -> tuple[LearnerState, Metrics]:
        dropout_key, next_key, action_key = jax.random.split(key, 3)
        obs = prepare_obs(learner, window.obs)
        alpha = jnp.exp(learner.log_alpha)
        actor_weight = window.weight[:, None] * window.mask
        critic_weight = window.weight[:, None] * window.bootstrap_mask

        # One causal pass over the K+1 states gives π at t and at t+1. The action at the last state
        # is not known, and seen by nobody.
        action = jnp.pad(window.action, ((0, 0), (0, 1), (0, 0)))  # [B, K+1, A]

        def distributions(actor_params: Params) -> GaussianParams:
            return apply_actor(
                actor_params,
                obs,
                action,
                training_return_to_go(window, hyper),
                window.time_step,
                window.state_mask,
                deterministic=False,
                rngs={"dropout": dropout_key},
            )

        gaussian, pull_back = jax.vjp(distributions, learner.actor_params)

        # Critics (Eq. 6-8). Nothing here is differentiated with respect to the actor.
        next_action, next_log_prob = distribution.sample_and_log_prob(
            next_key, gaussian.mean[:, 1:], gaussian.log_std[:, 1:]
        )
        inputs = CriticInputs(obs, window.action, window.time_step, window.state_mask)
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

        # Actor (Eq. 10-13), through the distributions of the pass above.
        def actor_loss(gaussian: GaussianParams) -> tuple[jax.Array, jax.Array]:
            action, log_prob = distribution.sample_and_log_prob(
                action_key, gaussian.mean[:, :-1], gaussian.log_std[:, :-1]
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

    return Agent(init=init, init_cache=init_cache, act=act, update=update)

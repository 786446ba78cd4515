"""PPO's round of learning: what is made of a rollout once, and the update on a minibatch of it.

Letters: T steps of N environments, M samples (of a rollout T · N, of an update one minibatch), O,
A. Over several devices M is one's share; losses and gradients are summed over them.
"""

from __future__ import annotations

import dataclasses

import flax.struct
import jax
import jax.numpy as jnp
import optax

from sacformer_jax import advantages, normalizer
from sacformer_jax.agents.adam import Adam
from sacformer_jax.agents.core import Metrics, Prepared
from sacformer_jax.agents.faults import first_fault, num_non_finite
from sacformer_jax.agents.ppo_policy import PpoParts, entropy, log_prob
from sacformer_jax.parallel import DataAxis
from sacformer_jax.types import Hyperparameters, LearnerState, Params, Rollout

ADAM = Adam(eps=1e-5)

CHECKED = (
    "obs", "advantage", "value_target", "policy", "value", "actor_loss", "critic_loss",
    "actor_gradient", "critic_gradient",
)  # fmt: skip
"""Tensors of an update that must be finite, in the order in which they come about."""


# --- once a round --------------------------------------------------------------------------------


@flax.struct.dataclass
class Samples:
    """What an update learns from.

    Attributes:
      obs: ``[M, O]``, normalized.
      sample: ``[M, A]`` what the policy drew, before it was clipped to the bounds.
      log_prob: ``[M]`` of it, under the policy at the start of the round.
      advantage: ``[M]``.
      value: ``[M]`` at the start of the round.
      value_target: ``[M]``, advantage plus value.
      mask: bool ``[M]`` whether to learn from it (no bad physics).
    """

    obs: jax.Array
    sample: jax.Array
    log_prob: jax.Array
    advantage: jax.Array
    value: jax.Array
    value_target: jax.Array
    mask: jax.Array


def prepare(
    parts: PpoParts,
    learner: LearnerState,
    hyper: Hyperparameters,
    rollout: Rollout,
    discounted_return: jax.Array,
) -> Prepared:
    reward, reward_scale = rollout.reward, learner.reward_scale
    assert reward_scale is not None
    if parts.settings.normalize_reward:
        returns, discounted_return = advantages.discounted_returns(
            reward, rollout.done, discounted_return, hyper.discount
        )
        reward_scale = normalizer.update(reward_scale, returns[..., None], parts.data)
        reward = advantages.scale_reward(reward_scale, reward)
    obs = parts.normalized(learner.normalizer, rollout.obs)  # [T, N, O]
    next_obs = parts.normalized(learner.normalizer, rollout.next_obs)
    value = parts.value(learner.critic_params, obs)  # [T, N]
    advantage = advantages.gae(
        reward,
        value,
        parts.value(learner.critic_params, next_obs),
        rollout.terminated,
        rollout.truncated,
        rollout.bad,
        hyper.discount,
        parts.settings.gae_lambda,
    )
    by_step = Samples(
        obs=obs,
        sample=rollout.sample,
        log_prob=log_prob(parts.policy(learner.actor_params, obs), rollout.sample),
        advantage=advantage,
        value=value,
        value_target=advantage + value,
        mask=~rollout.bad,
    )
    samples = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), by_step)  # [M, ...]
    return Prepared(
        learner=dataclasses.replace(learner, reward_scale=reward_scale),
        samples=samples,
        discounted_return=discounted_return,
        metrics={"explained_variance": _explained_variance(parts.data, samples)},
    )


def _explained_variance(data: DataAxis, samples: Samples) -> jax.Array:
    """Share of the variance of the value targets that the values explain; 1 at best."""
    weight = _weights(data, samples.mask)
    both = jnp.stack([samples.value_target - samples.value, samples.value_target])  # [2, M]
    mean = data.sum(jnp.sum(weight * both, axis=-1))
    unexplained, variance = data.sum(jnp.sum(weight * (both - mean[:, None]) ** 2, axis=-1))
    return 1.0 - unexplained / variance


def _weights(data: DataAxis, mask: jax.Array) -> jax.Array:
    """The same for every sample that counts, ``[M]``; they sum to 1 over all devices, or to 0."""
    weight = mask.astype(jnp.float32)
    return weight / jnp.maximum(data.sum(jnp.sum(weight)), 1.0)


# --- the update ----------------------------------------------------------------------------------


def clipped_surrogate(ratio: jax.Array, advantage: jax.Array, clip_range: float) -> jax.Array:
    """What is to be made small, Eq. 7 with its sign turned; any shape."""
    clipped = jnp.clip(ratio, 1.0 - clip_range, 1.0 + clip_range)
    return -jnp.minimum(ratio * advantage, clipped * advantage)


def value_loss(
    value: jax.Array, before: jax.Array, target: jax.Array, clip_range: float | None
) -> jax.Array:
    """Half the squared error; where a value moves further than ``clip_range``, the worse of it
    there and at the limit. Any shape.
    """
    error = (value - target) ** 2
    if clip_range is not None:
        clipped = before + jnp.clip(value - before, -clip_range, clip_range)
        error = jnp.maximum(error, (clipped - target) ** 2)
    return 0.5 * error


def normalized_advantage(data: DataAxis, advantage: jax.Array, weight: jax.Array) -> jax.Array:
    """Mean 0 and standard deviation 1 over the weighted samples of all devices, ``[M]``."""
    centred = advantage - data.sum(jnp.sum(weight * advantage))
    variance = data.sum(jnp.sum(weight * centred**2))
    return centred / (jnp.sqrt(variance) + 1e-8)


def learning_rate_factor(parts: PpoParts, num_updates: jax.Array) -> jax.Array:
    """1 in the first round, then less by the same amount in each; 0 after the last."""
    if not parts.settings.anneal_learning_rate:
        return jnp.float32(1.0)
    rounds = num_updates // (parts.settings.epochs * parts.settings.minibatches)
    return jnp.maximum(1.0 - rounds / parts.num_rounds, 0.0)


def update(
    parts: PpoParts, learner: LearnerState, hyper: Hyperparameters, samples: Samples, key: jax.Array
) -> tuple[LearnerState, Metrics]:
    del key  # which samples was all that is random
    settings, data = parts.settings, parts.data
    weight = _weights(data, samples.mask)
    advantage = samples.advantage
    if settings.normalize_advantages:
        advantage = normalized_advantage(data, advantage, weight)

    def actor_loss(params: Params) -> tuple[jax.Array, Metrics]:
        gaussian = parts.policy(params, samples.obs)
        log_ratio = log_prob(gaussian, samples.sample) - samples.log_prob
        ratio = jnp.exp(log_ratio)
        each = {
            "actor_loss": clipped_surrogate(ratio, advantage, settings.clip_range),
            "entropy": entropy(gaussian),
            "approx_kl": ratio - 1.0 - log_ratio,  # k3 of Schulman's note, never negative
            "clip_fraction": jnp.abs(ratio - 1.0) > settings.clip_range,
        }
        means = {name: jnp.sum(weight * values) for name, values in each.items()}
        loss = means["actor_loss"] - settings.entropy_coefficient * means["entropy"]
        return loss, {**means, "non_finite": num_non_finite(log_ratio)}

    def critic_loss(params: Params) -> tuple[jax.Array, Metrics]:
        value = parts.value(params, samples.obs)
        clip_range = settings.clip_range if settings.clip_value_loss else None
        errors = value_loss(value, samples.value, samples.value_target, clip_range)
        mean = jnp.sum(weight * errors)
        found = {"critic_loss": mean, "non_finite": num_non_finite(value)}
        return settings.value_coefficient * mean, found

    actor_grads, of_actor = jax.grad(actor_loss, has_aux=True)(learner.actor_params)
    critic_grads, of_critic = jax.grad(critic_loss, has_aux=True)(learner.critic_params)
    given = [
        num_non_finite(samples.obs),
        num_non_finite(samples.advantage),
        num_non_finite(samples.value_target),
        of_actor.pop("non_finite"),
        of_critic.pop("non_finite"),
    ]
    grads, metrics, given = data.sum(
        ((actor_grads, critic_grads), {**of_actor, **of_critic}, given)
    )
    return _step(parts, learner, hyper, grads, metrics, given)


def _step(
    parts: PpoParts,
    learner: LearnerState,
    hyper: Hyperparameters,
    grads: tuple[Params, Params],
    metrics: Metrics,
    given: list[jax.Array],
) -> tuple[LearnerState, Metrics]:
    """Adam on actor and critic, whose gradients are scaled down as one vector."""
    norms = [optax.global_norm(part) for part in grads]
    losses = [metrics["actor_loss"], metrics["critic_loss"]]
    fault = first_fault([*given, *(num_non_finite(number) for number in [*losses, *norms])])
    scale_down = optax.clip_by_global_norm(parts.settings.max_grad_norm)
    (actor_grads, critic_grads), _ = scale_down.update(grads, scale_down.init(grads))
    assert learner.num_updates is not None
    factor = learning_rate_factor(parts, learner.num_updates)
    rates = hyper.actor_learning_rate * factor, hyper.critic_learning_rate * factor
    actor_params, actor_opt = ADAM.step_where(
        fault < 0, learner.actor_params, actor_grads, learner.actor_opt, rates[0]
    )
    critic_params, critic_opt = ADAM.step_where(
        fault < 0, learner.critic_params, critic_grads, learner.critic_opt, rates[1]
    )
    learner = dataclasses.replace(
        learner,
        actor_params=actor_params,
        critic_params=critic_params,
        actor_opt=actor_opt,
        critic_opt=critic_opt,
        num_updates=learner.num_updates + 1,  # skipped ones too: the rounds go by
    )
    return learner, {
        **metrics,
        "actor_grad_norm": norms[0],
        "critic_grad_norm": norms[1],
        "learning_rate": rates[0],
        "fault": fault,
    }

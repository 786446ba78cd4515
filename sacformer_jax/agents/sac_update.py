"""The SAC update over windows, shared by SACFormer and SAC (paper, Eq. 6-13).

Letters: B windows, K steps, A action size.
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
from sacformer_jax.agents import sac_policy
from sacformer_jax.agents.core import Agent, Metrics
from sacformer_jax.agents.faults import first_fault
from sacformer_jax.agents.off_policy import (
    ADAM,
    CHECKED,
    Backup,
    StepWeights,
    init_critics,
    soft_update,
    step_actor,
    step_critics,
    step_weights,
)
from sacformer_jax.agents.sac_policy import SACParts, WindowPolicies, window_policies
from sacformer_jax.critics import CriticInputs
from sacformer_jax.networks import GaussianParams
from sacformer_jax.types import Hyperparameters, LearnerState, Params, Window

_LEAST_VARIANCE = 1e-4
"""Taken for the variance of what hardly ever changes, that its noise is not learnt."""
_ACTS = ("heads", "state_path")
"""Layers of an actor that learn from the actor's loss, whatever its transformer learns from."""


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


def lambda_target(one_step: jax.Array, decay: jax.Array, next_value: jax.Array) -> jax.Array:
    """Targets along a window: ``y_t = y1_t + decay_t (y_{t+1} - Q_{t+1})``.

    With ``decay = γλ`` they are the λ-returns of Peng's Q(λ) (Kozuno et al., arXiv 2103.00107),
    with SAC's entropy bonus: geometrically weighted means of the targets of one step, two, …, not
    corrected for what the policy would do otherwise by now.

    Args:
      one_step: ``[B, K]``, :func:`bellman_target`.
      decay: ``[B, K]``; 0 where the next step of the window does not follow, or cannot be judged.
      next_value: ``[B, K]``, what ``one_step`` has of the critics: their least after the step.

    Returns:
      ``[B, K]``.
    """

    def backward(
        later: jax.Array, step: tuple[jax.Array, jax.Array, jax.Array]
    ) -> tuple[jax.Array, jax.Array]:
        own, factor, value = step
        y = own + factor * (later - value)
        return y, y

    steps = jax.tree.map(lambda x: x.swapaxes(0, 1), (one_step, decay, next_value))  # [K, B]
    nothing = jnp.zeros_like(one_step[:, 0])
    return jax.lax.scan(backward, nothing, steps, reverse=True)[1].swapaxes(0, 1)  # [B, K]


def make_sac_agent(parts: SACParts) -> Agent:
    """Binds the parts to the shared SAC functions."""
    return Agent(
        init=partial(_init, parts),
        init_cache=partial(sac_policy.init_cache, parts),
        act=partial(sac_policy.act, parts),
        update=partial(_update, parts),
        checked=CHECKED,
        pretrain=partial(_pretrain, parts),
    )


def _init(parts: SACParts, key: jax.Array) -> LearnerState:
    actor_key, critic_key = jax.random.split(key)
    states = (1, parts.context_length + 1)
    actor_params = parts.actor.init(
        actor_key,
        jnp.zeros((*states, parts.obs_size)),
        jnp.zeros((*states, parts.action_size)),
        jnp.zeros(states),
        jnp.zeros(states, jnp.int32),
        jnp.ones(states, bool),
    )
    critic_params = init_critics(parts, critic_key)
    log_alpha = jnp.log(jnp.float32(parts.initial_alpha))
    return LearnerState(
        actor_params=actor_params,
        critic_params=critic_params,
        # A copy, never an alias: both are donated.
        target_critic_params=jax.tree.map(jnp.copy, critic_params),
        log_alpha=log_alpha,
        actor_opt=ADAM.init(actor_params),
        critic_opt=ADAM.init(critic_params),
        alpha_opt=ADAM.init(log_alpha),
        normalizer=normalizer.init(parts.obs_size),
    )


@dataclasses.dataclass(frozen=True)
class _Half:
    """An update after the critics' step, before the actor's.

    Attributes:
      learner: with the critics stepped.
      metrics: of the critics.
      non_finite: how many numbers were not finite in each tensor of ``CHECKED`` so far.
      inputs: of the critics.
      weights: of the steps.
      gaussian: π at the steps.
      prediction: how observations change in the H steps after them, and the rewards,
        ``[B, K, H, O + 1]``; None if not predicted.
      pull_back: takes gradients of ``gaussian`` and ``prediction`` to the actor's parameters.
      noise: standard normal ``[B, K, A]``, for the actor's loss.
    """

    learner: LearnerState
    metrics: Metrics
    non_finite: list[jax.Array]
    inputs: CriticInputs
    weights: StepWeights
    gaussian: GaussianParams
    prediction: jax.Array | None
    pull_back: Callable[[tuple[GaussianParams, jax.Array | None]], tuple[Params]]
    noise: jax.Array


def _two_draws(
    parts: SACParts, keys: jax.Array, shape: tuple[int, ...]
) -> tuple[jax.Array, jax.Array]:
    """Standard normal draws of ``shape``, one for each of two keys.

    They come out of a loop, which carries them: outside of one, on CPUs, XLA computes them again
    for every reader, together with what that does, in code too long to be vectorized. Nor does it
    vectorize a draw whose last axis is short, so that they are flat until they leave the loop.
    """
    size = (math.prod(shape),)

    def turn(
        drawn: tuple[jax.Array, jax.Array], key: jax.Array
    ) -> tuple[tuple[jax.Array, jax.Array], None]:
        return (drawn[1], parts.data.normal(key, size)), None

    (first, second), _ = jax.lax.scan(turn, (jnp.zeros(size), jnp.zeros(size)), keys)
    return first.reshape(shape), second.reshape(shape)


def _after_critics(
    parts: SACParts, learner: LearnerState, hyper: Hyperparameters, window: Window, key: jax.Array
) -> _Half:
    """π over the window, and the critics' step."""
    keys = jax.random.split(key, 3)
    next_noise, noise = _two_draws(parts, keys[1:], window.action.shape)

    def policies(actor_params: Params) -> tuple[Any, WindowPolicies]:
        dropout_key = parts.data.own_key(keys[0])
        both = window_policies(parts, actor_params, learner, hyper, window, dropout_key)
        return (both.now, both.prediction), both

    outputs, pull_back, both = jax.vjp(policies, learner.actor_params, has_aux=True)
    gaussian, prediction = outputs
    inputs, weights = critic_inputs(parts, learner, window, both), step_weights(parts, window)
    learner, metrics, non_finite = _update_critics(
        parts, learner, hyper, window, inputs, weights, gaussian, both.following, next_noise
    )
    return _Half(
        learner, metrics, non_finite, inputs, weights, gaussian, prediction, pull_back, noise
    )


def _pretrain(
    parts: SACParts, learner: LearnerState, hyper: Hyperparameters, window: Window, key: jax.Array
) -> tuple[LearnerState, Metrics]:
    """The actor imitates the steps, by maximum likelihood as a Decision Transformer does (of a
    deterministic policy by least squares); the critics learn what it is worth, by SAC's own step.
    The temperature stays.
    """
    half = _after_critics(parts, learner, hyper, window, key)
    learner, weights = half.learner, half.weights

    def loss(gaussian: GaussianParams) -> jax.Array:
        each = parts.distribution.imitation_loss(window.action, gaussian.mean, gaussian.log_std)
        return jnp.sum(weights.actor * each)

    value, gaussian_grads = jax.value_and_grad(loss)(half.gaussian)
    predicted = _learn_to_predict(parts, half, window)
    (grads,) = half.pull_back((gaussian_grads, predicted.grads))
    shown = parts.distribution.mode(half.gaussian.mean)
    error = jnp.sum(weights.actor * jnp.mean(jnp.abs(shown - window.action), axis=-1))
    value, error, own, grads = parts.data.sum((value, error, predicted.metrics, grads))
    learner, metrics, fault = _step_actor(parts, hyper, half, value, grads)
    return learner, {**half.metrics, **metrics, **own, "action_error": error, "fault": fault}


def _update(
    parts: SACParts, learner: LearnerState, hyper: Hyperparameters, window: Window, key: jax.Array
) -> tuple[LearnerState, Metrics]:
    half = _after_critics(parts, learner, hyper, window, key)
    learner, actor_metrics, fault = _update_actor(parts, hyper, half, window)
    # Temperature: J(α) = E[-α (log π + target entropy)].
    alpha = _alpha(learner)
    if parts.tune_alpha:
        alpha_grad = alpha * (actor_metrics["entropy"] - hyper.target_entropy)
        log_alpha, alpha_opt = ADAM.step_where(
            fault < 0, learner.log_alpha, alpha_grad, learner.alpha_opt,
            hyper.alpha_learning_rate,
        )  # fmt: skip
        learner = dataclasses.replace(learner, log_alpha=log_alpha, alpha_opt=alpha_opt)
    return learner, {**half.metrics, **actor_metrics, "alpha": alpha, "fault": fault}


def _alpha(learner: LearnerState) -> jax.Array:
    assert learner.log_alpha is not None
    return jnp.exp(learner.log_alpha)


def critic_inputs(
    parts: SACParts, learner: LearnerState, window: Window, both: WindowPolicies
) -> CriticInputs:
    """What critics may look at of B windows; ``both`` are the policies over them."""
    obs = parts.normalized(learner.normalizer, window.obs)
    if window.following is None:
        now, following = obs[:, :-1], obs[:, 1:]
    else:
        now, following = obs, parts.normalized(learner.normalizer, window.following.obs)
    if parts.num_critic_features:
        assert both.features is not None
        features, next_features = jax.lax.stop_gradient(both.features)
        now = jnp.concatenate([now, features], axis=-1)
        following = jnp.concatenate([following, next_features], axis=-1)
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
        _alpha(learner),
    )
    if parts.td_lambda > 0.0:
        # The last step of the window has no later target, nor has one before a step that has none.
        follows = jnp.pad(window.bootstrap_mask[:, 1:], ((0, 0), (0, 1)))
        decay = parts.td_lambda * hyper.discount * window.discount * follows
        y = lambda_target(y, decay, jnp.min(next_q, axis=0))

    backup = Backup(policy=(gaussian, next_gaussian), next_q=next_q, y=y)
    learner, metrics, non_finite = step_critics(
        parts, learner, hyper, window, inputs, weights, backup
    )
    tau = jnp.where(first_fault(non_finite) < 0, hyper.tau, 0.0)
    target = soft_update(learner.target_critic_params, learner.critic_params, tau)
    learner = dataclasses.replace(learner, target_critic_params=target)
    return learner, metrics, non_finite


def _update_actor(
    parts: SACParts, hyper: Hyperparameters, half: _Half, window: Window
) -> tuple[LearnerState, Metrics, jax.Array]:
    """Eq. 10-13, through the distributions whose gradient is pulled back to the parameters."""
    learner, weights, inputs = half.learner, half.weights, half.inputs
    alpha = _alpha(learner)

    def loss(gaussian: GaussianParams) -> tuple[jax.Array, jax.Array]:
        action, log_prob = parts.distribution.sample_and_log_prob(
            half.noise, gaussian.mean, gaussian.log_std
        )
        min_q = jnp.min(parts.critics.now(learner.critic_params, inputs, action), axis=0)
        return jnp.sum(weights.actor * (alpha * log_prob - min_q)), log_prob

    (value, log_prob), gaussian_grads = jax.value_and_grad(loss, has_aux=True)(half.gaussian)
    predicted = _learn_to_predict(parts, half, window)
    (grads,) = half.pull_back((gaussian_grads, predicted.grads))
    entropy = -jnp.sum(weights.actor * log_prob)
    value, entropy, own, grads = parts.data.sum((value, entropy, predicted.metrics, grads))
    learner, metrics, fault = _step_actor(parts, hyper, half, value, grads)
    return learner, {**metrics, **own, "entropy": entropy}, fault


def _step_actor(
    parts: SACParts, hyper: Hyperparameters, half: _Half, loss: jax.Array, grads: Params
) -> tuple[LearnerState, Metrics, jax.Array]:
    """:func:`step_actor`; what learns from its prediction alone takes the critics' step size, as
    it is a regression like theirs.
    """
    rate: Any = hyper.actor_learning_rate
    if parts.predicts_alone:
        rate = {
            "params": {
                name: hyper.actor_learning_rate if name in _ACTS else hyper.critic_learning_rate
                for name in grads["params"]
            }
        }
    return step_actor(half.learner, loss, grads, half.non_finite, rate)


@dataclasses.dataclass(frozen=True)
class _Predicted:
    """How well the next steps were foretold.

    Attributes:
      grads: of the weighted loss to the prediction ``[B, K, H, O + 1]``; None if there is none.
      metrics: its metrics.
    """

    grads: jax.Array | None
    metrics: Metrics


def _learn_to_predict(parts: SACParts, half: _Half, window: Window) -> _Predicted:
    """The squared error in predicting the changes of the observation and the rewards, as a share
    of their variance in the batch, mean over the numbers and over how far they lie ahead.

    What moves little from step to step counts as much as what moves far: in differences of
    positions is the velocity. Steps weigh as in the critics' loss, those after which the window
    does not show what happened nothing.
    """
    if half.prediction is None:
        return _Predicted(None, {})
    size, following = parts.obs_size, window.following
    known = window.state_mask[:, 1:] if following is None else following.mask
    known &= window.bootstrap_mask  # the physics held
    change = half.inputs.next_obs[..., :size] - half.inputs.obs[..., :size]
    one_step = jnp.concatenate([change, window.reward[..., None]], axis=-1)  # [B, K, O + 1]
    steps = half.prediction.shape[2]
    outcome = _ahead(one_step, steps)  # [B, K, H, O + 1]
    weight = (half.weights.critic[..., None] * _ahead(known, steps))[..., None]  # [B, K, H, 1]
    total, first, second = parts.data.sum(
        tuple(jnp.sum(weight * x, axis=(0, 1)) for x in (jnp.ones(()), outcome, outcome**2))
    )
    total = jnp.maximum(total, _LEAST_VARIANCE)  # [H, 1]
    variance = jnp.maximum(second / total - (first / total) ** 2, _LEAST_VARIANCE)
    weight = weight * total[0] / total  # late steps are seen less often, and count as much

    def loss(prediction: jax.Array) -> jax.Array:
        share = jnp.mean((prediction - outcome) ** 2 / variance, axis=-1, keepdims=True)
        return jnp.sum(weight * share) / steps

    value, grads = jax.value_and_grad(loss)(half.prediction)
    return _Predicted(parts.prediction_weight * grads, {"prediction_loss": value})


def _ahead(x: jax.Array, steps: int) -> jax.Array:
    """``x [B, K, ...]`` at each step and the ``steps - 1`` after it, ``[B, K, steps, ...]``; zeros
    behind the window's end.
    """
    length = x.shape[1]
    padded = jnp.pad(x, ((0, 0), (0, steps - 1), *((0, 0),) * (x.ndim - 2)))
    return jnp.stack([padded[:, i : i + length] for i in range(steps)], axis=2)

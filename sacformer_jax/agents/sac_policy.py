"""SAC's policy: what SACFormer's and SAC's differ in, acting, and π over windows.

Letters: N environments, B windows, K steps, O, A.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp

from sacformer_jax.agents.off_policy import OffPolicyParts
from sacformer_jax.config import Conditioning, Config
from sacformer_jax.context import commanded_return_to_go
from sacformer_jax.critics import make_critics
from sacformer_jax.distributions import ActionDistribution, NoisyPoint, TanhGaussian
from sacformer_jax.envs.core import EnvSpec
from sacformer_jax.networks import ActorOutput, GaussianParams, max_time_step
from sacformer_jax.parallel import DataAxis
from sacformer_jax.transformer import Seen
from sacformer_jax.types import (
    Acted,
    Cache,
    Context,
    Hyperparameters,
    LearnerState,
    Params,
    PolicyState,
    States,
    Window,
)

_DROPOUT_STREAM = 2**31
"""Folded into the acting key, apart from the exploration noise."""


@dataclasses.dataclass(frozen=True)
class SACParts(OffPolicyParts):
    """The static parts of the update; its actor has the signature of ``TransformerActor``.

    Attributes:
      acting_actor: the same network, as it acts: with a cache or without.
      distribution: the policy's distribution over the action bounds.
      burn_in: first steps of a window that are seen by those after them, and no more.
      return_conditioning: what the actor is conditioned on in training.
      next_rtg_decrement: hindsight return-to-go after a scattered step is that at the step less
        this; None: its own.
      acting_dropout: dropout is on in acting, too.
      tune_alpha: tune α to the target entropy; otherwise it stays at ``initial_alpha``.
      initial_alpha: α at the start.
      td_lambda: λ of the critics' targets along a window.
      prediction_weight: of the loss in predicting the next steps, in the actor's; 0: none.
      predicts_alone: the actor's transformer learns from nothing else.
    """

    acting_actor: nn.Module
    distribution: ActionDistribution
    burn_in: int
    return_conditioning: Conditioning
    next_rtg_decrement: float | None
    acting_dropout: bool
    tune_alpha: bool
    initial_alpha: float
    td_lambda: float
    prediction_weight: float
    predicts_alone: bool


def sac_parts(
    config: Config,
    spec: EnvSpec,
    data: DataAxis,
    actor: nn.Module,
    acting_actor: nn.Module | None = None,
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
            burn_in=config.context.burn_in,
        ),
        distribution=_distribution(config, spec),
        obs_size=spec.obs_size,
        action_size=spec.action_size,
        context_length=config.context.context_length,
        burn_in=config.context.burn_in,
        return_conditioning=config.context.return_conditioning,
        next_rtg_decrement=config.context.next_rtg_decrement,
        acting_dropout=config.actor.acting_dropout,
        tune_alpha=config.learning.tune_alpha,
        initial_alpha=config.learning.alpha,
        td_lambda=config.learning.td_lambda,
        prediction_weight=config.learning.prediction_weight,
        predicts_alone=config.actor.transformer_loss == "prediction",
        num_critic_features=config.actor.actor_width if config.critic.critic_features else 0,
        normalize_obs=config.context.normalize_obs,
        data=data,
    )


def _distribution(config: Config, spec: EnvSpec) -> ActionDistribution:
    low, high, settings = spec.action_low, spec.action_high, config.policy
    if settings.policy == "deterministic":
        return NoisyPoint(low, high, settings.action_noise, settings.action_noise_clip)
    return TanhGaussian(low, high)


# --- acting ----------------------------------------------------------------------------------


def init_cache(parts: SACParts, num_envs: int) -> Cache:
    """The empty cache of N contexts; ``{}`` where the actor keeps none."""
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


def act(
    parts: SACParts, policy: PolicyState, context: Context, key: jax.Array, explore: bool
) -> Acted:
    """Chooses actions from contexts, conditioned by Eq. 1 from the target return."""
    outlook = acting_outlook(parts, policy, context, key)
    mean, log_std = outlook.gaussian.mean, outlook.gaussian.log_std
    if explore:
        noise = parts.data.normal(key, mean.shape)
        action = parts.distribution.sample_and_log_prob(noise, mean, log_std)[0]
    else:
        action = parts.distribution.mode(mean)
    return Acted(action, outlook.context)


@dataclasses.dataclass(frozen=True)
class Outlook:
    """π at the newest pair of each context.

    Attributes:
      gaussian: ``[N, A]``.
      context: the contexts, whose caches now hold that pair too.
      features: of the trunk, ``[N, D]``; None of an actor without one.
    """

    gaussian: GaussianParams
    context: Context
    features: jax.Array | None


def acting_outlook(
    parts: SACParts, policy: PolicyState, context: Context, key: jax.Array
) -> Outlook:
    """What :func:`act` draws from; ``key`` matters only where dropout is on in acting."""
    return_to_go = commanded_return_to_go(
        context.return_so_far, policy.target_return, policy.return_scale
    )
    if parts.return_conditioning == "none":
        return_to_go = jnp.zeros_like(return_to_go)
    output: Any = parts.acting_actor.apply(
        {**policy.actor_params, "cache": context.cache},
        parts.normalized(policy.normalizer, context.obs),
        context.action,
        return_to_go,
        context.time_step,
        context.mask,
        deterministic=not parts.acting_dropout,
        rngs={"dropout": parts.data.own_key(jax.random.fold_in(key, _DROPOUT_STREAM))},
        mutable=["cache"],
    )
    acted, changed = output
    newest, features = jax.tree.map(lambda x: x[:, -1], (acted.gaussian, acted.features))
    context = dataclasses.replace(context, cache=changed.get("cache", {}))
    return Outlook(newest, context, features)


# --- training --------------------------------------------------------------------------------


@flax.struct.dataclass
class WindowPolicies:
    """π over windows.

    Attributes:
      now: at the K steps, ``[B, K, A]``; at those of a burn-in, here and below, it means nothing.
      following: after them, ``[B, K, A]``.
      prediction: ``[B, K, H, O + 1]``, how normalized observations change in the next H steps,
        and the rewards; None if not predicted.
      features: the trunk's at the steps and after them, ``[B, K, D]`` each; None without a trunk.
    """

    now: GaussianParams
    following: GaussianParams
    prediction: jax.Array | None
    features: tuple[jax.Array, jax.Array] | None


def window_policies(
    parts: SACParts,
    actor_params: Params,
    learner: LearnerState,
    hyper: Hyperparameters,
    window: Window,
    key: jax.Array,
) -> WindowPolicies:
    """π at the steps of each window and after them, with dropout.

    Only π at the steps is differentiated. Of a contiguous window the K states are looked at in one
    causal pass; the one state after them goes by itself, with the keys and values of that pass as
    its past, so that nothing of it is in the backward pass. Scattered windows take two passes.

    Args:
      parts: the static parts.
      actor_params: the actor's, in place of those of ``learner``.
      learner: for its normalizer.
      hyper: numeric settings.
      window: B windows.
      key: typed PRNG key of the dropout.
    """

    def look(
        actor_params: Params,
        states: States,
        action: jax.Array,
        key: jax.Array,
        past: Seen | None = None,
        skip: int = 0,
    ) -> ActorOutput:
        output: Any = parts.actor.apply(
            actor_params,
            parts.normalized(learner.normalizer, states.obs),
            action,
            states.return_to_go,
            states.time_step,
            states.mask,
            deterministic=False,
            rngs={"dropout": key},
            past=past,
            skip=skip,
        )
        return output

    now_key, following_key = jax.random.split(key)
    frozen = jax.lax.stop_gradient(actor_params)
    return_to_go = training_return_to_go(parts, window, hyper)  # [B, K+1], or [B, K] scattered
    everything = States(
        window.obs, window.return_so_far, return_to_go, window.time_step, window.state_mask
    )
    steps = window.action.shape[1]  # K
    at_steps = jax.tree.map(lambda x: x[:, :steps], everything)
    now = look(actor_params, at_steps, window.action, now_key, skip=parts.burn_in)
    following = window.following
    if following is None:
        last = jax.tree.map(lambda x: x[:, steps:], everything)  # [B, 1]
        # It sees the whole window, whose mask and actions go with it; its own is seen by nobody.
        last = dataclasses.replace(last, mask=window.state_mask)
        action = jnp.pad(window.action, ((0, 0), (0, 1), (0, 0)))  # [B, K+1, A]
        seen = jax.lax.stop_gradient(now.seen)
        after = look(frozen, last, action, following_key, seen)
        next_gaussian, next_features = jax.tree.map(
            lambda a, b: jnp.concatenate([a[:, 1:], b], axis=1),
            (now.gaussian, now.features),
            (after.gaussian, after.features),
        )
    else:
        if parts.next_rtg_decrement is None:
            next_return_to_go = training_return_to_go(parts, following, hyper)
        else:
            next_return_to_go = return_to_go - parts.next_rtg_decrement
        following = dataclasses.replace(following, return_to_go=next_return_to_go)
        # tokens="gs" with scattered windows: no actions are looked at.
        after = look(frozen, following, window.action, following_key)
        next_gaussian, next_features = after.gaussian, after.features
    features = None if now.features is None else (now.features, next_features)
    return WindowPolicies(now.gaussian, next_gaussian, now.prediction, features)


def training_return_to_go(
    parts: SACParts, states: Window | States, hyper: Hyperparameters
) -> jax.Array:
    """What the return tokens show in training, scaled."""
    if parts.return_conditioning == "hindsight":
        return states.return_to_go / hyper.hindsight_scale
    if parts.return_conditioning == "commanded":
        return commanded_return_to_go(states.return_so_far, hyper.target_return, hyper.return_scale)
    return jnp.zeros_like(states.return_to_go)

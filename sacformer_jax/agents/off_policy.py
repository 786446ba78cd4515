"""What agents that learn from the replay share: weights, the critics' step, the actor's.

Letters: B windows, K steps, C critics. Losses are weighted means over the real steps. Over several
devices B is one's share of the batch; losses and gradients are summed over them, in one reduction
for each network.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax

from sacformer_jax.agents.adam import Adam
from sacformer_jax.agents.core import AgentParts, Metrics
from sacformer_jax.agents.faults import first_fault, num_non_finite
from sacformer_jax.critics import CriticInputs, Critics
from sacformer_jax.types import Hyperparameters, LearnerState, Params, Window

ADAM = Adam()

CHECKED = (
    "obs", "reward", "return_to_go", "policy", "next_q", "critic_loss", "critic_gradient",
    "actor_loss", "actor_gradient",
)  # fmt: skip
"""Tensors of an update that must be finite, in the order in which they come about."""


@dataclasses.dataclass(frozen=True)
class OffPolicyParts(AgentParts):
    """The static parts of an update.

    Attributes:
      actor: the policy's network.
      critics: C critics over windows.
      obs_size: O.
      action_size: A.
      context_length: K.
      num_critic_features: what critics see of the past as the actor does, beside an observation.
    """

    actor: nn.Module
    critics: Critics
    obs_size: int
    action_size: int
    context_length: int
    num_critic_features: int = dataclasses.field(default=0, kw_only=True)


def init_critics(parts: OffPolicyParts, key: jax.Array) -> Params:
    """Parameters of the critics."""
    steps, states = (1, parts.context_length), (1, parts.context_length + 1)
    obs = jnp.zeros((*steps, parts.obs_size + parts.num_critic_features))
    inputs = CriticInputs(
        obs=obs,
        next_obs=obs,
        action=jnp.zeros((*steps, parts.action_size)),
        time_step=jnp.zeros(states, jnp.int32),
        state_mask=jnp.ones(states, bool),
    )
    return parts.critics.init(key, inputs)


@dataclasses.dataclass(frozen=True)
class StepWeights:
    """Weight of each step in the losses, ``[B, K]``, which sum to 1 (over all devices), or to 0."""

    critic: jax.Array
    actor: jax.Array


def step_weights(parts: OffPolicyParts, window: Window) -> StepWeights:
    weight = window.weight[:, None]
    weights = StepWeights(critic=weight * window.bootstrap_mask, actor=weight * window.mask)
    totals = parts.data.sum((jnp.sum(weights.critic), jnp.sum(weights.actor)))
    critic_total, actor_total = (jnp.maximum(total, 1e-8) for total in totals)
    return StepWeights(weights.critic / critic_total, weights.actor / actor_total)


def soft_update(target: Params, online: Params, tau: jax.Array) -> Params:
    """``target + tau * (online - target)``."""
    return jax.tree.map(lambda t, o: t + tau * (o - t), target, online)


@dataclasses.dataclass(frozen=True)
class Backup:
    """What the critics are to learn, and what that was made of.

    Attributes:
      policy: all that the actor's network said.
      next_q: ``[C, B, K]`` of the target critics.
      y: ``[B, K]`` the targets.
    """

    policy: Any
    next_q: jax.Array
    y: jax.Array


def step_critics(
    parts: OffPolicyParts,
    learner: LearnerState,
    hyper: Hyperparameters,
    window: Window,
    inputs: CriticInputs,
    weights: StepWeights,
    backup: Backup,
) -> tuple[LearnerState, Metrics, list[jax.Array]]:
    """One Adam step on ``Σ_i (Q_i(s, a) - y)²``, where everything is finite.

    Returns also how many numbers were not finite in each tensor of ``CHECKED`` so far.
    """

    def loss(params: Params) -> tuple[jax.Array, jax.Array]:
        q = parts.critics.now(params, inputs, window.action)
        return jnp.sum(weights.critic * jnp.sum((q - backup.y) ** 2, axis=0)), q

    (value, q), grads = jax.value_and_grad(loss, has_aux=True)(learner.critic_params)
    given = [
        num_non_finite(window.obs),
        num_non_finite(window.reward),
        num_non_finite(window.return_to_go),
        num_non_finite(*jax.tree.leaves(backup.policy)),
        num_non_finite(backup.next_q),
    ]
    q_mean = jnp.sum(weights.critic * q.mean(axis=0))
    value, q_mean, grads, given = parts.data.sum((value, q_mean, grads, given))
    grad_norm = optax.global_norm(grads)
    non_finite = [*given, num_non_finite(value), num_non_finite(grad_norm)]
    params, opt = ADAM.step_where(
        first_fault(non_finite) < 0, learner.critic_params, grads, learner.critic_opt,
        hyper.critic_learning_rate,
    )  # fmt: skip
    learner = dataclasses.replace(learner, critic_params=params, critic_opt=opt)
    metrics = {"critic_loss": value, "q_mean": q_mean, "critic_grad_norm": grad_norm}
    return learner, metrics, non_finite


def step_actor(
    learner: LearnerState,
    loss: jax.Array,
    grads: Params,
    non_finite: list[jax.Array],
    learning_rate: Params | jax.Array,
) -> tuple[LearnerState, Metrics, jax.Array]:
    """One Adam step of the actor, where everything is finite.

    Args:
      learner: its actor is stepped.
      loss: the actor's, over all devices.
      grads: of it.
      non_finite: as :func:`step_critics` returns it.
      learning_rate: as :func:`~sacformer_jax.agents.adam.Adam.step_where` takes it.

    Returns:
      the learner, metrics, and the update's ``fault``.
    """
    grad_norm = optax.global_norm(grads)
    fault = first_fault([*non_finite, num_non_finite(loss), num_non_finite(grad_norm)])
    params, opt = ADAM.step_where(
        fault < 0, learner.actor_params, grads, learner.actor_opt, learning_rate
    )
    learner = dataclasses.replace(learner, actor_params=params, actor_opt=opt)
    return learner, {"actor_loss": loss, "actor_grad_norm": grad_norm}, fault

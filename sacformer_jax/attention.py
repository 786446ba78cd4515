"""What SACFormer's actor attends to while it acts.

Computed again from the states of an episode: acting itself stays as it is.

Letters: L layers, H heads, T steps of an episode, K pairs of a context, n tokens a step.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from sacformer_jax import normalizer
from sacformer_jax.agents.sacformer import acting_pairs, make_actor
from sacformer_jax.config import Config
from sacformer_jax.context import commanded_return_to_go
from sacformer_jax.envs.core import EnvSpec
from sacformer_jax.networks import STEP_TOKENS
from sacformer_jax.types import Context, PolicyState


def acting_attention(
    config: Config, spec: EnvSpec, policy: PolicyState, contexts: Context
) -> tuple[jax.Array, jax.Array]:
    """Attention of the state acted on, at each step of an episode.

    Args:
      config: of the policy, ``agent="sacformer"``.
      spec: of its environment.
      policy: what acts.
      contexts: ``[T, K]``, the contexts of a whole episode's steps, from its first.

    Returns:
      ``[L, H, T, P, n]``, rows over the last two axes that sum to 1: how much goes to the tokens
      (return-to-go, state, with ``tokens="gsa"`` the action; with ``"joint"`` one) of the pair p
      steps back, P being the pairs that acting sees at most, or T; and ``[T, A]`` the mean before
      tanh, as in acting.
    """
    contexts = dataclasses.replace(contexts, cache={})
    if config.context.acting_context == "window":
        looked = _look(config, spec, policy, contexts, config.context.context_length)
        newest = looked.weights[:, :, :, -1].swapaxes(1, 2)  # [L, H, T, K, n]
        return newest[:, :, :, ::-1], looked.mean[:, -1]
    # One pass over the whole episode, which equals acting through the cache.
    steps = jax.tree.map(lambda leaf: leaf[None, :, -1], contexts)  # [1, T]
    if config.context.context_length > 1:  # an action is known at the next step
        actions = jnp.roll(contexts.action[:, -2], -1, axis=0)
        steps = dataclasses.replace(steps, action=actions[None])
    pairs = acting_pairs(config, spec)
    looked = _look(config, spec, policy, steps, pairs)
    num_steps = steps.mask.shape[1]
    back = jnp.arange(min(pairs, num_steps))
    place = (jnp.arange(num_steps)[:, None] - back)[None, None, :, :, None]  # [1, 1, T, P, 1]
    taken = jnp.take_along_axis(looked.weights[:, 0], jnp.maximum(place, 0), axis=3)
    return jnp.where(place >= 0, taken, 0.0), looked.mean[0]


@dataclasses.dataclass(frozen=True)
class _Looked:
    """Of contexts ``[B, K]``.

    Attributes:
      weights: ``[L, B, H, K, K, n]``, of each state to the tokens of each pair.
      mean: ``[B, K, A]``, of the Gaussian before tanh.
    """

    weights: jax.Array
    mean: jax.Array


def _look(
    config: Config, spec: EnvSpec, policy: PolicyState, contexts: Context, pairs: int
) -> _Looked:
    actor = make_actor(config, spec).clone(context_length=pairs)
    obs = contexts.obs
    if config.context.normalize_obs:
        obs = normalizer.normalize(policy.normalizer, obs)
    return_to_go = commanded_return_to_go(
        contexts.return_so_far, policy.target_return, policy.return_scale
    )
    if config.context.return_conditioning == "none":
        return_to_go = jnp.zeros_like(return_to_go)
    result: Any = actor.apply(
        policy.actor_params,
        obs,
        contexts.action,
        return_to_go,
        contexts.time_step,
        contexts.mask,
        mutable=["intermediates"],
    )
    output, looked = result
    tokens, length = STEP_TOKENS[config.context.tokens], contexts.mask.shape[1]
    n = len(tokens.names)
    layers = []
    for i in range(config.actor.actor_layers):
        weights = looked["intermediates"]["trunk"][f"block_{i}"]["attention"][0]  # [B, H, ., nK]
        if weights.shape[2] != length:  # of every token
            weights = weights[:, :, tokens.state :: n]
        layers.append(weights.reshape(*weights.shape[:3], length, n))
    return _Looked(jnp.stack(layers), output.gaussian.mean)

"""PPO's policy and value: networks of their own on the current state, and acting.

Letters: N environments, O, A.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from sacformer_jax.agents.core import AgentParts
from sacformer_jax.config import PpoConfig
from sacformer_jax.envs.core import EnvSpec
from sacformer_jax.layers import Dense, orthogonal
from sacformer_jax.networks import MLP, GaussianParams
from sacformer_jax.types import Acted, Context, Params, PolicyState


class PpoActor(nn.Module):
    """The mean by an MLP; the log standard deviation is the same in every state, at first 0.

    Attributes:
      widths: of the hidden layers, initialized orthogonally with gain √2.
      activation: one of :data:`~sacformer_jax.transformer.ACTIVATIONS`.
      action_size: A.
      head_init_scale: gain of the orthogonal initialization of the mean's layer.
      dtype: of the hidden layers' products.
    """

    widths: Sequence[int]
    activation: str
    action_size: int
    head_init_scale: float
    dtype: str = "float32"

    @nn.compact
    def __call__(self, obs: jax.Array) -> GaussianParams:
        """``obs [..., O]``, normalized -> ``[..., A]``; of the Gaussian itself, without tanh."""
        mlp = MLP(self.widths, self.activation, False, self.dtype, "orthogonal", name="mlp")
        init = orthogonal(self.head_init_scale)
        mean = Dense(self.action_size, init, name="mean")(mlp(obs))
        log_std = self.param("log_std", nn.initializers.zeros_init(), (self.action_size,))
        return GaussianParams(mean, jnp.broadcast_to(log_std, mean.shape))


class PpoCritic(nn.Module):
    """V(s): an MLP of its own; attributes as of :class:`PpoActor`."""

    widths: Sequence[int]
    activation: str
    layer_norm: bool
    dtype: str = "float32"

    @nn.compact
    def __call__(self, obs: jax.Array) -> jax.Array:
        """``obs [..., O]``, normalized -> ``[...]``."""
        mlp = MLP(
            self.widths, self.activation, self.layer_norm, self.dtype, "orthogonal", name="mlp"
        )
        return Dense(1, orthogonal(1.0), name="value")(mlp(obs))[..., 0]


def log_prob(gaussian: GaussianParams, sample: jax.Array) -> jax.Array:
    """Log density of samples ``[..., A]`` before they are clipped to the bounds, ``[...]``."""
    density = jax.scipy.stats.norm.logpdf(sample, gaussian.mean, jnp.exp(gaussian.log_std))
    return jnp.sum(density, axis=-1)


def entropy(gaussian: GaussianParams) -> jax.Array:
    """Entropy in nats, ``[...]``."""
    return jnp.sum(gaussian.log_std + 0.5 * math.log(2 * math.pi * math.e), axis=-1)


@dataclasses.dataclass(frozen=True)
class PpoParts(AgentParts):
    """The static parts.

    Attributes:
      actor: the policy's network.
      critic: the value's network.
      settings: the configuration's section.
      num_rounds: rounds of learning in the run.
      spec: facts of the environment.
    """

    actor: PpoActor
    critic: PpoCritic
    settings: PpoConfig
    num_rounds: int
    spec: EnvSpec

    def policy(self, params: Params, obs: jax.Array) -> GaussianParams:
        gaussian: Any = self.actor.apply(params, obs)
        return gaussian

    def value(self, params: Params, obs: jax.Array) -> jax.Array:
        value: Any = self.critic.apply(params, obs)
        return value


def act(
    parts: PpoParts, policy: PolicyState, context: Context, key: jax.Array, explore: bool
) -> Acted:
    """A sample of the Gaussian, or its mean; the action is that within the bounds."""
    obs = parts.normalized(policy.normalizer, context.obs[:, -1])
    gaussian = parts.policy(policy.actor_params, obs)
    sample = gaussian.mean
    if explore:
        noise = parts.data.normal(key, sample.shape)
        sample = sample + jnp.exp(gaussian.log_std) * noise
    low, high = jnp.asarray(parts.spec.action_low), jnp.asarray(parts.spec.action_high)
    return Acted(jnp.clip(sample, low, high), context, sample if explore else None)

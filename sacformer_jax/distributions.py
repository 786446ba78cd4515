"""Distributions over a box of actions: the tanh-squashed Gaussian, and one point with noise."""

from __future__ import annotations

import dataclasses
import math
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np


class ActionDistribution(Protocol):
    """What an actor's heads stand for."""

    def mode(self, mean: jax.Array) -> jax.Array:
        """The action without noise, ``[..., A]``."""
        ...

    def sample_and_log_prob(
        self, noise: jax.Array, mean: jax.Array, log_std: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """A reparameterized action ``[..., A]`` and its log density ``[...]``.

        ``noise [..., A]`` is standard normal.
        """
        ...

    def imitation_loss(self, action: jax.Array, mean: jax.Array, log_std: jax.Array) -> jax.Array:
        """What is minimal where the actor does as it was shown, ``[...]``."""
        ...


_ON_THE_BOUND = 1.0 - 1e-3
"""Squashed actions beyond count as this: the inverse of tanh at the bounds is infinite."""


@dataclasses.dataclass(frozen=True)
class _Box:
    """Action bounds.

    Attributes:
      low: lower action bounds.
      high: upper action bounds.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]

    @property
    def _center(self) -> np.ndarray:
        return ((np.asarray(self.high) + np.asarray(self.low)) / 2).astype(np.float32)

    @property
    def _half_range(self) -> np.ndarray:
        return ((np.asarray(self.high) - np.asarray(self.low)) / 2).astype(np.float32)

    def mode(self, mean: jax.Array) -> jax.Array:
        """The action at the mean, ``[..., A]``: ``center + half_range * tanh(mean)``."""
        return self._center + self._half_range * jnp.tanh(mean)

    def _in_unit_box(self, action: jax.Array) -> jax.Array:
        return (action - self._center) / self._half_range


@dataclasses.dataclass(frozen=True)
class TanhGaussian(_Box):
    """``action = center + half_range * tanh(u)``, ``u ~ N(mean, exp(log_std)^2)``."""

    def sample_and_log_prob(
        self, noise: jax.Array, mean: jax.Array, log_std: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """A reparameterized action and its log density.

        The tanh correction is in its stable form (SAC, appendix C):
        ``log(1 - tanh(u)^2) = 2 (log 2 - u - softplus(-2u))``.

        Args:
          noise: ``[..., A]`` standard normal.
          mean: ``[..., A]``.
          log_std: ``[..., A]``.

        Returns:
          ``(action [..., A], log_prob [...])``.
        """
        u = mean + jnp.exp(log_std) * noise
        log_prob = self._log_density(u, noise, log_std)
        return self._center + self._half_range * jnp.tanh(u), log_prob

    def imitation_loss(self, action: jax.Array, mean: jax.Array, log_std: jax.Array) -> jax.Array:
        """Minus the log density of an action, ``[...]``; one on the bounds is drawn in a little."""
        u = jnp.arctanh(jnp.clip(self._in_unit_box(action), -_ON_THE_BOUND, _ON_THE_BOUND))
        return -self._log_density(u, (u - mean) * jnp.exp(-log_std), log_std)

    def _log_density(self, u: jax.Array, noise: jax.Array, log_std: jax.Array) -> jax.Array:
        """Of the action that ``u = mean + exp(log_std) noise`` is squashed to."""
        gaussian = -0.5 * noise**2 - log_std - 0.5 * math.log(2 * math.pi)
        squash = 2.0 * (math.log(2.0) - u - jax.nn.softplus(-2.0 * u)) + np.log(self._half_range)
        return jnp.sum(gaussian - squash, axis=-1)


@dataclasses.dataclass(frozen=True)
class NoisyPoint(_Box):
    """``action = center + half_range * (tanh(mean) + noise)``, kept within the bounds.

    The log density counts as 0: SAC without entropy.

    Attributes:
      noise: standard deviation of the noise, in half ranges.
      noise_clip: its largest absolute value, in half ranges.
    """

    noise: float
    noise_clip: float

    def sample_and_log_prob(
        self, noise: jax.Array, mean: jax.Array, log_std: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """The noisy action ``[..., A]`` and zeros ``[...]``; ``log_std`` is not looked at.

        ``noise [..., A]`` is standard normal.
        """
        del log_std
        noise = jnp.clip(self.noise * noise, -self.noise_clip, self.noise_clip)
        action = self.mode(mean) + self._half_range * noise
        bounded = jnp.clip(action, jnp.asarray(self.low), jnp.asarray(self.high))
        return bounded, jnp.zeros(mean.shape[:-1])

    def imitation_loss(self, action: jax.Array, mean: jax.Array, log_std: jax.Array) -> jax.Array:
        """The squared distance to an action, in half ranges, ``[...]``."""
        del log_std
        return jnp.sum((self._in_unit_box(action) - jnp.tanh(mean)) ** 2, axis=-1)

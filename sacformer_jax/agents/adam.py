"""Adam, of a step that may have to be left out."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import optax

from sacformer_jax.types import Params

_DECAYS = (0.9, 0.999)


@dataclasses.dataclass(frozen=True)
class Adam:
    """Adam (Kingma & Ba, arXiv 1412.6980) with ``optax.scale_by_adam``'s state and mathematics.

    optax makes a step from moments that it throws away where ours are kept as they were. XLA then
    computes the moments twice on a CPU, and copies both of every parameter to have the old ones
    still (docs/speed.md). Here the step is made from the moments that are kept.

    Attributes:
      eps: ε, added to the root of the second moment.
    """

    eps: float = 1e-8

    def init(self, params: Params) -> optax.ScaleByAdamState:
        """Moments of zero."""
        state = optax.scale_by_adam().init(params)
        assert isinstance(state, optax.ScaleByAdamState)
        return state

    def step_where(
        self,
        sound: jax.Array,
        params: Params,
        grads: Params,
        state: optax.OptState,
        learning_rate: Params | jax.Array,
    ) -> tuple[Params, optax.ScaleByAdamState]:
        """One step if ``sound``; otherwise parameters and moments stay as they are.

        Args:
          sound: bool.
          params: what to step.
          grads: their gradients.
          state: of :meth:`init` or an earlier step.
          learning_rate: one for all, or a tree like that of the parameters, or of its upper part.
        """
        assert isinstance(state, optax.ScaleByAdamState)
        first_decay, second_decay = _DECAYS
        stepped = optax.ScaleByAdamState(
            count=optax.safe_increment(state.count),
            mu=optax.tree.update_moment(grads, state.mu, first_decay, 1),
            nu=optax.tree.update_moment_per_elem_norm(grads, state.nu, second_decay, 2),
        )
        kept = jax.tree.map(lambda new, old: jnp.where(sound, new, old), stepped, state)
        # The corrections of the moments, 1 - β^t, as scalars: one division a number, not three.
        first, second = (1.0 - decay**stepped.count for decay in _DECAYS)
        size, eps = jnp.sqrt(second) / first, self.eps * jnp.sqrt(second)

        def step(param: jax.Array, mu: jax.Array, nu: jax.Array, rate: jax.Array) -> jax.Array:
            return jnp.where(sound, param - rate * size * (mu / (jnp.sqrt(nu) + eps)), param)

        rates = jax.tree.broadcast(learning_rate, params)
        return jax.tree.map(step, params, kept.mu, kept.nu, rates), kept

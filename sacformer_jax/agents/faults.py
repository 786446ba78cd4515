"""Learning faults: which tensor of an update was not finite first."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import optax

from sacformer_jax.types import Params

NO_FAULT = -1
"""In place of a tensor's number where everything was finite."""


def num_non_finite(*tensors: jax.Array) -> jax.Array:
    """How many numbers in them are NaN or infinite, as a float: it can be summed over devices."""
    return sum(
        (jnp.sum(~jnp.isfinite(tensor), dtype=jnp.float32) for tensor in tensors),
        start=jnp.float32(0),
    )


def first_fault(non_finite: list[jax.Array]) -> jax.Array:
    """int32: the place of the first count above zero, or :data:`NO_FAULT`."""
    found = jnp.stack(non_finite) > 0
    return jnp.where(jnp.any(found), jnp.argmax(found).astype(jnp.int32), NO_FAULT)


def adam_where(
    sound: jax.Array,
    optimizer: optax.GradientTransformation,
    params: Params,
    grads: Params,
    opt_state: optax.OptState,
    learning_rate: Params | jax.Array,
) -> tuple[Params, optax.OptState]:
    """One Adam step if ``sound``; otherwise parameters and moments stay as they are.

    The learning rate is one for all, or a tree like that of the parameters, or of its upper part.
    """
    direction, stepped = optimizer.update(grads, opt_state)
    rates = jax.tree.broadcast(learning_rate, params)
    params = jax.tree.map(
        lambda p, d, rate: jnp.where(sound, p - rate * d, p), params, direction, rates
    )
    return params, jax.tree.map(lambda new, old: jnp.where(sound, new, old), stepped, opt_state)

"""Learning faults: which tensor of an update was not finite first."""

from __future__ import annotations

import jax
import jax.numpy as jnp

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

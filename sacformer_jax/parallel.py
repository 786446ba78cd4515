"""Many members, many devices: what functions that run inside ``vmap`` and ``shard_map`` need.

A run's members are vmapped; over devices lies a mesh with the axes :data:`MEMBER_AXIS` and
:data:`DATA_AXIS`. The first needs no communication and no part of the program knows of it. The
second splits environments, replay and batch, so whatever draws or averages over them asks
:class:`DataAxis`.
"""

from __future__ import annotations

import dataclasses
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

Tree = TypeVar("Tree")

MEMBER_AXIS, DATA_AXIS = "seed", "data"


@dataclasses.dataclass(frozen=True)
class DataAxis:
    """The part of the data that a device holds: rows of what one device alone would hold.

    With one shard every function is the identity and costs nothing. With more they may be called
    only where the axis is bound (in ``shard_map`` over the mesh, or ``vmap`` with its name).

    Attributes:
      size: D, number of shards.
    """

    size: int = 1

    def sum(self, tree: Tree) -> Tree:
        """Sums float leaves over the shards, all in one reduction."""
        if self.size == 1:
            return tree
        flat, unravel = ravel_pytree(tree)
        return unravel(jax.lax.psum(flat, DATA_AXIS))

    def count(self, number: jax.Array) -> jax.Array:
        """Sums integers over the shards."""
        return number if self.size == 1 else jax.lax.psum(number, DATA_AXIS)

    def max(self, value: jax.Array) -> jax.Array:
        """The largest over the shards."""
        return value if self.size == 1 else jax.lax.pmax(value, DATA_AXIS)

    def rows(self, everything: jax.Array) -> jax.Array:
        """The rows ``[n, ...]`` that this shard has of ``[D * n, ...]``."""
        if self.size == 1:
            return everything
        num = everything.shape[0] // self.size
        start = num * jax.lax.axis_index(DATA_AXIS)
        return jax.lax.dynamic_slice_in_dim(everything, start, num)

    def normal(self, key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
        """The rows, ``shape``, that this shard has of one standard normal draw for all."""
        return self.rows(jax.random.normal(key, (self.size * shape[0], *shape[1:])))

    def own_key(self, key: jax.Array) -> jax.Array:
        """A key of this shard's own, for draws too large to be made for all."""
        if self.size == 1:
            return key
        return jax.random.fold_in(key, jax.lax.axis_index(DATA_AXIS))


UNDIVIDED = DataAxis()
"""All of it on one device."""


@jax.custom_batching.custom_vmap
def any_of_all(mask: Any) -> jax.Array:
    """``jnp.any``, but under ``vmap`` over all batched values: one unbatched bool.

    A ``lax.cond`` or ``lax.while_loop`` whose condition is batched runs both sides, or carries a
    select of its whole state; on this it stays what it is. What it guards must be right for those
    that did not ask for it.
    """
    return jnp.any(mask)


@any_of_all.def_vmap
def _any_of_all_batched(
    axis_size: int, in_batched: list[bool], mask: Any
) -> tuple[jax.Array, bool]:
    return any_of_all(mask), False

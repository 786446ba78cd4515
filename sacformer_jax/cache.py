"""Where the tokens of a running episode lie in the actor's key-value cache.

Letters: B environments, n tokens a step, C tokens in the cache.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp


@flax.struct.dataclass
class CachePlaces:
    """Where the n newest tokens of a running episode go in the cache, and what they attend to.

    Attributes:
      positions: int32 ``[B, n]``.
      mask: bool ``[B, n, C]``.
    """

    positions: jax.Array
    mask: jax.Array


def cache_places(
    time_step: jax.Array, num_tokens: int, state_token: int, context_length: int
) -> CachePlaces:
    """The places of an episode's tokens ``(G_0, S_0, [A_0,] G_1, …)`` in a ring.

    Token number i lies at place i modulo C. The ring holds ``context_length`` steps; with a token
    after the state, that of the action, one more: A_{t-1} comes with step t and sees a step that
    S_t no longer does.

    Args:
      time_step: int32 ``[B]``, t of the newest state.
      num_tokens: n of a step; the newest n are those up to the one of the state.
      state_token: which of a step's tokens stands for the state, from 0.
      context_length: how many steps a token sees, its own included.
    """
    n, later = num_tokens, num_tokens - 1 - state_token
    size = (context_length + (later > 0)) * n
    new = time_step[:, None] * n + jnp.arange(-later, n - later)  # [B, n]
    newest = new[:, -1:]
    # The number of the token that lies at each place; below 0 it is none of this episode.
    held = newest - (newest - jnp.arange(size)) % size  # [B, C]
    query, key = new[:, :, None], held[:, None, :]
    visible = (key >= 0) & (key <= query) & (query // n - key // n < context_length)
    return CachePlaces(positions=new % size, mask=visible)

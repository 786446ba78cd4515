"""The finished episodes in the replay, one table per environment column.

A column's episodes are overwritten in the order in which they were stored, so its table is a ring:
one episode leaves when its first step is overwritten, one enters when it ends. Episodes shorter
than K steps never enter, which bounds the table to T / K entries a column.

Letters: N environments, T ring length of a column, E entries of a table, B draws, K steps.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp

from sacformer_jax.types import EpisodeTable, Transition


def init(num_envs: int, ring_length: int, shortest: int) -> EpisodeTable:
    """No episodes: ``[N, E]``."""
    shape = (num_envs, ring_length // shortest)
    # Arrays of their own, never aliases: they are donated.
    return EpisodeTable(
        start=jnp.zeros(shape, jnp.int32),
        length=jnp.zeros(shape, jnp.int32),
        first=jnp.zeros(num_envs, jnp.int32),
        count=jnp.zeros(num_envs, jnp.int32),
    )


def record(
    table: EpisodeTable, step: Transition, head: jax.Array, ring_length: int, shortest: int
) -> EpisodeTable:
    """The table after ``step`` was written at the ring position ``head`` of every column.

    A last step of bad physics is left out of its episode.
    """
    rows, entries = jnp.arange(table.first.shape[0]), table.start.shape[1]
    # The first step of a stored episode lies where nothing is written before the ring is full.
    overwritten = (table.count > 0) & (table.start[rows, table.first] == head)
    first = (table.first + overwritten) % entries
    count = table.count - overwritten

    length = step.time_step + 1 - step.bad
    enters = (step.terminated | step.truncated) & (length >= shortest)
    # Beyond the table, and so dropped, where none enters.
    place = jnp.where(enters, (first + count) % entries, entries)

    def write(column: jax.Array, value: jax.Array) -> jax.Array:
        return column.at[rows, place].set(value, mode="drop")

    return EpisodeTable(
        start=write(table.start, (head - step.time_step) % ring_length),
        length=write(table.length, length),
        first=first,
        count=count + enters,
    )


@flax.struct.dataclass
class Drawn:
    """Episodes drawn, each ``[B]``.

    Attributes:
      column: int32, the environment.
      start: int32, ring position of the first step.
      length: int32, steps.
      exists: bool, false where the table is empty.
    """

    column: jax.Array
    start: jax.Array
    length: jax.Array
    exists: jax.Array


def look_up(table: EpisodeTable, column: jax.Array, age_rank: jax.Array) -> Drawn:
    """The episodes that are the ``age_rank``-th oldest of their ``column``, each int32 ``[B]``."""
    place = (table.first[column] + age_rank) % table.start.shape[1]
    return Drawn(
        column=column,
        start=table.start[column, place],
        length=table.length[column, place],
        exists=jnp.broadcast_to(jnp.any(table.count > 0), column.shape),
    )


def draw_entries(counts: jax.Array, key: jax.Array, batch_size: int) -> tuple[jax.Array, jax.Array]:
    """``(column, age_rank)`` of B entries of columns with ``counts [N]`` of them, all as likely.

    Each is int32 ``[B]``; rank 0 is a column's oldest. Without any entry they mean nothing.
    """
    ends = jnp.cumsum(counts)
    number = jax.random.randint(key, (batch_size,), 0, jnp.maximum(ends[-1], 1))
    column = jnp.minimum(jnp.searchsorted(ends, number, side="right"), ends.size - 1)
    return column, number - (ends - counts)[column]


def distinct_sorted(key: jax.Array, length: jax.Array, num: int) -> jax.Array:
    """``num`` different numbers below ``length [B]``, sorted, every set as likely: ``[B, num]``.

    Floyd's algorithm (Bentley and Floyd, 1987); ``length`` must be at least ``num``.
    """
    bound = length[:, None] - num + jnp.arange(num)  # [B, num]
    draws = jax.random.randint(key, bound.shape, 0, bound + 1)
    chosen = draws[:, :1]
    for i in range(1, num):
        new = draws[:, i : i + 1]
        taken = jnp.any(chosen == new, axis=1, keepdims=True)
        chosen = jnp.concatenate([chosen, jnp.where(taken, bound[:, i : i + 1], new)], axis=1)
    return jnp.sort(chosen, axis=1)

"""Checksums of arrays, the same however they lie on devices and processes.

A leaf is taken apart into blocks, one for each index along its first few axes, the *block axes*.
Its digest is the sum modulo 2^256 of the blocks' SHA-256, so that every process can add up what it
holds, in any order. Only block axes may be split over devices of several processes.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

_MODULUS = 2**256


def digest(tree: Any, block_axes: Any = None) -> str:
    """SHA-256 over every leaf's path, type, shape and bytes: equal exactly when the trees are.

    Args:
      tree: arrays; those that are not split over processes are taken from the first process.
      block_axes: number of block axes of each leaf, a PyTree of ints like ``tree``; None: 0 of all.

    Raises:
      ValueError: see :func:`leaf_digests`.
    """
    return joined(leaf_digests(tree, block_axes))


def joined(digests: dict[str, str]) -> str:
    """The digest of a tree, of those of its leaves."""
    sha = hashlib.sha256()
    for path in sorted(digests):
        sha.update(f"{path}|{digests[path]}\n".encode())
    return sha.hexdigest()


def leaf_digests(tree: Any, block_axes: Any = None) -> dict[str, str]:
    """The digest of each leaf, by its path.

    Where a leaf is split over processes, all have to call it at the same time and get the same.

    Args:
      tree: as for :func:`digest`.
      block_axes: as for :func:`digest`; other ones give other digests.

    Raises:
      ValueError: a leaf has fewer axes, or is split over processes along another axis.
    """
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    axes = [0] * len(leaves) if block_axes is None else jax.tree.leaves(block_axes)
    paths = [jax.tree_util.keystr(path) for path, _ in leaves]
    sums = [
        _sum_of_blocks(path, leaf, num_axes)
        for path, (_, leaf), num_axes in zip(paths, leaves, axes, strict=True)
    ]
    if any(isinstance(x, jax.Array) and not x.is_fully_addressable for _, x in leaves):
        own = np.frombuffer(b"".join(value.to_bytes(32, "big") for value in sums), np.uint8)
        gathered = np.asarray(multihost_utils.process_allgather(own.reshape(-1, 32)))
        sums = [
            sum(int.from_bytes(part.tobytes(), "big") for part in parts) % _MODULUS
            for parts in gathered.transpose(1, 0, 2)
        ]
    return {path: f"{value:064x}" for path, value in zip(paths, sums, strict=True)}


def num_bytes(tree: Any) -> int:
    """Bytes of all leaves (arrays or shapes; PRNG keys not counted)."""
    leaves = [x for x in jax.tree.leaves(tree) if not is_key(x)]
    return sum(int(np.prod(leaf.shape)) * leaf.dtype.itemsize for leaf in leaves)


def is_key(leaf: Any) -> bool:
    """Whether an array (or shape) is one of typed PRNG keys."""
    return bool(jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key))


def _sum_of_blocks(path: str, leaf: Any, block_axes: int) -> int:
    """The part of a leaf's digest that this process holds."""
    name = str(leaf.dtype)  # of keys it tells the implementation
    if is_key(leaf):
        leaf = jax.random.key_data(leaf)
        name = f"{name}|{leaf.dtype}"
    elif not isinstance(leaf, jax.Array):
        leaf = np.asarray(leaf)
    if block_axes > leaf.ndim:
        raise ValueError(f"{path} has {leaf.ndim} axes: {block_axes} cannot be block axes")
    head = hashlib.sha256(f"{path}|{name}|{leaf.shape}|".encode())
    total = 0
    for start, piece in _pieces(path, leaf, block_axes):
        for index in itertools.product(*map(range, piece.shape[:block_axes])):
            sha = head.copy()
            place = tuple(i + offset for i, offset in zip(index, start, strict=True))
            sha.update(f"{place}|".encode())
            # As bytes, since bfloat16 cannot be hashed as it is.
            sha.update(np.ascontiguousarray(piece[index]).reshape(-1).view(np.uint8).data)
            total += int.from_bytes(sha.digest(), "big")
    return total % _MODULUS


def _pieces(path: str, leaf: Any, block_axes: int) -> Iterator[tuple[tuple[int, ...], np.ndarray]]:
    """What this process answers for: whole blocks, and where along the block axes they start."""
    within = leaf.shape[block_axes:]
    here = not isinstance(leaf, jax.Array) or leaf.is_fully_addressable
    if not here or (jax.process_count() == 1 and isinstance(leaf, jax.Array)):
        shards = [shard for shard in leaf.addressable_shards if shard.replica_id == 0]
        if all(shard.data.shape[block_axes:] == within for shard in shards):
            for shard in shards:
                start = tuple(part.start or 0 for part in shard.index[:block_axes])
                yield start, np.asarray(shard.data)
            return
    if not here:
        raise ValueError(f"{path} is split over processes along another axis than {block_axes=}")
    if jax.process_index() == 0:
        yield (0,) * block_axes, np.asarray(leaf)

"""Comparing PyTrees leaf by leaf."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np


def plain_leaves(tree: Any) -> dict[str, np.ndarray]:
    """Every leaf by its path, PRNG keys as their data."""
    leaves = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            leaf = jax.random.key_data(leaf)
        leaves[jax.tree_util.keystr(path)] = np.asarray(leaf)
    return leaves


def unequal(a: Any, b: Any) -> dict[str, float]:
    """The leaves that differ in any bit, and by how much; NaN equals itself."""
    ours, theirs = plain_leaves(a), plain_leaves(b)
    assert ours.keys() == theirs.keys()
    differ = {}
    for name, x in ours.items():
        y = theirs[name]
        assert (x.dtype, x.shape) == (y.dtype, y.shape), name
        if x.tobytes() != y.tobytes():
            differ[name] = float(np.max(np.abs(x.astype(float) - y.astype(float))))
    return differ


def largest_difference(a: Any, b: Any) -> float:
    """Over all leaves."""
    return max(unequal(a, b).values(), default=0.0)

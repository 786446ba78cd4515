"""Digests: equal exactly when the trees are, however the arrays lie on devices."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sacformer_jax.digests import digest, leaf_digests, num_bytes

TREE = {
    "weights": np.arange(6, dtype=np.float32).reshape(2, 3),
    "count": np.int32(4),
    "mask": np.array([True, False]),
    "nested": [np.zeros(2, np.float32), {"key": jax.random.key(0)}],
}


def _changed(**leaves: Any) -> dict[str, Any]:
    return {**TREE, **leaves}


def test_digest_is_equal_for_equal_trees() -> None:
    assert len(digest(TREE)) == 64
    assert int(digest(TREE), 16) >= 0
    again = jax.tree.map(lambda x: x if isinstance(x, jax.Array) else jnp.asarray(x), TREE)
    assert digest(again) == digest(TREE)  # NumPy or JAX arrays
    strided = np.asfortranarray(TREE["weights"])
    assert digest(_changed(weights=strided)) == digest(TREE)


@pytest.mark.parametrize(
    "other",
    [
        _changed(weights=np.arange(6, dtype=np.float32).reshape(2, 3) + np.float32(1e-6)),
        _changed(weights=np.arange(6, dtype=np.float32).reshape(3, 2)),
        _changed(weights=np.arange(6, dtype=np.float32).reshape(2, 3).view(np.int32)),
        _changed(weights=np.arange(6, dtype=np.float64).reshape(2, 3)),
        _changed(weights=np.array([[-0.0, 1, 2], [3, 4, 5]], np.float32)),
        _changed(count=np.int32(5)),
        _changed(count=np.uint32(4)),
        _changed(mask=np.array([True, True])),
        _changed(mask=np.array([1, 0], np.int8)),
        _changed(nested=[np.zeros(2, np.float32), {"key": jax.random.key(1)}]),
        _changed(nested=[np.zeros(2, np.float32), {"key": jax.random.key(0, impl="rbg")}]),
        _changed(nested=[np.zeros(2, np.float32), {"other": jax.random.key(0)}]),
        _changed(nested=[np.zeros(3, np.float32), {"key": jax.random.key(0)}]),
        _changed(more=np.zeros(1)),
        {name: leaf for name, leaf in TREE.items() if name != "mask"},
    ],
)
def test_digest_sees_every_change(other: Any) -> None:
    assert digest(other) != digest(TREE)


def test_digest_tells_a_scalar_from_an_array_of_one() -> None:
    assert digest({"count": np.int32(4)}) != digest({"count": np.array([4], np.int32)})


def test_digest_takes_bfloat16() -> None:
    assert digest(jnp.ones(2, jnp.bfloat16)) != digest(jnp.zeros(2, jnp.bfloat16))


def test_num_bytes() -> None:
    # 6 floats, an int32, 2 bools, 2 floats; the key is not counted.
    assert num_bytes(TREE) == 24 + 4 + 2 + 8


# --- block axes --------------------------------------------------------------------------------


def test_block_axes_are_part_of_a_digest() -> None:
    tree = {"a": np.arange(12, dtype=np.int32).reshape(2, 3, 2)}
    digests = {digest(tree, {"a": axes}) for axes in range(4)}
    assert len(digests) == 4


def test_more_block_axes_than_axes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"\['a'\] has 1 axes"):
        digest({"a": np.zeros(3)}, {"a": 2})


def test_blocks_that_change_places_are_seen() -> None:
    tree = {"a": np.arange(6).reshape(3, 2)}
    assert digest({"a": tree["a"][::-1]}, {"a": 1}) != digest(tree, {"a": 1})
    same = {"a": np.ones((3, 2))}
    changed = {"a": np.array([[1, 1], [2, 2], [1, 1]], np.float64)}
    assert digest(same, {"a": 1}) != digest(changed, {"a": 1})


def test_leaves_are_told_apart() -> None:
    tree = {"a": jnp.ones(2), "b": [jnp.zeros(3)]}
    before, after = leaf_digests(tree), leaf_digests({**tree, "b": [jnp.ones(3)]})
    assert set(before) == {"['a']", "['b'][0]"}
    assert {path for path in before if before[path] != after[path]} == {"['b'][0]"}


def test_nothing_has_a_digest_too() -> None:
    assert digest({}) != digest({"a": np.zeros((0, 3))}) != digest({"a": np.zeros((3, 0))})


_SHARDED = """
import jax, numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec as P
from sacformer_jax.digests import digest, leaf_digests

assert jax.device_count() == 8
mesh = jax.make_mesh((2, 4), ("seed", "data"), axis_types=(AxisType.Auto,) * 2)
keys = jax.random.split(jax.random.key(3), 2)
tree = {
    "both": np.arange(2 * 4 * 5, dtype=np.float32).reshape(2, 4, 5),
    "first": np.arange(6, dtype=np.int32).reshape(2, 3),
    "none": np.int32(7),
    "mask": np.array([True, False]),
    "half": np.asarray(jax.numpy.arange(8).reshape(2, 4), jax.numpy.bfloat16),
    "key": keys,
}
axes = {"both": 2, "first": 1, "none": 0, "mask": 1, "half": 2, "key": 1}
plain = digest(jax.tree.map(lambda x: jax.device_put(x, jax.devices()[5]), tree), axes)
layouts = [
    {"both": P("seed", "data"), "first": P("seed"), "half": P("seed", "data"), "key": P("seed")},
    {"both": P("seed"), "first": P(), "half": P(None, "data"), "key": P()},
    {"both": P(None, ("data",)), "mask": P("seed"), "half": P("seed")},
    {"both": P(None, None, None), "first": P(None), "key": P("seed")},
]
for specs in layouts:
    put = {
        name: jax.device_put(x, NamedSharding(mesh, specs.get(name, P())))
        for name, x in tree.items()
    }
    assert digest(put, axes) == plain, specs
    # One process sees everything, so even other axes may be split.
    whole = digest(put, {**axes, "both": 0})
    assert whole == digest(tree, {**axes, "both": 0}) != plain
changed = {**put, "both": put["both"].at[1, 3, 4].add(1)}
assert digest(changed, axes) != plain
print("equal")
"""


def test_digest_does_not_depend_on_how_arrays_are_split() -> None:
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=8"
    environment = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    result = subprocess.run(
        [sys.executable, "-c", _SHARDED], env=environment, capture_output=True, text=True
    )
    assert result.stdout == "equal\n", result.stderr

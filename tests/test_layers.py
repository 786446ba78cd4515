"""The layers against flax's and plain attention: values, gradients, jit, vmap; dropout by count."""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gpt2 import randomized

from sacformer_jax.layers import Dense, Dropout, LayerNorm, attend, orthogonal

LEADING = {"rows": (7,), "sequences": (3, 5)}


def numbers(*shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def value_and_grads(function, *args):
    """Of the scalar ``Σ sin(function)``, so that the incoming gradient is not constant."""
    total = lambda *inner: jnp.sum(jnp.sin(function(*inner)))  # noqa: E731
    return jax.value_and_grad(total, argnums=tuple(range(len(args))))(*args)


def assert_same(actual, expected, rtol=1e-5, atol=1e-5):
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=rtol, atol=atol)


PAIRS = {
    "dense": (
        Dense(6, nn.initializers.lecun_uniform()),
        nn.Dense(6, kernel_init=nn.initializers.lecun_uniform()),
    ),
    "layer_norm": (LayerNorm(), nn.LayerNorm(epsilon=1e-5)),
}


@pytest.mark.parametrize("jit", [True, False])
@pytest.mark.parametrize("leading", LEADING)
@pytest.mark.parametrize("name", PAIRS)
def test_layers_are_flax_layers(name, leading, jit):
    ours, flaxs = PAIRS[name]
    x = 3.0 * numbers(*LEADING[leading], 4) + 1.0
    params = ours.init(jax.random.key(3), x)
    assert_same(params, flaxs.init(jax.random.key(3), x), rtol=0, atol=0)
    params = randomized(params)
    wrap = jax.jit if jit else lambda function: function
    assert_same(
        *(wrap(lambda p, y, m=m: value_and_grads(m.apply, p, y))(params, x) for m in PAIRS[name])
    )


@pytest.mark.parametrize("name", PAIRS)
def test_layers_under_vmap(name):
    """As twin critics use them: two parameter sets, inputs common to both or not."""
    ours, flaxs = PAIRS[name]
    x = numbers(2, 5, 4)
    params = jax.vmap(ours.init, (0, None))(jax.random.split(jax.random.key(0), 2), x[0])
    for axis, inputs in ((None, x[0]), (0, x)):

        def grads(module, axis=axis, inputs=inputs):
            apply = jax.vmap(module.apply, (0, axis))
            return value_and_grads(apply, randomized(params), inputs)

        assert_same(grads(ours), grads(flaxs))


def test_dense_in_bfloat16_keeps_its_parameters():
    layer, x = Dense(6, nn.initializers.lecun_uniform(), "bfloat16"), numbers(5, 4)
    params = layer.init(jax.random.key(0), x)
    assert jax.tree.leaves(params)[0].dtype == jnp.float32
    assert layer.apply(params, x).dtype == jnp.bfloat16
    _, (rounded, _) = value_and_grads(layer.apply, params, x)
    exact = value_and_grads(PAIRS["dense"][0].apply, params, x)[1][0]
    assert jax.tree.leaves(rounded)[0].dtype == jnp.float32
    assert_same(rounded, exact, rtol=0.05, atol=0.05)


# --- attention -------------------------------------------------------------------------------


def plain_attention(query, key, value, mask, keep):
    """One query at a time."""
    rows = []
    for s in range(query.shape[2]):
        scores = jnp.sum(query[:, :, s, None] * key, axis=-1) / np.sqrt(query.shape[-1])
        scores = jnp.where(mask[:, None, s], scores, -jnp.inf)
        weights = jnp.exp(scores - scores.max(-1, keepdims=True))
        weights = weights / weights.sum(-1, keepdims=True)
        weights = weights if keep is None else weights * keep[:, :, s]
        rows.append(jnp.sum(weights[..., None] * value, axis=2))
    return jnp.stack(rows, axis=2)


def attention_inputs(batch=3, heads=2, queries=3, keys=5, width=4):
    rng = np.random.default_rng(1)
    mask = rng.uniform(size=(batch, queries, keys)) < 0.5
    mask[..., 0] = True
    keep = np.where(rng.uniform(size=(batch, heads, queries, keys)) < 0.7, 1 / 0.7, 0.0)
    query = numbers(batch, heads, queries, width)
    key, value = (numbers(batch, heads, keys, width, seed=i) for i in (1, 2))
    return (query, key, value), jnp.asarray(mask), jnp.asarray(keep, jnp.float32)


@pytest.mark.parametrize("dropped", [False, True])
def test_attention_is_plain_attention(dropped):
    inputs, mask, keep = attention_inputs()
    keep = keep if dropped else None
    plain = value_and_grads(lambda *qkv: plain_attention(*qkv, mask, keep), *inputs)
    ours = lambda *qkv: value_and_grads(lambda *x: attend(*x, mask, keep), *qkv)  # noqa: E731
    assert_same(ours(*inputs), plain)
    assert_same(jax.jit(ours)(*inputs), plain)
    # Under vmap, as over seeds: the other copy has its values doubled.
    doubled = tuple(jnp.stack([x, 2.0 * x]) for x in inputs)
    together = jax.vmap(ours)(*doubled)
    assert_same(jax.tree.map(lambda x: x[0], together), plain)
    assert_same(jax.tree.map(lambda x: x[1], together), ours(*(2.0 * x for x in inputs)))


def test_nothing_flows_through_what_is_masked():
    (query, key, value), mask, _ = attention_inputs()
    mask = mask.at[:, :, -1].set(False)
    _, grads = value_and_grads(lambda *qkv: attend(*qkv, mask, None), query, key, value)
    assert np.abs(grads[1][:, :, -1]).max() == np.abs(grads[2][:, :, -1]).max() == 0.0


# --- dropout ---------------------------------------------------------------------------------


def test_dropout_rate_and_mean():
    shape = (400, 500)
    y = np.asarray(Dropout(jax.random.key(0), 0.1, 400 * 500)(jnp.ones(shape)))
    kept = 1.0 - 26 / 256  # the nearest of 256 steps
    assert set(np.unique(y)) == {0.0, np.float32(1.0 / kept)}
    assert np.mean(y == 0.0) == pytest.approx(26 / 256, abs=0.003)
    assert np.mean(y) == pytest.approx(1.0, abs=0.004)
    # Neighbours, which share a word of random bits, are dropped independently.
    dropped = (y == 0.0).reshape(-1, 2)
    assert np.mean(dropped.all(axis=1)) == pytest.approx((26 / 256) ** 2, abs=0.001)


def test_dropout_hands_out_every_byte_once():
    """Two calls take other bytes than each other, and together those of one call."""
    ones = jnp.ones((3, 5))
    both = Dropout(jax.random.key(0), 0.5, 30)
    parts = np.concatenate([both(ones), both(ones)])
    assert not np.array_equal(parts[:3], parts[3:])
    whole = Dropout(jax.random.key(0), 0.5, 30)(jnp.ones((6, 5)))
    np.testing.assert_array_equal(parts, whole)
    with pytest.raises(AssertionError, match="more elements than were drawn"):
        both(ones)


@pytest.mark.parametrize(("rate", "dropped"), [(0.0, 0), (0.001, 1), (0.5, 128), (0.9999, 255)])
def test_a_rate_is_taken_to_256ths_but_never_to_none_or_all(rate, dropped):
    factors = Dropout(jax.random.key(0), rate, 4096).factors((4096,))
    if dropped == 0:
        assert factors is None
    else:
        assert np.max(factors) == pytest.approx(256 / (256 - dropped))


def test_dropout_without_a_key_is_off():
    x = numbers(3, 4)
    assert Dropout(None, 0.5, 12).factors((3, 4)) is None
    assert Dropout(None)(x) is x


# --- initialization -------------------------------------------------------------------------------

SHAPES = [(17, 64), (376, 64), (64, 64), (64, 1), (1, 5), (256, 256)]


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_orthogonal_matrices_are_flax_s(shape):
    key = jax.random.key(3)
    kernel = jax.jit(lambda key: orthogonal(0.5)(key, shape))(key)
    np.testing.assert_allclose(kernel, nn.initializers.orthogonal(0.5)(key, shape), atol=5e-6)
    ours = np.asarray(kernel if shape[0] >= shape[1] else kernel.T, np.float64) / 0.5
    np.testing.assert_allclose(ours.T @ ours, np.eye(min(shape)), atol=2e-6)


def test_orthogonal_matrices_are_the_same_among_others():
    keys = jax.random.split(jax.random.key(0), 3)
    together = jax.jit(jax.vmap(lambda key: orthogonal(1.0)(key, (20, 8))))(keys)
    alone = jax.jit(lambda key: orthogonal(1.0)(key, (20, 8)))
    for key, kernel in zip(keys, together, strict=True):
        np.testing.assert_array_equal(kernel, alone(key))


def test_orthogonal_matrices_have_all_of_float32_on_accelerators():
    """Where products have fewer digits by default, as on TPUs; the CPU's have all."""
    with jax.default_matmul_precision("bfloat16"):
        made = jax.make_jaxpr(lambda key: orthogonal(1.0)(key, (20, 8)))(jax.random.key(0))
    products = [line for line in str(made).splitlines() if "dot_general" in line]
    assert len(products) == 4
    assert str(made).count("Precision.HIGHEST") == 2 * len(products)

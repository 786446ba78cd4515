"""A GPT-2 block in plain NumPy, float64, a token at a time: the oracle of actor and critic."""

from __future__ import annotations

import jax
import numpy as np


def randomized(params, seed=1, scale=0.4):
    """Parameters far from their initialization, biases and LayerNorm gains included."""
    leaves, treedef = jax.tree.flatten(params)
    rng = np.random.default_rng(seed)
    noisy = [np.asarray(x + scale * rng.normal(size=x.shape), np.float32) for x in leaves]
    return jax.tree.unflatten(treedef, noisy)


def gaussian_of(actor):
    """``(params, ...) -> GaussianParams`` of an actor without a past."""
    return lambda *args, **kwargs: actor.apply(*args, **kwargs).gaussian


def layer_norm(x, p):
    mean, variance = x.mean(-1, keepdims=True), x.var(-1, keepdims=True)
    return (x - mean) / np.sqrt(variance + 1e-5) * p["scale"] + p["bias"]


def dense(x, p):
    return x @ p["kernel"] + p["bias"]


def turned(x, time, heads):
    """RoFormer's rotation ``[T, D]``: entry i and entry i + E/2 of a head as a complex number."""
    size = x.shape[1] // heads
    half = size // 2
    angle = np.asarray(time, float)[:, None] * 10_000.0 ** (-np.arange(half) / half)
    out = np.empty_like(x)
    for head in range(heads):
        real = slice(head * size, head * size + half)
        imaginary = slice(head * size + half, (head + 1) * size)
        z = (x[:, real] + 1j * x[:, imaginary]) * np.exp(1j * angle)
        out[:, real], out[:, imaginary] = z.real, z.imag
    return out


def gpt2_block(x, p, heads, allowed, time=None):
    """Pre-LayerNorm attention and MLP; every token computed. With times, rotary attention."""
    tokens, width = x.shape
    h = layer_norm(x, p["ln_1"])
    if "query_key_value" in p:
        q, k, v = np.split(dense(h, p["query_key_value"]), 3, axis=-1)
    else:
        q = dense(h, p["query"])
        k, v = np.split(dense(h, p["key_value"]), 2, axis=-1)
    if time is not None:
        q, k = turned(q, time, heads), turned(k, time, heads)
    size = width // heads
    mixed = np.zeros((tokens, width))
    for head in range(heads):
        part = slice(head * size, (head + 1) * size)
        for i in range(tokens):
            scores = np.array(
                [q[i, part] @ k[j, part] / np.sqrt(size) if allowed[i, j] else -np.inf
                 for j in range(tokens)]
            )  # fmt: skip
            weights = np.exp(scores - scores.max())
            mixed[i, part] = (weights / weights.sum()) @ v[:, part]
    x = x + dense(mixed, p["attention_out"])
    h = layer_norm(x, p["ln_2"])
    return x + dense(np.maximum(dense(h, p["mlp_in"]), 0.0), p["mlp_out"])

"""Dense layer, LayerNorm, attention and dropout, with backward passes laid out for speed.

The mathematics, the parameters and their initialization are those of ``flax.linen``'s layers of
the same names, where it has them. What differs is how gradients are computed (docs/speed.md):
weight gradients as one product of two row-major matrices, LayerNorm's and attention's in few passes
over memory, and the dropout of a whole network from one draw of random bytes.

Letters: N rows, I and O sizes, B sequences, H heads, S queries, T keys, D width.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp

EPSILON = 1e-5
"""Added to the variance in LayerNorm."""
_MASKED = -1e9
_ROTARY_BASE = 10_000.0
"""Of the longest wavelength, 2π times it (RoFormer's)."""
_BYTE = 256

Initializer = Callable[..., jax.Array]
Residuals = tuple[Any, ...]


def orthogonal(scale: float) -> Initializer:
    """``scale`` times a random orthogonal matrix, as of ``flax.linen.initializers.orthogonal``.

    The same matrix from the same key, up to rounding, by Gram-Schmidt instead of LAPACK's QR: that
    of jaxlib 0.10.2 waits inside a thread of XLA's for others of its pool, and where as many
    factorizations run at once as there are threads, for ever.

    Returns:
      ``init(key, shape [I, O], dtype)``: rows or columns are orthonormal, whichever are fewer.
    """

    def init(key: jax.Array, shape: tuple[int, int], dtype: Any = jnp.float32) -> jax.Array:
        inputs, outputs = shape
        tall = (inputs, outputs) if inputs >= outputs else (outputs, inputs)
        columns = _orthonormal_columns(jax.random.normal(key, tall))
        return (scale * (columns if inputs >= outputs else columns.T)).astype(dtype)

    return init


# In turns under vmap, so that a matrix is the same to the bit alone and among others.
@jax.custom_batching.sequential_vmap
def _orthonormal_columns(matrix: jax.Array) -> jax.Array:
    """Q of QR with a positive diagonal of R, ``[M, N]`` with M at least N.

    Each column is made orthogonal twice, which is enough for float32's precision (Giraud et al.
    2005, doi:10.1007/s00211-005-0615-4).
    """

    def with_column(place: jax.Array, columns: jax.Array) -> jax.Array:
        column = matrix[:, place]  # those not yet there are zeros in `columns`
        for _ in range(2):
            column = column - columns @ (column @ columns)
        return columns.at[:, place].set(column / jnp.linalg.norm(column))

    # Where a product of float32 has fewer digits, as on TPUs, twice would not be enough.
    with jax.default_matmul_precision("highest"):
        return jax.lax.fori_loop(0, matrix.shape[1], with_column, jnp.zeros_like(matrix))


def _laid_out(x: jax.Array) -> jax.Array:
    """``x`` as it is, written to memory on CPUs.

    XLA would otherwise fold a transposition into the product that reads it, and its products of
    transposed matrices reach half the speed or less on a CPU. Accelerators fold it for free.
    """
    return jax.lax.platform_dependent(
        x, cpu=jax.lax.optimization_barrier, default=lambda folded: folded
    )


# --- dense -----------------------------------------------------------------------------------


@jax.custom_vjp
def affine(x: jax.Array, kernel: jax.Array, bias: jax.Array) -> jax.Array:
    """``x [N, I]``, ``kernel [I, O]``, ``bias [O]`` -> ``x @ kernel + bias``, ``[N, O]``."""
    return x @ kernel + bias


def _affine_forward(
    x: jax.Array, kernel: jax.Array, bias: jax.Array
) -> tuple[jax.Array, Residuals]:
    return affine(x, kernel, bias), (x, kernel)


def _affine_backward(residuals: Residuals, grad: jax.Array) -> tuple[jax.Array, ...]:
    x, kernel = residuals
    if x.shape[1] <= grad.shape[1]:  # the smaller one is transposed
        kernel_grad = _laid_out(x.T) @ grad
    else:
        kernel_grad = _laid_out(_laid_out(grad.T) @ x).T
    return grad @ kernel.T, kernel_grad, grad.sum(axis=0)


affine.defvjp(_affine_forward, _affine_backward)


class Dense(nn.Module):
    """A linear layer with bias, as ``flax.linen.Dense``.

    Attributes:
      features: O.
      kernel_init: of the kernel ``[I, O]``; biases start at zero.
      dtype: of the product and the output; parameters are float32.
    """

    features: int
    kernel_init: Initializer
    dtype: str = "float32"

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """``[..., I]`` -> ``[..., O]``."""
        size = x.shape[-1]
        kernel = self.param("kernel", self.kernel_init, (size, self.features))
        bias = self.param("bias", nn.initializers.zeros_init(), (self.features,))
        rows = x.reshape(-1, size)  # [N, I]
        y = affine(*(value.astype(self.dtype) for value in (rows, kernel, bias)))
        return y.reshape(*x.shape[:-1], self.features)


# --- LayerNorm -------------------------------------------------------------------------------


@jax.custom_vjp
def layer_norm(x: jax.Array, scale: jax.Array, bias: jax.Array) -> jax.Array:
    """LayerNorm (Ba et al., arXiv 1607.06450) of the rows of ``x [N, D]``."""
    return _layer_norm_forward(x, scale, bias)[0]


def _layer_norm_forward(
    x: jax.Array, scale: jax.Array, bias: jax.Array
) -> tuple[jax.Array, Residuals]:
    mean = x.mean(axis=-1, keepdims=True)
    variance = jnp.maximum((x * x).mean(axis=-1, keepdims=True) - mean * mean, 0.0)
    inverse_std = jax.lax.rsqrt(variance + EPSILON)
    return (x - mean) * inverse_std * scale + bias, (x, mean, inverse_std, scale)


def _layer_norm_backward(residuals: Residuals, grad: jax.Array) -> tuple[jax.Array, ...]:
    x, mean, inverse_std, scale = residuals
    normed = (x - mean) * inverse_std
    scaled = grad * scale
    along_mean = scaled.mean(axis=-1, keepdims=True)
    along_normed = (scaled * normed).mean(axis=-1, keepdims=True)
    x_grad = inverse_std * (scaled - along_mean - normed * along_normed)
    return x_grad, (grad * normed).sum(axis=0), grad.sum(axis=0)


layer_norm.defvjp(_layer_norm_forward, _layer_norm_backward)


class LayerNorm(nn.Module):
    """LayerNorm over the last axis in float32, as ``flax.linen.LayerNorm``."""

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """``[..., D]`` -> ``[..., D]`` float32."""
        width = x.shape[-1]
        scale = self.param("scale", nn.initializers.ones_init(), (width,))
        bias = self.param("bias", nn.initializers.zeros_init(), (width,))
        rows = x.astype(jnp.float32).reshape(-1, width)  # [N, D]
        return layer_norm(rows, scale, bias).reshape(x.shape)


# --- attention -------------------------------------------------------------------------------


@jax.custom_vjp
def attend(
    query: jax.Array, key: jax.Array, value: jax.Array, mask: jax.Array, keep: jax.Array | None
) -> jax.Array:
    """Scaled dot-product attention (Vaswani et al., arXiv 1706.03762); softmax in float32.

    Args:
      query: ``[B, H, S, D/H]``.
      key: ``[B, H, T, D/H]``.
      value: ``[B, H, T, D/H]``.
      mask: bool ``[B, S, T]``, whether a query may attend to a key.
      keep: float32 ``[B, H, S, T]``, what dropout multiplies the attention weights by; None: no
        dropout. Not differentiated.

    Returns:
      ``[B, H, S, D/H]``.
    """
    return _attend_forward(query, key, value, mask, keep)[0]


def attention_weights(query: jax.Array, key: jax.Array, mask: jax.Array) -> jax.Array:
    """What :func:`attend` mixes the values with: float32 ``[B, H, S, T]``, rows that sum to 1."""
    scores = jnp.einsum("bhsd,bhtd->bhst", query, key).astype(jnp.float32)
    scores = jnp.where(mask[:, None], scores / math.sqrt(query.shape[-1]), _MASKED)
    return jax.nn.softmax(scores, axis=-1)


def _attend_forward(
    query: jax.Array, key: jax.Array, value: jax.Array, mask: jax.Array, keep: jax.Array | None
) -> tuple[jax.Array, Residuals]:
    weights = attention_weights(query, key, mask)
    kept = (weights if keep is None else weights * keep).astype(value.dtype)
    mixed = jnp.einsum("bhst,bhtd->bhsd", kept, value)
    return mixed, (query, key, value, weights, keep)


def _attend_backward(residuals: Residuals, grad: jax.Array) -> tuple[jax.Array | None, ...]:
    query, key, value, weights, keep = residuals
    kept = weights if keep is None else weights * keep
    weights_grad = jnp.einsum("bhsd,bhtd->bhst", grad, value).astype(jnp.float32)
    if keep is not None:
        weights_grad = weights_grad * keep
    # Of the softmax; masked places have weight 0.
    along_weights = jnp.sum(weights * weights_grad, axis=-1, keepdims=True)
    scores_grad = weights * (weights_grad - along_weights) / math.sqrt(query.shape[-1])
    kept, scores_grad = kept.astype(value.dtype), scores_grad.astype(value.dtype)
    by_key = [_laid_out(y.swapaxes(-1, -2)) for y in (kept, scores_grad)]  # [B, H, T, S]
    return (
        jnp.einsum("bhst,bhtd->bhsd", scores_grad, key),
        jnp.einsum("bhts,bhsd->bhtd", by_key[1], query),
        jnp.einsum("bhts,bhsd->bhtd", by_key[0], grad),
        None,
        None,
    )


attend.defvjp(_attend_forward, _attend_backward)


@flax.struct.dataclass
class Rotation:
    """By which angles tokens are turned: their cosines and sines, ``[B, 1, T, E/2]``."""

    cos: jax.Array
    sin: jax.Array

    @classmethod
    def at(cls, time: jax.Array, size: int) -> Rotation:
        """Angles that grow with the token's time, of E/2 wavelengths from 2π on.

        Args:
          time: ``[B, T]``.
          size: E, of a head.
        """
        half = size // 2
        frequency = _ROTARY_BASE ** (-jnp.arange(half) / half)

        def turn(time: jax.Array) -> tuple[jax.Array, jax.Array]:
            angle = time[:, None] * frequency  # [B, E/2]
            return jnp.cos(angle), jnp.sin(angle)

        # Token by token: on CPUs XLA computes cheap things again wherever they are read, and counts
        # these among them. What leaves a loop it cannot compute again; that saves an eighth of an
        # update's time. (Accelerators would do without the loop; not measured.)
        cos, sin = jax.lax.map(turn, time.T)  # [T, B, E/2]
        return cls(cos.swapaxes(0, 1)[:, None], sin.swapaxes(0, 1)[:, None])

    def of(self, tokens: slice) -> Rotation:
        """That of some of the tokens."""
        return jax.tree.map(lambda x: x[:, :, tokens], self)


def rotated(x: jax.Array, rotation: Rotation) -> jax.Array:
    """Turns pairs of numbers of each head (RoFormer, Su et al., arXiv 2104.09864): the product of a
    query and a key then depends on the difference of their times alone. Entry i is paired with
    entry i + E/2.

    Args:
      x: queries or keys, ``[B, H, T, E]``, E even.
      rotation: of their T tokens.
    """
    a, b = jnp.split(x.astype(jnp.float32), 2, axis=-1)
    cos, sin = rotation.cos, rotation.sin
    return jnp.concatenate([a * cos - b * sin, a * sin + b * cos], axis=-1).astype(x.dtype)


# --- dropout ---------------------------------------------------------------------------------


class Dropout:
    """Inverted dropout of a whole network, from one draw of a random byte an element.

    A draw costs time however small it is, and a 32-bit word is far more than a mask needs. Bytes
    are handed out in the order of the calls, so the object lives while a network is traced.

    Args:
      key: typed PRNG key; None: dropout is off.
      rate: share of elements dropped, taken to the nearest of 1/256, 2/256, …, 255/256.
      size: how many elements there are to be, over all calls.
    """

    def __init__(self, key: jax.Array | None, rate: float = 0.0, size: int = 0):
        self._dropped = min(max(round(rate * _BYTE), 1), _BYTE - 1) if rate > 0.0 else 0
        self._bytes: jax.Array | None = None
        self._size, self._used = size, 0
        if key is not None and self._dropped:
            words = jax.random.bits(key, (-(-size // 4),), jnp.uint32)
            self._bytes = jax.lax.bitcast_convert_type(words, jnp.uint8).reshape(-1)

    def factors(self, shape: tuple[int, ...]) -> jax.Array | None:
        """What to multiply by, float32 of ``shape``: 0, or 1 over the share kept; None: off."""
        if self._bytes is None:
            return None
        start, self._used = self._used, self._used + math.prod(shape)
        assert self._used <= self._size, "more elements than were drawn"
        kept = self._bytes[start : self._used].reshape(shape) >= self._dropped
        return kept * jnp.float32(_BYTE / (_BYTE - self._dropped))

    def __call__(self, x: jax.Array) -> jax.Array:
        """Drops elements of ``x``."""
        factors = self.factors(x.shape)
        return x if factors is None else x * factors

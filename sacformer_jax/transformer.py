"""A causal pre-LayerNorm GPT-2 trunk. Nothing about reinforcement learning is in it.

Letters: B sequences, T tokens, S query tokens, C tokens in the cache, H heads, D width.
"""

from __future__ import annotations

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp

ACTIVATIONS = {"relu": nn.relu, "gelu": nn.gelu, "tanh": nn.tanh, "silu": nn.silu}
LAYER_NORM_EPSILON = 1e-5
EVERY_TOKEN = (0, 1)
_MASKED = -1e9


@dataclasses.dataclass(frozen=True)
class TransformerConfig:
    """Size and details of the trunk.

    Attributes:
      layers: number of blocks.
      width: D.
      heads: H, divides D.
      mlp_ratio: hidden width of the block's MLP over D.
      dropout: rate on embeddings, attention weights and both residual branches.
      activation: one of :data:`ACTIVATIONS`.
      dtype: of the products; parameters, LayerNorm, softmax and the residual stream stay float32.
    """

    layers: int
    width: int
    heads: int
    mlp_ratio: int
    dropout: float
    activation: str
    dtype: str = "float32"


class Dropout(nn.Module):
    """Inverted dropout from 16 random bits an element.

    ``jax.random`` makes a 32-bit word for each number it draws, however small; here a word serves
    two elements.
    """

    rate: float

    @nn.compact
    def __call__(self, x: jax.Array, deterministic: bool) -> jax.Array:
        if deterministic or self.rate == 0.0:
            return x
        dropped = round(self.rate * 2**16)
        words = jax.random.bits(self.make_rng("dropout"), (-(-x.size // 2),), jnp.uint32)
        halves = jax.lax.bitcast_convert_type(words, jnp.uint16)  # [words, 2]
        bits = halves.reshape(-1)[: x.size].reshape(x.shape)
        return jnp.where(bits >= dropped, x / (1.0 - dropped / 2**16), 0.0)


class Block(nn.Module):
    """Attention and MLP with residual connections (GPT-2).

    Attributes:
      config: the trunk's.
      kept: ``(first, step)``: compute only these tokens; all are still attended to.
    """

    config: TransformerConfig
    kept: tuple[int, int] = EVERY_TOKEN

    @nn.compact
    def __call__(
        self,
        x: jax.Array,
        mask: jax.Array,
        deterministic: bool,
        positions: jax.Array | None = None,
    ) -> jax.Array:
        """``x [B, T, D]`` -> ``[B, S, D]``; see :class:`Transformer` for the arguments."""
        cfg = self.config
        batch, _, width = x.shape
        head_width = width // cfg.heads

        def project(size: int, name: str) -> nn.Dense:
            init = nn.initializers.normal(0.02)
            return nn.Dense(size, kernel_init=init, dtype=cfg.dtype, name=name)

        dropout = Dropout(cfg.dropout, name="dropout")

        normed = nn.LayerNorm(epsilon=LAYER_NORM_EPSILON, name="ln_1")(x)
        if self.kept != EVERY_TOKEN:
            first, step = self.kept
            kept = slice(first, None, step)
            x, queries, mask = x[:, kept], normed[:, kept], mask[:, kept]
            q = project(width, "query")(queries)
            k, v = jnp.split(project(2 * width, "key_value")(normed), 2, axis=-1)
        else:
            q, k, v = jnp.split(project(3 * width, "query_key_value")(normed), 3, axis=-1)

        def split_heads(y: jax.Array) -> jax.Array:
            return y.reshape(batch, -1, cfg.heads, head_width).swapaxes(1, 2)  # [B, H, ., D/H]

        q, k, v = split_heads(q), split_heads(k), split_heads(v)
        if positions is not None:
            k = self._cached("key", k, positions, mask.shape[-1])  # [B, H, C, D/H]
            v = self._cached("value", v, positions, mask.shape[-1])
        scores = jnp.einsum("bhsd,bhtd->bhst", q, k).astype(jnp.float32) / jnp.sqrt(head_width)
        weights = jax.nn.softmax(jnp.where(mask[:, None], scores, _MASKED), axis=-1)
        weights = dropout(weights, deterministic).astype(v.dtype)
        mixed = jnp.einsum("bhst,bhtd->bhsd", weights, v)
        mixed = mixed.swapaxes(1, 2).reshape(batch, -1, width)  # [B, S, D]
        x = x + dropout(project(width, "attention_out")(mixed), deterministic)

        hidden = nn.LayerNorm(epsilon=LAYER_NORM_EPSILON, name="ln_2")(x)
        hidden = ACTIVATIONS[cfg.activation](project(cfg.mlp_ratio * width, "mlp_in")(hidden))
        return x + dropout(project(width, "mlp_out")(hidden), deterministic)

    def _cached(self, name: str, new: jax.Array, positions: jax.Array, size: int) -> jax.Array:
        """Writes ``new [B, H, T, D/H]`` into the cache; all of it, ``[B, H, C, D/H]``."""
        batch, heads, _, head_width = new.shape
        cache = self.variable("cache", name, jnp.zeros, (batch, heads, size, head_width), new.dtype)
        rows = jnp.arange(batch)[:, None]  # [B, 1]
        # The indexed axes come first, so the values are laid out as [B, T, H, D/H].
        cache.value = cache.value.at[rows, :, positions].set(new.swapaxes(1, 2))
        return cache.value


class Transformer(nn.Module):
    """Blocks and the final LayerNorm over embedded tokens.

    Attributes:
      config: sizes.
      kept: ``(first, step)``: return only these tokens; the last block then computes only those.
    """

    config: TransformerConfig
    kept: tuple[int, int] = EVERY_TOKEN

    @nn.compact
    def __call__(
        self,
        x: jax.Array,
        mask: jax.Array,
        deterministic: bool = True,
        positions: jax.Array | None = None,
    ) -> jax.Array:
        """Runs the trunk, on whole sequences or on the newest tokens of longer ones.

        Args:
          x: ``[B, T, D]`` embedded tokens.
          mask: bool ``[B, T, T]``, whether a query (axis 1) may attend to a key (axis 2); every
            query must have at least one. ``[B, T, C]`` with a cache.
          deterministic: dropout off.
          positions: int32 ``[B, T]``, where the keys and values of these tokens go in the
            collection ``"cache"``, which must be mutable; queries then attend to the C places of
            the cache instead of to ``x``. None: no cache.

        Returns:
          ``[B, S, D]``, the kept tokens.
        """
        x = Dropout(self.config.dropout, name="dropout")(x, deterministic)
        for i in range(self.config.layers):
            last = i == self.config.layers - 1
            block = Block(self.config, self.kept if last else EVERY_TOKEN, name=f"block_{i}")
            x = block(x, mask, deterministic, positions)
        return nn.LayerNorm(epsilon=LAYER_NORM_EPSILON, name="ln_f")(x)


def banded_causal_mask(state_mask: jax.Array, band: int) -> jax.Array:
    """Which of T places may attend to which: at most the ``band`` newest real ones up to itself.

    A place always attends to itself, so that padding gives finite numbers.

    Args:
      state_mask: bool ``[B, T]``, real places.
      band: how many places a query sees, itself included.

    Returns:
      bool ``[B, T, T]`` (query, key).
    """
    place = jnp.arange(state_mask.shape[1])
    distance = place[:, None] - place[None, :]
    visible = (distance >= 0) & (distance < band)
    return (visible & state_mask[:, None, :]) | (distance == 0)

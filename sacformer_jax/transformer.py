"""A causal pre-LayerNorm GPT-2 trunk. Nothing about reinforcement learning is in it.

Letters: B sequences, T tokens, S query tokens, C tokens in the cache, P in the past, H heads, D
width.
"""

from __future__ import annotations

import dataclasses

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp

from sacformer_jax.layers import (
    Dense,
    Dropout,
    LayerNorm,
    Rotation,
    attend,
    attention_weights,
    rotated,
)

ACTIVATIONS = {"relu": nn.relu, "gelu": nn.gelu, "tanh": nn.tanh, "silu": nn.silu}


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
      rotary: queries and keys are turned by the time of their tokens (see
        :func:`~sacformer_jax.layers.rotated`), so that only differences of times count.
    """

    layers: int
    width: int
    heads: int
    mlp_ratio: int
    dropout: float
    activation: str
    dtype: str = "float32"
    rotary: bool = False


@flax.struct.dataclass
class KeysValues:
    """What later tokens attend to in a block, each ``[B, H, T, D/H]``."""

    key: jax.Array
    value: jax.Array

    def followed_by(self, other: KeysValues) -> KeysValues:
        """These and, after them, those of later tokens."""
        return jax.tree.map(lambda *both: jnp.concatenate(both, axis=2), self, other)


Seen = tuple[KeysValues, ...]
"""Keys and values of every block."""


class Block(nn.Module):
    """Attention and MLP with residual connections (GPT-2).

    Attributes:
      config: the trunk's.
      kept: ``(first, step)``: compute only these tokens; all are still attended to. Queries have a
        layer of their own then, even where those are all. None: every token, by one layer.
    """

    config: TransformerConfig
    kept: tuple[int, int] | None = None

    @nn.compact
    def __call__(
        self,
        x: jax.Array,
        mask: jax.Array,
        dropout: Dropout,
        positions: jax.Array | None = None,
        past: KeysValues | None = None,
        rotation: Rotation | None = None,
    ) -> tuple[jax.Array, KeysValues]:
        """``x [B, T, D]`` -> ``[B, S, D]`` and its keys and values; see :class:`Transformer`."""
        cfg = self.config
        batch, _, width = x.shape
        head_width = width // cfg.heads

        def project(size: int, name: str) -> Dense:
            return Dense(size, nn.initializers.normal(0.02), cfg.dtype, name=name)

        normed = LayerNorm(name="ln_1")(x)
        kept = slice(None)
        if self.kept is not None:
            kept = slice(self.kept[0], None, self.kept[1])
            x, queries, mask = x[:, kept], normed[:, kept], mask[:, kept]
            q = project(width, "query")(queries)
            k, v = jnp.split(project(2 * width, "key_value")(normed), 2, axis=-1)
        else:
            q, k, v = jnp.split(project(3 * width, "query_key_value")(normed), 3, axis=-1)

        def split_heads(y: jax.Array) -> jax.Array:
            return y.reshape(batch, -1, cfg.heads, head_width).swapaxes(1, 2)  # [B, H, ., D/H]

        q, k, v = split_heads(q), split_heads(k), split_heads(v)
        if rotation is not None:
            q, k = rotated(q, rotation.of(kept)), rotated(k, rotation)
        seen = KeysValues(k, v)
        if positions is not None:
            seen = KeysValues(
                self._cached("key", seen.key, positions, mask.shape[-1]),  # [B, H, C, D/H]
                self._cached("value", seen.value, positions, mask.shape[-1]),
            )
        every = seen if past is None else past.followed_by(seen)
        factors = dropout.factors((batch, cfg.heads, *mask.shape[1:]))
        if self.is_mutable_collection("intermediates"):  # for who asks; training does not
            self.sow("intermediates", "attention", attention_weights(q, every.key, mask))
        mixed = attend(q, every.key, every.value, mask, factors)
        mixed = mixed.swapaxes(1, 2).reshape(batch, -1, width)  # [B, S, D]
        x = x + dropout(project(width, "attention_out")(mixed))

        hidden = LayerNorm(name="ln_2")(x)
        hidden = ACTIVATIONS[cfg.activation](project(cfg.mlp_ratio * width, "mlp_in")(hidden))
        return x + dropout(project(width, "mlp_out")(hidden)), seen

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
      kept: ``(first, step)``: return only these tokens; the last block then computes only those,
        its queries by a layer of their own. None: every token, the last block like the others.
    """

    config: TransformerConfig
    kept: tuple[int, int] | None = None

    @nn.compact
    def __call__(
        self,
        x: jax.Array,
        mask: jax.Array,
        deterministic: bool = True,
        positions: jax.Array | None = None,
        past: Seen | None = None,
        time: jax.Array | None = None,
    ) -> tuple[jax.Array, Seen]:
        """Runs the trunk, on whole sequences or on the newest tokens of longer ones.

        Args:
          x: ``[B, T, D]`` embedded tokens.
          mask: bool ``[B, T, T]``, whether a query (axis 1) may attend to a key (axis 2); every
            query must have at least one. ``[B, T, C]`` with a cache, ``[B, T, P + T]`` with a past.
          deterministic: dropout off.
          positions: int32 ``[B, T]``, where the keys and values of these tokens go in the
            collection ``"cache"``, which must be mutable; queries then attend to the C places of
            the cache instead of to ``x``. None: no cache.
          past: what the P tokens before these left; they are attended to, too.
          time: ``[B, T]``, when each token was; needed where ``config.rotary``.

        Returns:
          ``[B, S, D]``, the kept tokens, and what a later call may take as its past.
        """
        cfg = self.config
        dropout = Dropout(None)
        if not deterministic and cfg.dropout > 0.0:
            size = self._dropout_size(x.shape[:2], mask.shape[-1])
            dropout = Dropout(self.make_rng("dropout"), cfg.dropout, size)
        rotation = None
        if cfg.rotary:
            assert time is not None
            rotation = Rotation.at(time, cfg.width // cfg.heads)
        x = dropout(x)
        seen = []
        for i in range(cfg.layers):
            kept = self.kept if i == cfg.layers - 1 else None
            before = None if past is None else past[i]
            block = Block(cfg, kept, name=f"block_{i}")
            x, block_seen = block(x, mask, dropout, positions, before, rotation)
            seen.append(block_seen)
        return LayerNorm(name="ln_f")(x), tuple(seen)

    def _dropout_size(self, tokens: tuple[int, ...], keys: int) -> int:
        """Elements that dropout looks at: the embeddings, and three times in each block."""
        batch, queries = tokens
        cfg, (first, step) = self.config, self.kept or (0, 1)
        each = cfg.heads * keys + 2 * cfg.width  # of a query in a block
        last = len(range(first, queries, step))
        return batch * (queries * cfg.width + ((cfg.layers - 1) * queries + last) * each)


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

"""Actors. Letters: B windows, T states of a window, O, A, D width."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp

from sacformer_jax.cache import cache_places
from sacformer_jax.config import Tokens
from sacformer_jax.envs.core import EnvSpec
from sacformer_jax.layers import Dense, LayerNorm, orthogonal
from sacformer_jax.transformer import (
    ACTIVATIONS,
    Seen,
    Transformer,
    TransformerConfig,
    banded_causal_mask,
)

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0
_PREDICTION_RATIO = 4
"""Hidden width of what predicts the next state over the trunk's."""
KERNEL_INITS = {
    "lecun": nn.initializers.lecun_uniform(),
    "xavier": nn.initializers.xavier_uniform(),
    "orthogonal": orthogonal(math.sqrt(2.0)),
}


@dataclasses.dataclass(frozen=True)
class StepTokens:
    """What a step's tokens stand for.

    Attributes:
      names: in order.
      state: the place of the one whose features tell of the state; those after it in the step are
        seen from the next step on.
    """

    names: tuple[str, ...]
    state: int


STEP_TOKENS: dict[Tokens, StepTokens] = {
    "gs": StepTokens(("return", "state"), 1),
    "gsa": StepTokens(("return", "state", "action"), 1),
    "joint": StepTokens(("joint",), 0),
}


def max_time_step(spec: EnvSpec) -> int:
    """How many time steps there are: the state after an episode's last step has one too."""
    return spec.max_episode_steps + 1


@dataclasses.dataclass(frozen=True)
class GaussianParams:
    """Mean and log standard deviation of the Gaussian before tanh, each ``[..., A]``."""

    mean: jax.Array
    log_std: jax.Array


jax.tree_util.register_dataclass(GaussianParams, ["mean", "log_std"], [])


@flax.struct.dataclass
class ActorOutput:
    """What an actor says of a stretch of states.

    Attributes:
      gaussian: the action distributions.
      seen: what the actor's next call may take as its past; empty for one that sees one state.
      features: of the trunk at the states, ``[..., D]``; None of an actor without one.
      prediction: what it expects of the action that was taken, ``[..., H, O + 1]``: how the
        normalized observation changes in each of the next H steps, and the rewards; None of an
        actor that predicts nothing.
    """

    gaussian: GaussianParams
    seen: Seen
    features: jax.Array | None = None
    prediction: jax.Array | None = None


def head_init(scale: float) -> nn.initializers.Initializer:
    """Xavier-uniform with a gain."""
    return nn.initializers.variance_scaling(scale**2, "fan_avg", "uniform")


class GaussianHeads(nn.Module):
    """Two linear heads; log-std clipped to [-20, 2].

    Attributes:
      action_size: A.
      scale: gain of the Xavier-uniform kernels; small values start near mean 0 and std 1.
    """

    action_size: int
    scale: float

    @nn.compact
    def __call__(self, features: jax.Array) -> GaussianParams:
        init = head_init(self.scale)
        mean = Dense(self.action_size, init, name="mean")(features)
        log_std = Dense(self.action_size, init, name="log_std")(features)
        return GaussianParams(mean, jnp.clip(log_std, LOG_STD_MIN, LOG_STD_MAX))


def embed_steps(
    step: dict[str, jax.Array], time_step: jax.Array, width: int, max_time_step: int | None
) -> jax.Array:
    """The tokens of T steps, interleaved; to be called inside a compact module, whose layers
    ``embed_NAME``, ``embed_time`` and ``ln_embed`` it makes.

    Args:
      step: what each of a step's n tokens stands for, by name and in order: ``[B, T, ...]``.
      time_step: int32 ``[B, T]``; its embedding is added to all tokens of the step.
      width: D.
      max_time_step: size of the time-step embedding; None: nothing is added.

    Returns:
      ``[B, nT, D]``.
    """
    batch = time_step.shape[0]
    time: jax.Array | float = 0.0
    if max_time_step is not None:
        time = nn.Embed(
            max_time_step, width, embedding_init=nn.initializers.normal(0.02), name="embed_time"
        )(jnp.clip(time_step, 0, max_time_step - 1))
    xavier = nn.initializers.xavier_uniform()
    tokens = [
        Dense(width, xavier, name=f"embed_{name}")(values) + time for name, values in step.items()
    ]
    interleaved = jnp.stack(tokens, axis=2).reshape(batch, -1, width)  # [B, nT, D]
    return LayerNorm(name="ln_embed")(interleaved)


class TransformerActor(nn.Module):
    """The Decision-Transformer actor over ``(G_1, S_1, …, G_T, S_T)`` (paper, section 3.1).

    With ``tokens="gsa"`` over ``(G_1, S_1, A_1, …)``, as Decision Transformer (arXiv 2106.01345).
    With ``"joint"`` over ``((G_1, S_1), (G_2, S_2, A_1), …)``, as many recurrent agents see the
    past: a token a step, of all that is known there.

    Attributes:
      config: the trunk.
      tokens: one of :data:`STEP_TOKENS`.
      action_size: A.
      context_length: K; no position attends to more than K pairs.
      max_time_step: size of the time-step embedding; None: tokens have none, and know of their time
        what ``config.rotary`` tells them.
      head_init_scale: see :class:`GaussianHeads`.
      state_path: widths of an MLP on the state alone, whose features go to the heads, those of the
        trunk added to them by a layer that starts at zero: the policy starts as SAC's, and learns
        what the past has to add (a residual path around the trunk). None: the trunk alone.
      predicts: H, for how many steps to say, of states and the actions taken there, which states
        and rewards follow; 0: none.
      given: the trunk learns nothing from what is done with its features; ``state_path``, which
        there must be, sees them beside the state.
      cached: act on an episode step by step: keys and values of the K newest steps are kept in
        the collection ``"cache"`` (which must be mutable) instead of being computed again.
    """

    config: TransformerConfig
    action_size: int
    context_length: int
    max_time_step: int | None
    head_init_scale: float
    tokens: Tokens = "gs"
    state_path: Sequence[int] | None = None
    predicts: int = 0
    given: bool = False
    cached: bool = False

    @nn.compact
    def __call__(
        self,
        obs: jax.Array,
        action: jax.Array,
        return_to_go: jax.Array,
        time_step: jax.Array,
        state_mask: jax.Array,
        deterministic: bool = True,
        past: Seen | None = None,
        skip: int = 0,
    ) -> ActorOutput:
        """Action distributions at every state; with a cache, at the newest one alone.

        Args:
          obs: ``[B, T, O]``, normalized.
          action: ``[B, T, A]``, the actions taken; each is seen from the next state on, the last
            one by nobody of these, and none at all with ``tokens="gs"``. With a past
            ``[B, P + T, A]``, as ``state_mask``.
          return_to_go: ``[B, T]``, scaled.
          time_step: int32 ``[B, T]``; with a cache, each call must be one step after the one
            before, or 0, where the cache starts anew.
          state_mask: bool ``[B, T]``, real pairs; with a cache, the time step tells. With a past
            ``[B, P + T]``, its P pairs first.
          deterministic: dropout off; otherwise the rng ``dropout`` is used.
          past: what an earlier call left, about the P pairs before these.
          skip: of how many first states nothing is asked: they are only seen by those after them,
            and zeros are returned for them. 0 with a cache.

        Returns:
          mean and log-std ``[B, T, A]``; those of pairs that are not real mean nothing. With a
          cache ``[B, 1, A]``, and nothing is predicted.
        """
        step = self._step(obs, action, return_to_go, state_mask)
        if self.cached:
            features, seen = self._newest_features(step, time_step, deterministic)
        else:
            features, seen = self._features(step, time_step, state_mask, deterministic, past, skip)
        asked = features.shape[1]  # T - skip; with a cache 1
        prediction = None
        if self.predicts and not self.cached:
            shape = (self.predicts, obs.shape[-1] + 1)
            prediction = self._predicted(features, action[:, -asked:], shape)
        output = jax.lax.stop_gradient(features) if self.given else features
        if self.state_path is not None:
            newest = obs[:, -asked:]
            activation, dtype = self.config.activation, self.config.dtype
            path = MLP(self.state_path, activation, dtype=dtype, name="state_path")
            if self.given:
                output = path(jnp.concatenate([newest, output], axis=-1))
            else:
                by_state, zeros = path(newest), nn.initializers.zeros
                output = by_state + Dense(by_state.shape[-1], zeros, name="from_trunk")(output)
        heads = GaussianHeads(self.action_size, self.head_init_scale, name="heads")
        said = (heads(output), features, prediction)
        if skip:
            said = jax.tree.map(
                lambda x: jnp.pad(x, ((0, 0), (skip, 0), *((0, 0),) * (x.ndim - 2))), said
            )
        gaussian, features, prediction = said
        return ActorOutput(gaussian, seen, features, prediction)

    def _step(
        self, obs: jax.Array, action: jax.Array, return_to_go: jax.Array, state_mask: jax.Array
    ) -> dict[str, jax.Array]:
        """What each of a step's tokens stands for, by name."""
        states = obs.shape[1]
        step = {"return": return_to_go[..., None], "state": obs}
        if self.tokens == "gsa":
            step["action"] = action[:, -states:]
        elif self.tokens == "joint":
            before = _action_before(action, state_mask)[:, -states:]
            step = {"joint": jnp.concatenate([*step.values(), before], axis=-1)}
        return step

    def _predicted(
        self, features: jax.Array, action: jax.Array, shape: tuple[int, int]
    ) -> jax.Array:
        """What the actions taken lead to, ``[B, T, *shape]``."""
        cfg = self.config
        both = jnp.concatenate([features, action], axis=-1)
        widths = (_PREDICTION_RATIO * cfg.width,)
        hidden = MLP(widths, cfg.activation, dtype=cfg.dtype, name="prediction")(both)
        flat = Dense(math.prod(shape), nn.initializers.zeros, name="prediction_out")(hidden)
        return flat.reshape(*flat.shape[:-1], *shape)  # [B, T, H, O + 1]

    def _features(
        self,
        step: dict[str, jax.Array],
        time_step: jax.Array,
        state_mask: jax.Array,
        deterministic: bool,
        past: Seen | None,
        skip: int,
    ) -> tuple[jax.Array, Seen]:
        """What the trunk makes of the state tokens after ``skip``, ``[B, T - skip, D]``."""
        n, states = len(step), time_step.shape[1]
        tokens = embed_steps(step, time_step, self.config.width, self.max_time_step)

        # All tokens of a step share its place in the band; within a step, none sees a later one.
        step_mask = banded_causal_mask(state_mask, self.context_length)
        token_mask = jnp.repeat(jnp.repeat(step_mask, n, axis=1), n, axis=2)  # [B, nT, nT]
        place = jnp.arange(token_mask.shape[1])
        token_mask &= place[:, None] >= place  # by comparison: ONNX's runtime selects no booleans
        kept = (skip * n + STEP_TOKENS[self.tokens].state, n)
        trunk = Transformer(self.config, kept, name="trunk")
        newest = token_mask[:, -n * states :]  # all of them, but for those of the past
        time = jnp.repeat(time_step, n, axis=1)  # [B, nT]
        return trunk(tokens, newest, deterministic, past=past, time=time)

    def _newest_features(
        self, step: dict[str, jax.Array], time_step: jax.Array, deterministic: bool
    ) -> tuple[jax.Array, Seen]:
        """The same of the newest state token alone, ``[B, 1, D]``, by way of the cache."""
        n, place = len(step), STEP_TOKENS[self.tokens].state
        later = n - 1 - place
        # What is new since the last call: what came after the state then, and up to the state now.
        num_steps = 2 if later else 1
        step = {name: values[:, -num_steps:] for name, values in step.items()}
        steps = time_step[:, -num_steps:]
        tokens = embed_steps(step, steps, self.config.width, self.max_time_step)
        places = cache_places(time_step[:, -1], n, place, self.context_length)
        # (G, S, [A, G, S], A), ([G, S]) or ([J]).
        new = slice((num_steps - 1) * n - later, num_steps * n - later)
        new_tokens = tokens[:, new]  # [B, n, D]
        time = jnp.repeat(steps, n, axis=1)[:, new]  # [B, n]
        trunk = Transformer(self.config, kept=(n - 1, n), name="trunk")
        return trunk(new_tokens, places.mask, deterministic, places.positions, time=time)


def _action_before(action: jax.Array, state_mask: jax.Array) -> jax.Array:
    """The action that led to each state, ``[B, T, A]``; zero where none is known."""
    known = jnp.where(state_mask[:, :-1, None], action[:, :-1], 0.0)
    # Not by padding, which does not convert to ONNX for any number of environments.
    return jnp.concatenate([jnp.zeros_like(action[:, :1]), known], axis=1)


class MLP(nn.Module):
    """Dense layers with an activation after each, optionally LayerNorm before it.

    Attributes:
      widths: of the layers.
      activation: one of :data:`~sacformer_jax.transformer.ACTIVATIONS`.
      layer_norm: LayerNorm before each activation.
      dtype: of the products; the output is float32.
      kernel_init: one of :data:`KERNEL_INITS`.
    """

    widths: Sequence[int]
    activation: str = "relu"
    layer_norm: bool = False
    dtype: str = "float32"
    kernel_init: str = "lecun"

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        for i, width in enumerate(self.widths):
            init = KERNEL_INITS[self.kernel_init]
            x = Dense(width, init, self.dtype, name=f"dense_{i}")(x)
            if self.layer_norm:
                x = LayerNorm(name=f"ln_{i}")(x)
            x = ACTIVATIONS[self.activation](x)
        return x.astype(jnp.float32)


class MLPActor(nn.Module):
    """SAC's actor: sees the state alone, and skips none. Same signature as
    :class:`TransformerActor`.
    """

    widths: Sequence[int]
    activation: str
    action_size: int
    head_init_scale: float
    dtype: str = "float32"

    @nn.compact
    def __call__(
        self,
        obs: jax.Array,
        action: jax.Array,
        return_to_go: jax.Array,
        time_step: jax.Array,
        state_mask: jax.Array,
        deterministic: bool = True,
        past: Seen | None = None,
        skip: int = 0,
    ) -> ActorOutput:
        del action, return_to_go, time_step, state_mask, deterministic, past, skip
        features = MLP(self.widths, self.activation, dtype=self.dtype, name="mlp")(obs)
        heads = GaussianHeads(self.action_size, self.head_init_scale, name="heads")
        return ActorOutput(heads(features), ())


class DeterministicActor(nn.Module):
    """TD3's and DDPG's actor: one action for a state, before tanh.

    Attributes:
      widths: of the hidden layers.
      activation: one of :data:`~sacformer_jax.transformer.ACTIVATIONS`.
      action_size: A.
      head_init_scale: gain of the Xavier-uniform kernel of the last layer.
      dtype: of the hidden layers' products.
    """

    widths: Sequence[int]
    activation: str
    action_size: int
    head_init_scale: float
    dtype: str = "float32"

    @nn.compact
    def __call__(self, obs: jax.Array) -> jax.Array:
        """``obs [..., O]``, normalized -> ``[..., A]``."""
        features = MLP(self.widths, self.activation, dtype=self.dtype, name="mlp")(obs)
        return Dense(self.action_size, head_init(self.head_init_scale), name="action")(features)

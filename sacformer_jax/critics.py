"""Critics over windows, twins or any number: one signature for the MLP and the transformer.

Letters: C critics, B windows, K steps, T states (K or K+1), O, A, D width.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp

from sacformer_jax.config import CriticConfig
from sacformer_jax.layers import Dense
from sacformer_jax.networks import KERNEL_INITS, MLP, embed_steps
from sacformer_jax.transformer import (
    Transformer,
    TransformerConfig,
    banded_causal_mask,
)
from sacformer_jax.types import Params

_MLP_RATIO = 4


@flax.struct.dataclass
class CriticInputs:
    """What a critic may look at besides the action it judges.

    Attributes:
      obs: ``[B, K, O]`` normalized, at the steps; the actor's features after them, where critics
        are to see those.
      next_obs: ``[B, K, O]`` likewise, after the steps.
      action: ``[B, K, A]``, as replayed.
      time_step: int32 ``[B, K+1]``; looked at by the transformer alone.
      state_mask: bool ``[B, K+1]``; looked at by those that see the past, whose windows are
        contiguous.
    """

    obs: jax.Array
    next_obs: jax.Array
    action: jax.Array
    time_step: jax.Array
    state_mask: jax.Array


Judge = Callable[[Params, CriticInputs, jax.Array], jax.Array]
"""``(params, inputs, candidate [B, K, A]) -> Q [C, B, K]``."""


@dataclasses.dataclass(frozen=True)
class Critics:
    """C independent critics as pure functions.

    Attributes:
      init: ``(key, inputs) -> params``, leaves ``[C, ...]``.
      now: judges candidates at the first K states.
      following: judges candidates at the last K states.
    """

    init: Callable[[jax.Array, CriticInputs], Params]
    now: Judge
    following: Judge


def make_critics(
    config: CriticConfig,
    dtype: str,
    context_length: int,
    max_time_step: int,
    num: int = 2,
    burn_in: int = 0,
) -> Critics:
    """The critics that a configuration asks for.

    Args:
      config: the critic's section.
      dtype: of the products.
      context_length: K; no candidate attends to more than K states.
      max_time_step: size of the transformer's time-step embedding.
      num: C.
      burn_in: first steps of a window of which nobody asks what they are worth.
    """
    if config.critic == "mlp":
        widths = (config.critic_width,) * config.critic_layers
        return mlp_critics(
            widths,
            config.critic_activation,
            config.critic_layer_norm,
            dtype,
            config.critic_init,
            num,
            config.critic_history,
            burn_in,
        )
    trunk = TransformerConfig(
        layers=config.critic_layers,
        width=config.critic_width,
        heads=config.critic_heads,
        mlp_ratio=_MLP_RATIO,
        dropout=0.0,
        activation=config.critic_activation,
        dtype=dtype,
    )
    return transformer_critics(trunk, context_length, max_time_step, num)


def twin(critic: type[nn.Module], num: int = 2) -> Callable[..., nn.Module]:
    """Independent copies, two or ``num``; parameters and output lead with their axis."""
    return nn.vmap(
        critic,
        variable_axes={"params": 0},
        split_rngs={"params": True},
        in_axes=None,
        out_axes=0,
        axis_size=num,
    )


class MLPCritic(nn.Module):
    """Q(s, a): an MLP on the concatenation."""

    widths: Sequence[int]
    activation: str
    layer_norm: bool
    dtype: str = "float32"
    kernel_init: str = "lecun"

    @nn.compact
    def __call__(self, obs: jax.Array, action: jax.Array) -> jax.Array:
        """``obs [..., O]``, ``action [..., A]`` -> ``[...]``."""
        x = jnp.concatenate([obs, action], axis=-1)
        mlp = MLP(
            self.widths, self.activation, self.layer_norm, self.dtype, self.kernel_init, name="mlp"
        )
        return Dense(1, KERNEL_INITS[self.kernel_init], name="q")(mlp(x))[..., 0]


def mlp_critics(
    widths: Sequence[int],
    activation: str,
    layer_norm: bool,
    dtype: str = "float32",
    kernel_init: str = "lecun",
    num: int = 2,
    history: int = 1,
    burn_in: int = 0,
) -> Critics:
    """Critics that see the state and the action alone (the paper's), or the last states.

    Args:
      widths: of the hidden layers.
      activation: one of :data:`~sacformer_jax.transformer.ACTIVATIONS`.
      layer_norm: LayerNorm before each activation.
      dtype: of the products.
      kernel_init: one of :data:`~sacformer_jax.networks.KERNEL_INITS`.
      num: C.
      history: how many states they see, with the actions between them; see :func:`with_history`.
      burn_in: first steps of a window that are not judged: Q is 0 there.
    """
    critic = twin(MLPCritic, num)(tuple(widths), activation, layer_norm, dtype, kernel_init)
    apply: Callable[..., jax.Array] = critic.apply  # type: ignore[assignment]

    def judge(params: Params, seen: jax.Array, candidate: jax.Array) -> jax.Array:
        q = apply(params, seen[:, burn_in:], candidate[:, burn_in:])
        return jnp.pad(q, ((0, 0), (0, 0), (burn_in, 0)))

    def seen_now(inputs: CriticInputs) -> jax.Array:
        return inputs.obs if history == 1 else with_history(inputs, history)[:, :-1]

    def seen_next(inputs: CriticInputs) -> jax.Array:
        return inputs.next_obs if history == 1 else with_history(inputs, history)[:, 1:]

    return Critics(
        init=lambda key, inputs: critic.init(key, seen_now(inputs), inputs.action),
        now=lambda params, inputs, candidate: judge(params, seen_now(inputs), candidate),
        following=lambda params, inputs, candidate: judge(params, seen_next(inputs), candidate),
    )


def with_history(inputs: CriticInputs, num: int) -> jax.Array:
    """Each state with the ones before it and the actions that led on from those.

    Args:
      inputs: of a contiguous window.
      num: n, how many states, the newest included.

    Returns:
      ``[B, K+1, n O + (n-1) A]``: the newest state, then, step by step further back, state and
      action; zeros for what lies before the window or the episode.
    """
    states = jnp.concatenate([inputs.obs, inputs.next_obs[:, -1:]], axis=1)  # [B, K+1, O]
    # An action that is known at a state; the last one has none.
    action = jnp.pad(inputs.action, ((0, 0), (0, 1), (0, 0)))  # [B, K+1, A]
    pairs = jnp.concatenate([states, action], axis=-1)
    pairs = jnp.where(inputs.state_mask[..., None], pairs, 0.0)
    length = states.shape[1]
    earlier = [jnp.pad(pairs, ((0, 0), (back, 0), (0, 0)))[:, :length] for back in range(1, num)]
    return jnp.concatenate([states, *earlier], axis=-1)


class TransformerCritic(nn.Module):
    """Q of one candidate action at every state, given the states and actions before it.

    A triple of tokens stands for each step: state, replayed action, candidate. A candidate sees
    itself, the states up to its own and the replayed actions before it, and nobody sees a
    candidate, so all are judged in one pass. Replayed actions are seen from the next step on.

    Attributes:
      config: the trunk.
      context_length: K; no position attends to more than K steps.
      max_time_step: size of the time-step embedding.
    """

    config: TransformerConfig
    context_length: int
    max_time_step: int

    @nn.compact
    def __call__(
        self,
        obs: jax.Array,
        action: jax.Array,
        candidate: jax.Array,
        time_step: jax.Array,
        state_mask: jax.Array,
    ) -> jax.Array:
        """Judges the candidates.

        Args:
          obs: ``[B, T, O]``, normalized.
          action: ``[B, T, A]``, as replayed; the last one is seen by nobody.
          candidate: ``[B, T, A]``.
          time_step: int32 ``[B, T]``.
          state_mask: bool ``[B, T]``.

        Returns:
          ``[B, T]``.
        """
        step = {"state": obs, "action": action, "candidate": candidate}
        tokens = embed_steps(step, time_step, self.config.width, self.max_time_step)  # [B, 3T, D]
        mask = candidate_mask(state_mask, self.context_length)
        features, _ = Transformer(self.config, kept=(2, 3), name="trunk")(tokens, mask)
        xavier = nn.initializers.xavier_uniform()
        return Dense(1, xavier, name="q")(features)[..., 0]  # [B, T]


def candidate_mask(state_mask: jax.Array, band: int) -> jax.Array:
    """Which of the 3T tokens ``(S_1, A_1, C_1, S_2, …)`` may attend to which.

    Args:
      state_mask: bool ``[B, T]``, real steps.
      band: how many steps a token sees, its own included.

    Returns:
      bool ``[B, 3T, 3T]`` (query, key).
    """
    batch, states = state_mask.shape
    upto = banded_causal_mask(state_mask, band)  # [B, T, T]
    own = jnp.broadcast_to(jnp.eye(states, dtype=bool), upto.shape)
    before, never = upto & ~own, jnp.zeros_like(upto)
    visible = [
        [upto, before, never],  # a state sees states, actions, candidates
        [upto, upto, never],  # an action
        [upto, before, own],  # a candidate
    ]
    # [B, query step, query kind, key step, key kind]
    mask = jnp.stack([jnp.stack(keys, axis=-1) for keys in visible], axis=2)
    return mask.reshape(batch, 3 * states, 3 * states)  # [B, 3T, 3T]


def transformer_critics(
    config: TransformerConfig, context_length: int, max_time_step: int, num: int = 2
) -> Critics:
    """Critics that see the window up to the action they judge."""
    critic = twin(TransformerCritic, num)(config, context_length, max_time_step)
    apply: Callable[..., jax.Array] = critic.apply  # type: ignore[assignment]

    def init(key: jax.Array, inputs: CriticInputs) -> Params:
        return critic.init(
            key,
            inputs.obs,
            inputs.action,
            inputs.action,
            inputs.time_step[:, :-1],
            inputs.state_mask[:, :-1],
        )

    def now(params: Params, inputs: CriticInputs, candidate: jax.Array) -> jax.Array:
        return apply(
            params,
            inputs.obs,
            inputs.action,
            candidate,
            inputs.time_step[:, :-1],
            inputs.state_mask[:, :-1],
        )

    def following(params: Params, inputs: CriticInputs, candidate: jax.Array) -> jax.Array:
        nothing = jnp.zeros_like(candidate[:, :1])
        q = apply(
            params,
            jnp.concatenate([inputs.obs, inputs.next_obs[:, -1:]], axis=1),  # [B, K+1, O]
            jnp.concatenate([inputs.action, nothing], axis=1),  # [B, K+1, A]
            jnp.concatenate([nothing, candidate], axis=1),  # [B, K+1, A]
            inputs.time_step,
            inputs.state_mask,
        )
        return q[..., 1:]  # [C, B, K]

    return Critics(init, now, following)

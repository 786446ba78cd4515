"""What the networks make of replayed windows: attention, effective rank, dormant units."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from diagnosis.numbers import dormant_share, effective_rank
from diagnosis.subject import Subject, contexts_of, on_windows_of
from sacformer_jax.agents.sac_policy import acting_outlook, window_policies
from sacformer_jax.agents.sac_update import critic_inputs
from sacformer_jax.attention import acting_attention
from sacformer_jax.critics import CriticInputs
from sacformer_jax.networks import MLP, STEP_TOKENS
from sacformer_jax.transformer import ACTIVATIONS, Block
from sacformer_jax.types import Context, Window

_HEADS = ("heads", "q")
"""Layers whose input counts as a network's features."""


# --- attention -----------------------------------------------------------------------------------


def attention_numbers(subject: Subject, windows: Window) -> dict[str, float]:
    """Mean attention of the state acted on, by block, steps back and kind of token, over heads and
    full windows, with the return tokens that acting would show; the share that goes to earlier
    steps, and how far back it lies in the mean. Nothing of SAC.
    """
    config = subject.config
    if config.agent != "sacformer":
        return {}
    # Whatever acting sees, the windows are what is replayed.
    config = config.replace(acting_context="window", acting_context_limit=None)
    contexts = contexts_of(windows, config.context.context_length)
    look = jax.jit(partial(acting_attention, config, subject.tools.program.env.spec))
    attention, _ = look(subject.policy, contexts)
    mass = np.asarray(attention).mean(axis=(1, 2))  # [L, K, n]
    numbers = {}
    for block, rows in enumerate(mass):
        name = f"attention/block_{block}"
        numbers[f"{name}/earlier"] = float(rows[1:].sum())
        numbers[f"{name}/mean_steps_back"] = float(rows.sum(axis=1) @ np.arange(len(rows)))
        for back, row in enumerate(rows):
            for token, value in zip(STEP_TOKENS[config.context.tokens].names, row, strict=True):
                numbers[f"{name}/{back}_back/{token}"] = float(value)
    return numbers


# --- representation ------------------------------------------------------------------------------


@dataclasses.dataclass
class Activations:
    """What was seen in a network while it ran.

    Attributes:
      output: of the network.
      features: what went into its heads, ``[..., D]``.
      layers: by name, what came out of activation functions, ``[..., H]``.
    """

    output: Any = None
    features: np.ndarray | None = None
    layers: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)


def activations(run: Callable[..., Any], *arguments: Any) -> Activations:
    """Jits and runs a network, and looks at its layers on the way.

    Critics are vmapped inside their own functions, where values are tracers: a host call takes them
    out, of all critics at once, ``[C, ...]``, and hands them on as they are.
    """
    seen, before, functions = Activations(), {}, {}

    def take(keep: Callable[[np.ndarray], None], value: jax.Array) -> jax.Array:
        def kept(array: Any) -> np.ndarray:
            array = np.array(array)
            keep(array)
            return array

        shape = jax.ShapeDtypeStruct(value.shape, value.dtype)
        taken: jax.Array = jax.pure_callback(kept, shape, value, vmap_method="broadcast_all")
        return taken

    def look(call: Any, args: Any, kwargs: Any, context: nn.module.InterceptorContext) -> Any:
        module = context.module
        if context.method_name != "__call__":
            return call(*args, **kwargs)
        if module.name in _HEADS:
            args = (take(lambda array: setattr(seen, "features", array), args[0]), *args[1:])
        result, activation = call(*args, **kwargs), _activation_after(module)
        if activation is not None:
            name = _layer_name(module)
            functions[name] = activation
            result = take(lambda array: before.update({name: array}), result)
        return result

    with nn.intercept_methods(look):
        # A function of its own: what was traced before would be run again as it was.
        seen.output = jax.device_get(jax.jit(lambda *given: run(*given))(*arguments))
    # In the order of the layers, not of the calls. What no output needs (in acting, a prediction)
    # was not computed.
    seen.layers = {
        name: np.asarray(of(jnp.asarray(before[name])))
        for name, of in functions.items()
        if name in before
    }
    return seen


def _activation_after(module: nn.Module) -> Callable[[jax.Array], jax.Array] | None:
    """The activation function that a layer's output goes through, if any."""
    parent, name = module.parent, str(module.name)
    if isinstance(parent, MLP):
        last = "ln_" if parent.layer_norm else "dense_"
        return ACTIVATIONS[parent.activation] if name.startswith(last) else None
    if isinstance(parent, Block) and name == "mlp_in":
        return ACTIVATIONS[parent.config.activation]
    return None


def _layer_name(module: nn.Module) -> str:
    assert isinstance(module.parent, nn.Module)
    if isinstance(module.parent, Block):
        return f"{module.parent.name}"
    number = str(module.name).rsplit("_", 1)[1]
    return f"{module.parent.name}_{number}"


def inputs_of(subject: Subject, windows: Window) -> CriticInputs:
    """What critics may look at of windows, as in an update."""
    parts, state = subject.tools.parts, subject.state
    learner = state.learner

    @jax.jit
    def inputs(windows: Window) -> CriticInputs:
        key = jax.random.key(0)
        both = window_policies(parts, learner.actor_params, learner, state.hyper, windows, key)
        return critic_inputs(parts, learner, windows, both)

    found: CriticInputs = inputs(windows)
    return found


def representation_numbers(subject: Subject, windows: Window) -> dict[str, float]:
    """Effective rank of the features at the last step of each window, beside their number, and the
    share of dormant units behind each activation function; of critics the mean of both.
    """
    parts, learner = subject.tools.parts, subject.state.learner
    # As trained: on windows, whatever acting sees.
    on_windows = on_windows_of(parts)
    contexts: Context = contexts_of(windows, subject.config.context.context_length)
    actor = activations(
        lambda policy, contexts: (
            acting_outlook(on_windows, policy, contexts, jax.random.key(0)).gaussian
        ),
        subject.policy,
        contexts,
    )
    inputs = inputs_of(subject, windows)
    critics = activations(parts.critics.now, learner.critic_params, inputs, inputs.action)
    numbers = {}
    for network, seen in (("actor", actor), ("critics", critics)):
        assert seen.features is not None
        each = [seen.features] if network == "actor" else list(seen.features)
        ranks = [effective_rank(features[:, -1]) for features in each]
        numbers[f"srank/{network}"] = float(np.mean(ranks))
        numbers[f"srank/{network}/of"] = float(each[0].shape[-1])
        for name, layer in seen.layers.items():
            each = [layer] if network == "actor" else list(layer)
            shares = [dormant_share(one.reshape(-1, one.shape[-1])) for one in each]
            numbers[f"dormant/{network}/{name}"] = float(np.mean(shares))
    return numbers

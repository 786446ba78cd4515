"""SACFormer: SAC whose actor is a Decision Transformer over the last K (return, state) pairs."""

from __future__ import annotations

from sacformer_jax.agents.core import Agent
from sacformer_jax.agents.sac_policy import SACParts, sac_parts
from sacformer_jax.agents.sac_update import make_sac_agent
from sacformer_jax.config import Config
from sacformer_jax.envs.core import EnvSpec
from sacformer_jax.networks import TransformerActor, max_time_step
from sacformer_jax.parallel import DataAxis
from sacformer_jax.transformer import TransformerConfig


def make_actor(config: Config, spec: EnvSpec) -> TransformerActor:
    """The actor that a configuration and an environment ask for, as it is trained."""
    settings = config.actor
    return TransformerActor(
        config=TransformerConfig(
            layers=settings.actor_layers,
            width=settings.actor_width,
            heads=settings.actor_heads,
            mlp_ratio=settings.actor_mlp_ratio,
            dropout=settings.actor_dropout,
            activation=settings.actor_activation,
            dtype=config.precision.compute_dtype,
            rotary=settings.time_embedding == "rotary",
        ),
        action_size=spec.action_size,
        context_length=config.context.context_length,
        max_time_step=max_time_step(spec) if settings.time_embedding == "absolute" else None,
        head_init_scale=settings.head_init_scale,
        tokens=config.context.tokens,
        state_path=(settings.state_path_width,) * 2 if settings.state_path_width else None,
        predicts=predicted_steps(config, spec.wrapping.action_delay),
        given=settings.transformer_loss == "prediction",
    )


def predicted_steps(config: Config, action_delay: int) -> int:
    """How many steps the actor foretells; 0: none.

    Args:
      config: what to train.
      action_delay: of the environment, steps. One that comes wrapped has its own.
    """
    learning = config.learning
    if learning.prediction_weight == 0:
        return 0
    if learning.prediction_steps == "effect":
        return min(1 + action_delay, config.context.steps_in_a_row)
    return learning.prediction_steps


def acting_pairs(config: Config, spec: EnvSpec) -> int:
    """How many (return, state) pairs it sees at most in acting."""
    if config.context.acting_context == "window":
        return config.context.context_length
    steps = spec.max_episode_steps
    return min(config.context.acting_context_limit or steps, steps)


def make(config: Config, spec: EnvSpec, data: DataAxis) -> Agent:
    """Builds SACFormer for an environment."""
    return make_sac_agent(make_parts(config, spec, data))


def make_parts(config: Config, spec: EnvSpec, data: DataAxis) -> SACParts:
    """What SACFormer's functions are bound to."""
    actor = acting_actor = make_actor(config, spec)
    if config.context.acting_context == "episode":
        acting_actor = actor.clone(context_length=acting_pairs(config, spec), cached=True)
    return sac_parts(config, spec, data, actor, acting_actor)

"""Presets: named layers of values, each layer with the reason or source of what it sets.

A configuration is resolved by laying, over the defaults of :class:`~sacformer_jax.config.Config`,
the preset's layers that fit the agent and environment, then what the user gave. The source of
every value is kept, so that ``sacformer describe`` can print it.
"""

from __future__ import annotations

import collections
import dataclasses
from collections.abc import Callable
from typing import Any

from sacformer_jax import env_names
from sacformer_jax.config import Config, ConfigError


@dataclasses.dataclass(frozen=True)
class Layer:
    """Values set together.

    Attributes:
      source: where they come from, as `describe` prints it.
      values: fields by bare name.
      agent: only for this agent, if given.
      env: only for this environment, if given.
      unless: a field and a value: not where the configuration comes to have that.
    """

    source: str
    values: dict[str, Any]
    agent: str | None = None
    env: str | None = None
    unless: tuple[str, str] | None = None


@dataclasses.dataclass(frozen=True)
class Resolved:
    """A configuration and the source of each of its fields."""

    config: Config
    sources: dict[str, str]


TASK_LAYERS: dict[str, Callable[[str], tuple[Layer, ...]]] = {}
"""By the prefix of an environment's name, what is known of such tasks beside the presets: takes the
name after the prefix. :mod:`sacformer_jax.envs` fills it."""

UNKNOWN_TARGET = Layer(
    "no target is known: the best return so far, or 0",
    {"target_return": "auto"},
    agent="sacformer",
    unless=("return_conditioning", "none"),
)
"""Of tasks whose good returns nobody has told."""


# A good SAC policy's return at 1 M steps: rounded from published tables (SB3 zoo, Tianshou).
_TARGET_RETURNS = tuple(
    Layer(f"target return for {env}", {"target_return": value}, env=env)
    for env, value in {
        "HalfCheetah": 10_000.0,
        "Hopper": 3_500.0,
        "Walker2d": 5_000.0,
        "Ant": 5_000.0,
        "Humanoid": 6_000.0,
    }.items()
)

_SAC_ACTOR = {
    "context_length": 1,
    "return_conditioning": "none",
    "actor_layers": 2,
    "actor_width": 256,
    "actor_dropout": 0.0,
}

_DETERMINISTIC = {**_SAC_ACTOR, "batch_size": 256, "prefill_env_steps": 25_000}
_PPO = {
    **_SAC_ACTOR,
    "actor_width": 64,
    "critic_width": 64,
    "actor_activation": "tanh",
    "critic_activation": "tanh",
    "head_init_scale": 0.01,
    "normalize_obs": True,
    "prefill_env_steps": 0,
}

# The defaults of Config are the paper's settings; what it leaves open is set here.
_PAPER = (
    *_TARGET_RETURNS,
    Layer("authors' program: alpha 0.05 on Humanoid", {"alpha": 0.05}, env="Humanoid"),
    Layer("authors' program: K = 10 on Humanoid", {"context_length": 10}, env="Humanoid"),
    Layer("the paper's Algorithm 2", {"acting_context": "episode"}, agent="sacformer"),
    Layer(
        "SAC (arXiv 1812.05905): 2x256, batch 256, tuned temperature",
        {**_SAC_ACTOR, "batch_size": 256, "tune_alpha": True, "alpha": 1.0},
        agent="sac",
    ),
    Layer("TD3 (arXiv 1802.09477) as CleanRL runs it", _DETERMINISTIC, agent="td3"),
    Layer("DDPG (arXiv 1509.02971) as CleanRL runs it", _DETERMINISTIC, agent="ddpg"),
    Layer(
        "PPO (arXiv 1707.06347) as CleanRL runs it",
        {**_PPO, "chunk_env_steps": 2_048},
        agent="ppo",
    ),
)

# Their updates start with 128 finished episodes. Mean length under random actions, measured over
# 320,000 steps each: Hopper 22, Walker2d 21, Ant 155, Humanoid 24.
_AUTHORS_PREFILL = tuple(
    Layer(
        f"authors' program: about 128 episodes {what}",
        {"prefill_env_steps": steps},
        agent="sacformer",
        env=env,
    )
    for env, steps, what in (
        (None, 128_000, "of 1,000 steps"),
        ("Hopper", 2_900, "of random actions"),
        ("Walker2d", 2_800, "of random actions"),
        ("Ant", 19_800, "of random actions"),
        ("Humanoid", 3_200, "of random actions"),
    )
)

_CPU = (
    *_TARGET_RETURNS,
    Layer(
        "preset cpu: small enough to learn in minutes on 2 cores (experiments/README.md)",
        {
            "total_env_steps": 60_000,
            "prefill_env_steps": 4_000,
            "eval_every": 4_000,
            "checkpoint_every": 20_000,
            "num_envs": 8,
            "buffer_capacity": 200_000,
            "batch_size": 32,
            "updates_per_env_step": 0.5,
            "return_conditioning": "commanded",
            "normalize_obs": True,
            "actor_layers": 2,
            "actor_width": 64,
            "actor_heads": 2,
            "actor_dropout": 0.0,
            "head_init_scale": 0.01,
            "critic_learning_rate": 1e-3,
            "tune_alpha": True,
        },
    ),
    Layer(
        "preset cpu: SAC's own network and batch (arXiv 1812.05905)",
        {**_SAC_ACTOR, "actor_heads": 1, "batch_size": 256, "head_init_scale": 1.0},
        agent="sac",
    ),
    *(
        Layer(
            f"preset cpu: {agent.upper()}'s own network and batch, as CleanRL runs it",
            {
                **_SAC_ACTOR,
                "actor_heads": 1,
                "batch_size": 256,
                "head_init_scale": 1.0,
                "tune_alpha": False,
            },
            agent=agent,
        )
        for agent in ("td3", "ddpg")
    ),
    Layer(
        "preset cpu: PPO as CleanRL runs it, the steps of a round from 8 environments",
        {
            **_PPO,
            "actor_heads": 1,
            "critic_learning_rate": 3e-4,
            "tune_alpha": False,
            "rollout_steps": 256,
            "chunk_env_steps": 2_048,
        },
        agent="ppo",
    ),
)

# What was chosen on the seeds that were tuned on, for either agent (experiments/README.md).
_BEST = (
    *_CPU,
    Layer("preset best: 100,000 env steps", {"total_env_steps": 100_000}),
    Layer(
        "preset best: returns along windows, and a transformer that learns to foretell, a token a "
        "step (experiments/README.md)",
        {
            "td_lambda": 0.5,
            "batch_size": 42,
            "tokens": "joint",
            "return_conditioning": "none",
            "time_embedding": "rotary",
            "burn_in": 5,
            "acting_context": "episode",
            "state_path_width": 256,
            "transformer_loss": "prediction",
            "prediction_weight": 1.0,
            "prediction_steps": "effect",
            "critic_features": True,
        },
        agent="sacformer",
    ),
    Layer(
        "preset best: acting sees as much of the past as learning",
        {"acting_context_limit": 6},
        agent="sacformer",
        unless=("acting_context", "window"),
    ),
    Layer(
        "preset best: as many steps in windows, with returns along them (experiments/README.md)",
        {"td_lambda": 0.5, "learnt_steps": 6, "batch_size": 42},
        agent="sac",
    ),
)

# Where a state does not tell all, SAC is shown as much of the past as SACFormer sees anyway.
_MEMORY = (
    *_BEST,
    Layer("preset memory: as many observations and actions", {"stack_obs": 6}, agent="sac"),
)

PRESETS: dict[str, tuple[Layer, ...]] = {
    "paper": _PAPER,
    "authors": (
        *_PAPER,
        Layer(
            "authors' program: windows",
            {"window": "scattered", "hindsight_scale": 500.0, "next_rtg_decrement": 0.002},
            agent="sacformer",
        ),
        Layer(
            "authors' program: acts from 4, minus reward / 1000",
            {"target_return": 4_000.0, "return_scale": 1_000.0},
            agent="sacformer",
        ),
        Layer(
            "authors' program: acts on up to 512 steps",
            {"acting_context_limit": 512},
            agent="sacformer",
            unless=("acting_context", "window"),
        ),
        Layer("authors' program: dropout left on", {"acting_dropout": True}, agent="sacformer"),
        Layer("authors' program: Xavier-uniform", {"critic_init": "xavier"}, agent="sacformer"),
        *_AUTHORS_PREFILL,
    ),
    "cpu": _CPU,
    "best": _BEST,
    "memory": _MEMORY,
}


def resolve(preset: str, fields: dict[str, Any], given: str = "given") -> Resolved:
    """Lays the preset's layers, the task's own and then ``fields`` over the defaults.

    Args:
      preset: a key of :data:`PRESETS`.
      fields: values given by the user, by bare name.
      given: the source to record for them.

    Raises:
      ConfigError: an unknown preset or field, or a value of the wrong type; there is no such
        environment where its own settings are to be looked up.
    """
    if preset not in PRESETS:
        raise ConfigError(f"preset={preset!r}: must be one of {', '.join(PRESETS)}")
    config = Config().replace(preset=preset)
    sources = dict.fromkeys(config.flat(), "default (the paper's, or plain)")
    sources["preset"] = "default of the command line"
    chosen = config.replace(**{k: v for k, v in fields.items() if k in ("agent", "env")})
    layers = [
        layer
        for layer in (*PRESETS[preset], *_task_layers(chosen.task.env))
        if layer.agent in (None, chosen.agent) and layer.env in (None, chosen.task.env)
    ]
    if fields.get("dataset"):
        layers.append(Layer("the dataset is there instead", {"prefill_env_steps": 0}))
    layers.append(Layer(given, fields))
    settled = collections.ChainMap(*(layer.values for layer in reversed(layers)), config.flat())
    for layer in layers:
        if layer.unless is not None and settled.get(layer.unless[0]) == layer.unless[1]:
            continue
        config = config.replace(**layer.values)
        sources.update(dict.fromkeys(layer.values, layer.source))
    return Resolved(config, sources)


def _task_layers(env: str) -> tuple[Layer, ...]:
    if env_names.is_own(env):
        return _own_layers(env)
    for prefix, layers_of in TASK_LAYERS.items():
        if env.startswith(prefix):
            return layers_of(env.removeprefix(prefix))
    return ()


def _own_layers(env: str) -> tuple[Layer, ...]:
    """What is known of an environment of the user's own."""
    limit = env_names.own_limit(env)
    if limit is None:
        return (UNKNOWN_TARGET,)
    return (Layer("the environment's own time limit", {"max_episode_steps": limit}), UNKNOWN_TARGET)

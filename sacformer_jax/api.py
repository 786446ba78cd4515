"""The public functions that are more than one module's own."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import jax

from sacformer_jax.collecting import make_collector
from sacformer_jax.config import ConfigError
from sacformer_jax.datasets import check_dataset_id, write_episodes
from sacformer_jax.evaluate import make_evaluator
from sacformer_jax.offline import Episode
from sacformer_jax.policy import load_policy
from sacformer_jax.train import make_training_env
from sacformer_jax.types import Acted, Context

_SIDE_BY_SIDE = 16
"""Environments in which episodes are collected."""
_MOST_TRIES = 10
"""Episodes collected at most for each that is asked for, where physics breaks down."""


def evaluate(
    run: str | Path,
    episodes: int = 10,
    gymnasium: bool = False,
    policy: str = "best",
    seed: int = 0,
    member: str | int | None = None,
) -> dict[str, Any]:
    """Evaluates a run's policy under its mean action.

    Args:
      run: the run's folder.
      episodes: number of episodes, at least 1.
      gymnasium: in a real ``gymnasium.make`` environment; otherwise jitted on our own.
      policy: ``"best"`` or ``"latest"``.
      seed: of the resets.
      member: of a run of several, which: its seed in training, or its name.

    Returns:
      ``env``, ``episodes``, ``return_mean``, ``return_std``, ``length_mean``, and in Gymnasium the
      per-step mean of each reward term (``reward_forward``, …).

    Raises:
      CheckpointError: there is no such run or policy.
      ConfigError: ``episodes`` is below 1, the task is not one of Gymnasium's, or the run has no
        such member.
    """
    from sacformer_jax.gymnasium_eval import evaluate_policy
    from sacformer_jax.loop import summarize

    _check(episodes, seed)
    loaded = load_policy(run, policy, member)
    if gymnasium:
        return evaluate_policy(loaded, episodes, seed).record()
    env = make_training_env(loaded.config, num_envs=episodes)
    evaluator = make_evaluator(env, loaded.agent, loaded.config.context.context_length)
    record = summarize(evaluator(loaded.state, jax.random.key(seed)))
    names = ("episodes", "return_mean", "return_std", "length_mean")
    return {"env": loaded.config.task.env, **{name: record[name] for name in names}}


def collect(
    run: str | Path,
    to: str,
    episodes: int = 100,
    actions: Literal["mean", "sample", "random"] = "sample",
    policy: str = "best",
    seed: int = 0,
    member: str | int | None = None,
) -> Path:
    """Writes episodes of a run's policy as a new local Minari dataset.

    Args:
      run: the run's folder.
      to: id of the dataset, ``"namespace/name-v0"``.
      episodes: number of episodes, at least 1.
      actions: the policy's mean actions, samples of it, or uniformly random ones.
      policy: ``"best"`` or ``"latest"``.
      seed: of resets and samples.
      member: of a run of several, which: its seed in training, or its name.

    Returns:
      the dataset's folder.

    Raises:
      CheckpointError: there is no such run or policy.
      ConfigError: Minari is not installed, the id is malformed or taken, or another argument
        cannot work.
    """
    _check(episodes, seed)
    if actions not in ("mean", "sample", "random"):
        raise ConfigError(f"actions={actions!r}: must be mean, sample or random")
    check_dataset_id(to)
    loaded = load_policy(run, policy, member)
    agent, context_length = loaded.agent, loaded.config.context.context_length
    env = make_training_env(loaded.config, num_envs=min(episodes, _SIDE_BY_SIDE))

    def choose(context: Context, key: jax.Array) -> Acted:
        if actions == "random":
            return Acted(env.random_action(key), context)
        return agent.act(loaded.state, context, key, explore=actions == "sample")

    collect_turn = make_collector(env, choose, context_length, agent.init_cache(env.num_envs))
    key, turn = jax.random.key(seed), 0
    found: list[Episode] = []
    while len(found) < episodes:
        if turn * env.num_envs > _MOST_TRIES * episodes:
            raise ConfigError(
                f"episodes={episodes}: of {turn * env.num_envs} only {len(found)} were whole, in "
                "the others the physics broke down; ask for fewer, or another policy"
            )
        found += collect_turn(jax.random.fold_in(key, turn))
        turn += 1
    who = "random actions" if actions == "random" else f"{loaded.config.agent}, {actions} actions"
    return write_episodes(
        found[:episodes], to, env.spec, who, f"{who} in {env.spec.name}, engine {env.spec.engine}"
    )


def _check(episodes: int, seed: int) -> None:
    if episodes < 1:
        raise ConfigError(f"episodes={episodes}: must be at least 1")
    if not 0 <= seed < 2**32:
        raise ConfigError(f"seed={seed}: must be at least 0 and below 2**32")

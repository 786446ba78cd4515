"""The public functions that are more than one module's own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax

from sacformer_jax.config import ConfigError
from sacformer_jax.evaluate import make_evaluator
from sacformer_jax.policy import load_policy
from sacformer_jax.train import make_training_env


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

    if episodes < 1:
        raise ConfigError(f"episodes={episodes}: must be at least 1")
    if not 0 <= seed < 2**32:
        raise ConfigError(f"seed={seed}: must be at least 0 and below 2**32")
    loaded = load_policy(run, policy, member)
    if gymnasium:
        return evaluate_policy(loaded, episodes, seed).record()
    env = make_training_env(loaded.config, num_envs=episodes)
    evaluator = make_evaluator(env, loaded.agent, loaded.config.context.context_length)
    record = summarize(evaluator(loaded.state, jax.random.key(seed)))
    names = ("episodes", "return_mean", "return_std", "length_mean")
    return {"env": loaded.config.task.env, **{name: record[name] for name in names}}

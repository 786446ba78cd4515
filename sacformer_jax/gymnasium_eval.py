"""Evaluation in a real ``gymnasium.make`` environment: the same loop a user would write."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np

from sacformer_jax.config import ConfigError
from sacformer_jax.envs.gym_registry import DEFAULT_LIMIT, registered, reward_terms
from sacformer_jax.envs.gym_wrappers import gym_wrapped
from sacformer_jax.envs.models import loading_quietly
from sacformer_jax.envs.wrapping import UNWRAPPED, Wrapping
from sacformer_jax.policy import Policy


@dataclasses.dataclass(frozen=True)
class GymnasiumEvaluation:
    """Outcome of E episodes in Gymnasium.

    Attributes:
      env: the Gymnasium id.
      returns: ``[E]`` undiscounted sums of reward.
      lengths: ``[E]`` steps.
      reward_terms: mean per step of each reward term that Gymnasium's ``info`` reports.
    """

    env: str
    returns: np.ndarray
    lengths: np.ndarray
    reward_terms: dict[str, float]

    def record(self) -> dict[str, Any]:
        """The outcome as plain values, reward terms included."""
        return {
            "env": self.env,
            "episodes": int(self.returns.size),
            "return_mean": float(self.returns.mean()),
            "return_std": float(self.returns.std()),
            "length_mean": float(self.lengths.mean()),
            **self.reward_terms,
        }


def evaluate_policy(policy: Policy, episodes: int, seed: int = 0) -> GymnasiumEvaluation:
    """Runs a policy's mean actions in the Gymnasium task it was trained on, wrapped as there.

    Args:
      policy: the policy.
      episodes: E, at least 1.
      seed: of the first reset; the later ones follow from it.

    Raises:
      ConfigError: the environment has no Gymnasium twin, or ``episodes`` is below 1.
    """

    def predict(obs: Any, state: Any, reward: float | None) -> tuple[np.ndarray, Any]:
        return policy.predict(obs, state, reward=reward)

    with contextlib.closing(gymnasium_env(policy)) as env:
        return _run(gymnasium_id(policy), env, episodes, seed, predict)


def evaluate_random(
    env_id: str,
    episodes: int,
    seed: int = 0,
    wrapping: Wrapping = UNWRAPPED,
    limit: int = DEFAULT_LIMIT,
) -> GymnasiumEvaluation:
    """The same with uniformly random actions.

    ``limit`` is the longest episode, in steps, of an id that is registered without a time limit.
    """
    with contextlib.closing(_made(env_id, wrapping, limit)) as env:
        space = env.action_space
        space.seed(seed)
        return _run(env_id, env, episodes, seed, lambda obs, state, reward: (space.sample(), None))


def gymnasium_id(policy: Policy) -> str:
    """The Gymnasium id of the policy's task.

    Raises:
      ConfigError: it has none.
    """
    if policy.spec.gymnasium_id is None:
        raise ConfigError(
            f"env={policy.spec.name!r}: not a task of Gymnasium; evaluate without --gymnasium"
        )
    return policy.spec.gymnasium_id


def gymnasium_env(policy: Policy, **settings: Any) -> gymnasium.Env:
    """The Gymnasium environment that a policy acts in: its task, with the wrappers of training.

    An id that is registered without a time limit gets that of training.

    Args:
      policy: the policy.
      **settings: for ``gymnasium.make``, e.g. ``render_mode="human"``.

    Raises:
      ConfigError: its task is none of Gymnasium's, or cannot be made here.
    """
    limit = policy.spec.max_episode_steps
    return _made(gymnasium_id(policy), policy.spec.wrapping, limit, **settings)


def _made(env_id: str, wrapping: Wrapping, limit: int, **settings: Any) -> gymnasium.Env:
    """``limit`` is for ids that have none."""
    if registered(env_id).max_episode_steps is None:
        settings = {"max_episode_steps": limit, **settings}
    try:
        with loading_quietly():
            return gym_wrapped(gymnasium.make(env_id, **settings), wrapping)
    except (gymnasium.error.Error, ImportError) as error:
        raise ConfigError(
            f"env={env_id!r}: Gymnasium cannot make it: {type(error).__name__}: {error}"
        ) from error


def _run(
    env_id: str,
    env: gymnasium.Env,
    episodes: int,
    seed: int,
    predict: Callable[[Any, Any, float | None], tuple[np.ndarray, Any]],
) -> GymnasiumEvaluation:
    if episodes < 1:
        raise ConfigError(f"episodes={episodes}: must be at least 1")
    returns, lengths = np.zeros(episodes), np.zeros(episodes, int)
    terms: dict[str, float] = {}
    for episode in range(episodes):
        obs, _ = env.reset(seed=seed if episode == 0 else None)
        state: Any = None
        reward: float | None = None
        done = False
        while not done:
            action, state = predict(obs, state, reward)
            obs, step_reward, terminated, truncated, info = env.step(action)
            reward = float(step_reward)
            returns[episode] += reward
            lengths[episode] += 1
            for name, value in reward_terms(info).items():
                terms[name] = terms.get(name, 0.0) + value
            done = terminated or truncated
    steps = int(lengths.sum())
    return GymnasiumEvaluation(
        env=env_id,
        returns=returns,
        lengths=lengths,
        reward_terms={name: total / steps for name, total in terms.items()},
    )

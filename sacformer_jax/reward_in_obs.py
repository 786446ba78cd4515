"""Rewards by way of the observation, for loops that pass none to ``predict``.

Stable-Baselines3's ``evaluate_policy(model, env)`` is one. A policy that is conditioned on
return-to-go has to know each reward; so the environment appends it to the observation, and the
policy takes it off again.

Example:
  >>> env = make_vec_env("Hopper-v5", n_envs=4, wrapper_class=RewardInObs)
  >>> mean, std = evaluate_policy(PolicyOfRewardInObs(load_policy("runs/my-run")), env)
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike

from sacformer_jax.policy import ActingState, Policy


class RewardInObs(gymnasium.Wrapper):
    """Appends to each observation ``[O]`` the reward of the step that led to it; 0 after a reset.

    Raises:
      ValueError: observations are not vectors.
    """

    def __init__(self, env: gymnasium.Env):
        super().__init__(env)
        space = env.observation_space
        if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
            raise ValueError(f"observation_space={space}: must be a Box of one axis")
        low, high = np.append(space.low, -np.inf), np.append(space.high, np.inf)
        self.observation_space = gymnasium.spaces.Box(
            low.astype(space.dtype), high.astype(space.dtype), dtype=space.dtype
        )

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict[str, Any]]:
        obs, info = self.env.reset(**kwargs)
        return self._with(obs, 0.0), info

    def step(self, action: Any) -> tuple[np.ndarray, Any, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = self.env.step(action)
        return self._with(obs, reward), reward, terminated, truncated, info

    def _with(self, obs: np.ndarray, reward: Any) -> np.ndarray:
        return np.append(obs, reward).astype(self.observation_space.dtype)


class PolicyOfRewardInObs:
    """A policy whose observations ``[O + 1]`` or ``[N, O + 1]`` end with the last reward."""

    def __init__(self, policy: Policy):
        self.policy = policy

    def predict(
        self,
        observation: ArrayLike,
        state: ActingState | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, ActingState]:
        """As :meth:`Policy.predict`, without its ``reward``."""
        values = np.asarray(observation, np.float32)
        return self.policy.predict(
            values[..., :-1], state, episode_start, deterministic, reward=values[..., -1]
        )

"""Pictures of Gymnasium's own environments, drawn by themselves."""

from __future__ import annotations

from typing import Any

import numpy as np

from sacformer_jax.config import ConfigError
from sacformer_jax.envs.gym_env import GymEnv, GymState
from sacformer_jax.envs.models import loading_quietly
from sacformer_jax.model_renderer import View, mujoco_that_draws

_FPS = 30.0
"""Of an environment that does not say how many frames a second it makes."""


class GymFrames:
    """Draws ``gym:ID`` in an environment made once more, with ``render_mode="rgb_array"``.

    A state holds the seed and the actions that led to it, so this one is brought to where that was.

    Args:
      env: the environment.
      view: its width; the height is as the environment has it. Cameras are the environment's.

    Raises:
      ConfigError: it cannot draw, or what it draws with is not installed; or a camera is asked for.
    """

    def __init__(self, env: GymEnv, view: View):
        name = env.spec.name
        if view.camera is not None:
            raise ConfigError(f"camera={view.camera!r}: {name} has its own")
        self._env, first = _drawing(env.host.facts.env_id, name)
        self._dtype = env.host.facts.action_dtype
        fps = float(self._env.metadata.get("render_fps") or _FPS)
        self.dt = float(getattr(self._env.unwrapped, "dt", 1.0 / fps))
        # Even, as videos want it.
        height = 2 * round(first.shape[0] * view.width / first.shape[1] / 2)
        self._size = (view.width, max(2, height))
        self._at: tuple[int, bytes] | None = None
        self._done = 0

    def snapshot(self, state: GymState) -> Any:
        return {"seed": state.seed, "length": state.length, "actions": state.actions}

    def draw(self, snapshot: Any) -> np.ndarray:
        from PIL import Image

        seed, length = int(snapshot["seed"]), int(snapshot["length"])
        actions = np.asarray(snapshot["actions"])[:length]
        on_the_way = self._at == (seed, actions[: self._done].tobytes())
        if not on_the_way or self._done > length:
            self._env.reset(seed=seed)
            self._done = 0
        for action in actions[self._done :]:
            self._env.step(action.astype(self._dtype))
        self._done, self._at = length, (seed, actions.tobytes())
        image = Image.fromarray(np.asarray(self._env.render(), np.uint8))
        return np.asarray(image.resize(self._size, Image.Resampling.LANCZOS))

    def close(self) -> None:
        self._env.close()


def _drawing(env_id: str, name: str) -> tuple[Any, np.ndarray]:
    """The environment, and what it looks like after a reset."""
    import gymnasium

    mujoco_that_draws()  # for those that draw with it
    try:
        with loading_quietly():
            env = gymnasium.make(
                env_id, render_mode="rgb_array", max_episode_steps=-1, disable_env_checker=True
            )
        env.reset(seed=0)
        image: Any = env.render()
    except Exception as error:  # each draws with what it likes
        reason = next(iter(str(error).splitlines()), "") or type(error).__name__
        raise ConfigError(f"env={name!r}: Gymnasium cannot draw it here ({reason})") from error
    if not isinstance(image, np.ndarray) or image.ndim != 3:
        env.close()
        raise ConfigError(f"env={name!r}: render_mode='rgb_array' gives no image")
    return env, image

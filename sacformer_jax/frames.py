"""Where the pictures of an environment come from: one small protocol, and who provides it.

A picture is made in two steps, since the program runs on the device and drawing on the host:
``snapshot`` is pure and takes from an environment's state what drawing needs; ``draw`` makes an
image of it. An environment that knows how to draw itself has a method ``frame_source(view)``
(whatever it is: MuJoCo, a simulator on the host whose snapshot is the image already, …);
:func:`frame_source` knows those of this package.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol

import numpy as np

from sacformer_jax.config import ConfigError
from sacformer_jax.envs import Env, MujocoEnv, Wrapper
from sacformer_jax.model_renderer import ModelRenderer, View


class FrameSource(Protocol):
    """Draws states of one environment."""

    dt: float
    """Seconds of an environment step."""

    def snapshot(self, state: Any) -> Any:
        """Pure: what drawing needs of an environment's own state, as a PyTree of arrays."""
        ...

    def draw(self, snapshot: Any) -> np.ndarray:
        """``[height, width, 3]`` uint8, of a snapshot as NumPy arrays."""
        ...

    def close(self) -> None:
        """Frees what drawing holds."""
        ...


def frame_source(env: Env, view: View) -> FrameSource:
    """Who draws an environment.

    Raises:
      ConfigError: nobody can; or there is no such camera; or this machine cannot draw.
    """
    from sacformer_jax.envs.brax_env import BraxEnv
    from sacformer_jax.envs.gym_env import GymEnv
    from sacformer_jax.envs.playground_env import PlaygroundEnv

    if isinstance(env, Wrapper):
        return WrappedFrames(frame_source(env.env, view))
    for candidate in (env, getattr(env, "brax", None)):
        own = getattr(candidate, "frame_source", None)
        if own is not None:
            source: FrameSource = own(view)
            return source
    if isinstance(env, BraxEnv) and getattr(env.brax, "sys", None) is not None:
        return BraxFrames(env, view)
    if isinstance(env, MujocoEnv):
        return EngineFrames(env, view)
    if isinstance(env, PlaygroundEnv):
        return PlaygroundFrames(env, view)
    if isinstance(env, GymEnv):
        from sacformer_jax.gym_frames import GymFrames

        return GymFrames(env, view)
    raise ConfigError(
        f"env={env.spec.name!r}: cannot be drawn; give the environment a method frame_source(view) "
        "that returns a sacformer_jax.frames.FrameSource"
    )


class EngineFrames:
    """A task on one of our physics engines.

    Args:
      env: a :class:`~sacformer_jax.envs.mujoco_env.MujocoEnv`.
      view: size and camera.
    """

    def __init__(self, env: Any, view: View):
        self.dt, self._engine = float(env.engine.dt), env.engine
        self._native = env.spec.engine == "native"
        self._renderer = ModelRenderer(env.engine.model, view)

    def snapshot(self, state: Any) -> Any:
        if self._native:
            return state
        # Of a planar task the second coordinate is the height, and the origin's is 0.
        root = min(2, state.qpos.shape[0])
        return state.qpos.at[:root].add(state.origin[:root])

    def draw(self, snapshot: Any) -> np.ndarray:
        if self._native:
            self._renderer.set_state(self._engine.unpack_state(snapshot)[0])
        else:
            self._renderer.data.qpos[:] = snapshot
        return self._renderer.draw()

    def close(self) -> None:
        self._renderer.close()


class WrappedFrames:
    """A wrapped environment, drawn as what is within.

    Args:
      source: who draws that.
    """

    def __init__(self, source: FrameSource):
        self.source, self.dt = source, source.dt

    def __getattr__(self, name: str) -> Any:
        if name == "source":
            raise AttributeError(name)
        return getattr(self.source, name)  # brax's page

    def snapshot(self, state: Any) -> Any:
        return self.source.snapshot(state.env)

    def draw(self, snapshot: Any) -> np.ndarray:
        return self.source.draw(snapshot)

    def close(self) -> None:
        self.source.close()


class BraxFrames:
    """An environment of brax, drawn by MuJoCo from the model that brax made of its MJCF.

    Args:
      env: a :class:`~sacformer_jax.envs.brax_env.BraxEnv`.
      view: size and camera.
    """

    def __init__(self, env: Any, view: View):
        self.dt, self.system = float(env.brax.dt), env.brax.sys
        self._renderer = ModelRenderer(self.system.mj_model, view)

    def snapshot(self, state: Any) -> Any:
        physics = state.pipeline_state
        return {"q": physics.q, "x": physics.x}

    def draw(self, snapshot: Any) -> np.ndarray:
        self._renderer.data.qpos[:] = snapshot["q"]
        return self._renderer.draw()

    def html(self, snapshots: list[Any], heading: str) -> str:
        """Brax's own viewer of these states: a page that loads its program from the network."""
        from brax.io import html

        states = [_Drawn(snapshot["x"]) for snapshot in snapshots]
        # The page plays a state each time step of the system; here it is one each ``dt``.
        system = self.system.tree_replace({"opt.timestep": self.dt})
        page: str = html.render(system, states, height="100vh", colab=False)
        style = (
            "position:fixed;left:1em;bottom:1em;font:16px sans-serif;color:#fff;"
            "background:#000b;padding:.3em .6em;z-index:1"
        )
        return page.replace("<body>", f'<body><div style="{style}">{heading}</div>', 1)

    def close(self) -> None:
        self._renderer.close()


class PlaygroundFrames:
    """A task of MuJoCo Playground.

    Args:
      env: a :class:`~sacformer_jax.envs.playground_env.PlaygroundEnv`.
      view: size and camera.
    """

    def __init__(self, env: Any, view: View):
        self.dt = env.dt
        self._renderer = ModelRenderer(env.playground.mj_model, view)

    def snapshot(self, state: Any) -> Any:
        data = state.data
        return {name: getattr(data, name) for name in ("qpos", "mocap_pos", "mocap_quat")}

    def draw(self, snapshot: Any) -> np.ndarray:
        for name, value in snapshot.items():
            getattr(self._renderer.data, name)[:] = value
        return self._renderer.draw()

    def close(self) -> None:
        self._renderer.close()


@dataclasses.dataclass(frozen=True)
class _Drawn:
    """The part of a brax state that its viewer looks at."""

    x: Any

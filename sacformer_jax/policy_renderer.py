"""Episodes of a policy as video files.

What is seen is evaluation itself: the same environments, program and seeds, so the returns on the
frames are those that an evaluation reports. How environments are drawn:
:mod:`sacformer_jax.frames`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sacformer_jax.config import Config, ConfigError
from sacformer_jax.evaluate import Episodes
from sacformer_jax.frames import FrameSource, frame_source
from sacformer_jax.model_renderer import View
from sacformer_jax.policy import Policy
from sacformer_jax.recording import Recorder, Recording
from sacformer_jax.train import make_training_env
from sacformer_jax.video import HOLD_SECONDS, Frame, GifWriter, Mp4Writer, check_packages

MAX_FPS = 50.0
"""Frames a second at most, unless asked for: more is not seen."""
VIDEO_SUFFIXES = (".mp4", ".gif")
HTML_SUFFIX = ".html"


@dataclasses.dataclass(frozen=True)
class Timing:
    """Which steps are seen when.

    Attributes:
      fps: frames a second; videos play in real time, so steps between frames are left out. None:
        each step, or each n-th so that it is at most :data:`MAX_FPS`.
      gif_seconds: GIFs end there.
    """

    fps: float | None = None
    gif_seconds: float = 10.0

    def __post_init__(self) -> None:
        for name in ("fps", "gif_seconds"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ConfigError(f"{name}={value}: must be greater than 0")

    def frames_per_second(self, dt: float) -> float:
        """Of an environment whose steps are ``dt`` seconds."""
        if self.fps is not None:
            return self.fps
        return 1.0 / (dt * math.ceil(1.0 / (dt * MAX_FPS) - 1e-6))

    def steps(self, length: int, dt: float) -> list[int]:
        """The steps of an episode that are drawn, one for each frame."""
        per_frame = 1.0 / (self.frames_per_second(dt) * dt)
        num = math.ceil(length / per_frame - 1e-6)
        return [min(length - 1, int(frame * per_frame + 1e-6)) for frame in range(num)]


@dataclasses.dataclass(frozen=True)
class Rendering:
    """What was drawn.

    Attributes:
      paths: the files.
      returns: ``[E]``, as an evaluation of so many episodes with this seed gives them.
      lengths: ``[E]`` steps.
    """

    paths: tuple[Path, ...]
    returns: np.ndarray
    lengths: np.ndarray


class PolicyRenderer:
    """Draws policies of one configuration; compiles once. A context.

    Args:
      policy: one of them.
      episodes: E, drawn one after the other.
      view: size and camera.

    Raises:
      ConfigError: the environment or this machine cannot draw, or a package is missing.
    """

    def __init__(self, policy: Policy, episodes: int = 1, view: View | None = None):
        check_packages()
        self._config = config = policy.config
        env = make_training_env(config, num_envs=episodes)
        self.source: FrameSource = frame_source(env.env, view or View())

        def look(episodes: Episodes) -> Any:
            return jax.vmap(self.source.snapshot)(episodes.env.env)

        self._recorder = Recorder(env, policy.agent, config.context.context_length, look)

    def __enter__(self) -> PolicyRenderer:
        return self

    def __exit__(self, *error: Any) -> None:
        self.source.close()

    def render(self, policy: Policy, seed: int, paths: list[Path], timing: Timing) -> Rendering:
        """Runs the episodes and writes the files, each as its suffix says.

        Args:
          policy: of this configuration.
          seed: as in an evaluation.
          paths: ``.mp4``, ``.gif`` and, of brax, ``.html``.
          timing: which steps are seen when.

        Raises:
          ConfigError: a page is asked for of what is not brax.
        """
        page: Any = getattr(self.source, "html", None)
        pages = [path for path in paths if path.suffix == HTML_SUFFIX]
        if pages and page is None:
            raise ConfigError(
                f"to={str(pages[0])!r}: brax's viewer makes HTML, of environments brax:NAME; of "
                "others there are .mp4 and .gif"
            )
        recording = self._recorder.record(policy.state, seed)
        fps = timing.frames_per_second(self.source.dt)
        with contextlib.ExitStack() as stack:
            writers: list[Mp4Writer | GifWriter] = []
            for path in paths:
                if path.suffix == ".mp4":
                    writers.append(stack.enter_context(Mp4Writer(path, fps)))
                elif path.suffix == ".gif":
                    gif = GifWriter(path, fps, timing.gif_seconds)
                    writers.append(stack.enter_context(gif))
            frames = episode_frames(recording, policy, self.source, timing)
            for frame in frames if writers else ():
                for writer in writers:
                    writer.write(frame)
        for path in pages:
            length = int(recording.lengths[0])
            states = [_seen(recording, step, 0) for step in range(length)]
            heading = f"{self._config.task.env}: return {recording.returns[0]:.1f}, {length} steps"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(page(states, heading))
        return Rendering(tuple(paths), recording.returns, recording.lengths)


def episode_frames(
    recording: Recording, policy: Policy, source: FrameSource, timing: Timing
) -> Iterator[Frame]:
    """Every episode's frames, one after the other; the last one stays a moment, with the return.

    Args:
      recording: E episodes, with the source's snapshots.
      policy: what acted.
      source: draws them.
      timing: which steps are seen.
    """
    num_episodes, dt = recording.lengths.size, source.dt
    hold = max(1, round(HOLD_SECONDS * timing.frames_per_second(dt)))
    for episode, length in enumerate(recording.lengths.tolist()):

        def frame(image: np.ndarray, step: int, num: int = 1, episode: int = episode) -> Frame:
            so_far = float(recording.return_so_far[step, episode])
            lines = caption(policy, step, so_far)
            if num_episodes > 1:
                first, *others = lines
                lines = (f"episode {episode + 1} of {num_episodes}, {first}", *others)
            return Frame(image, lines, num)

        for step in timing.steps(length, dt):
            image = source.draw(_seen(recording, step, episode))
            yield frame(image, step)
        yield frame(image, length, hold)


def _seen(recording: Recording, step: int, episode: int) -> Any:
    return jax.tree.map(lambda leaf: leaf[step, episode], recording.seen)


def caption(policy: Policy, step: int, return_so_far: float) -> tuple[str, ...]:
    """What stands on a frame: time step, return so far and, where the actor is conditioned on it,
    the return-to-go it is shown and the target return.
    """
    lines = [f"step {step}", f"return {return_so_far:.1f}"]
    if is_return_conditioned(policy.config):
        target = float(policy.state.target_return)
        lines.append(f"return-to-go {target - return_so_far:.1f} of {target:.0f}")
    return tuple(lines)


def is_return_conditioned(config: Config) -> bool:
    """Whether the actor sees a return-to-go."""
    return config.agent == "sacformer" and config.context.return_conditioning != "none"

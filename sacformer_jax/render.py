"""Videos of policies: of a run's, and of a run in training.

What is seen is evaluation itself: the same environments, program and seeds, so the returns on the
frames are those that an evaluation reports. How environments are drawn:
:mod:`sacformer_jax.frames`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sacformer_jax.callbacks import Callback, Event, RunStart
from sacformer_jax.config import Config, ConfigError
from sacformer_jax.evaluate import Episodes
from sacformer_jax.frames import FrameSource, View, frame_source
from sacformer_jax.policy import Policy, load_policy
from sacformer_jax.recording import Recorder, Recording
from sacformer_jax.run_folder import RunFolder
from sacformer_jax.train import make_training_env
from sacformer_jax.video import HOLD_SECONDS, Frame, GifWriter, Mp4Writer, check_packages

MAX_FPS = 50.0
"""Frames a second at most, unless asked for: more is not seen."""
_VIDEO_SUFFIXES = (".mp4", ".gif")
_HTML_SUFFIX = ".html"


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
      config: the configuration, of one member.
      policy: one such policy, for its agent.
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
        """
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
            for frame in self._frames(recording, policy, timing) if writers else ():
                for writer in writers:
                    writer.write(frame)
        for path in paths:
            if path.suffix == _HTML_SUFFIX:
                self._write_html(path, recording)
        return Rendering(tuple(paths), recording.returns, recording.lengths)

    def _frames(self, recording: Recording, policy: Policy, timing: Timing) -> Iterator[Frame]:
        """Every episode's frames; the last one stays a moment, with the return."""
        num_episodes, dt = recording.lengths.size, self.source.dt
        hold = max(1, round(HOLD_SECONDS * timing.frames_per_second(dt)))
        for episode, length in enumerate(recording.lengths.tolist()):

            def frame(image: np.ndarray, step: int, num: int = 1, episode: int = episode) -> Frame:
                so_far = float(recording.return_so_far[step, episode])
                lines = caption(self._config, policy, step, so_far)
                if num_episodes > 1:
                    lines = (f"episode {episode + 1} of {num_episodes}", *lines)
                return Frame(image, lines, num)

            for step in timing.steps(length, dt):
                image = self.source.draw(_seen(recording, step, episode))
                yield frame(image, step)
            yield frame(image, length, hold)

    def _write_html(self, path: Path, recording: Recording) -> None:
        page = getattr(self.source, "html", None)
        if page is None:
            raise ConfigError(
                f"to={str(path)!r}: HTML is made by brax's viewer, of environments brax:NAME; of "
                "others .mp4 or .gif"
            )
        length = int(recording.lengths[0])
        states = [_seen(recording, step, 0) for step in range(length)]
        heading = f"{self._config.task.env}: return {recording.returns[0]:.1f} in {length} steps"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(page(states, heading))


def _seen(recording: Recording, step: int, episode: int) -> Any:
    return jax.tree.map(lambda leaf: leaf[step, episode], recording.seen)


def caption(config: Config, policy: Policy, step: int, return_so_far: float) -> tuple[str, ...]:
    """What stands on a frame: time step, return so far and, where the actor is conditioned on it,
    the return-to-go it is shown and the target return.
    """
    lines = (f"step {step}", f"return {return_so_far:.1f}")
    if is_return_conditioned(config):
        target = float(policy.state.target_return)
        lines += (f"return-to-go {target - return_so_far:.1f} of {target:.0f}",)
    return lines


def is_return_conditioned(config: Config) -> bool:
    """Whether the actor sees a return-to-go."""
    return config.agent == "sacformer" and config.context.return_conditioning != "none"


def render(
    run: str | Path,
    to: str | Path | None = None,
    episodes: int = 1,
    seed: int = 0,
    policy: str = "best",
    member: str | int | None = None,
    view: View | None = None,
    timing: Timing | None = None,
) -> Rendering:
    """Makes a video of a run's policy under its mean action.

    Args:
      run: the run's folder.
      to: the file; without a suffix an MP4 and a GIF of that name (of brax a page, too). Default:
        ``videos/best`` (or ``latest``) in the run's folder, or the member's.
      episodes: drawn one after the other, at least 1.
      seed: of the resets, as in :func:`~sacformer_jax.evaluate`, whose returns are those drawn.
      policy: ``"best"`` or ``"latest"``.
      member: of a run of several, which: its seed in training, or its name.
      view: size and camera.
      timing: frames a second; length of the GIF.

    Raises:
      CheckpointError: there is no such run or policy.
      ConfigError: a setting cannot work; a package is missing; or this machine cannot draw.
    """
    if episodes < 1:
        raise ConfigError(f"episodes={episodes}: must be at least 1")
    if not 0 <= seed < 2**32:
        raise ConfigError(f"seed={seed}: must be at least 0 and below 2**32")
    if to is not None and Path(to).suffix not in ("", *_VIDEO_SUFFIXES, _HTML_SUFFIX):
        raise ConfigError(f"to={str(to)!r}: must end in .mp4, .gif, .html or in no suffix")
    loaded = load_policy(run, policy, member)
    if to is None:
        to = _member_folder(run, member) / "videos" / policy
    with PolicyRenderer(loaded, episodes, view) as renderer:
        paths = [Path(to)]
        if not paths[0].suffix:
            suffixes = [*_VIDEO_SUFFIXES, *([_HTML_SUFFIX] if hasattr(renderer.source, "html") else [])]
            paths = [Path(f"{to}{suffix}") for suffix in suffixes]
        return renderer.render(loaded, seed, paths, timing or Timing())


def _member_folder(run: str | Path, member: str | int | None) -> Path:
    from sacformer_jax.policy import member_index

    folder = RunFolder(run).opened()
    members = folder.read_config().members
    return folder.member_path(members[member_index(members, member)].name)


class VideoEvery(Callback):
    """Writes ``videos/step_N.mp4`` in the run's folder at evaluations: the policy as it is then.

    An episode of the first member, or of another one. Nothing that is computed changes; a video
    that cannot be made is said and left out.

    Args:
      env_steps: a video at the first evaluation, and at each that reaches or passes a multiple of it.
      member: of several, which: its seed, or its name.
      view: size and camera.
      say: told what went wrong.

    Raises:
      ConfigError: ``env_steps`` is below 1.
    """

    def __init__(
        self,
        env_steps: int,
        member: str | int | None = None,
        view: View | None = None,
        say: Callable[[str], None] = print,
    ):
        if env_steps < 1:
            raise ConfigError(f"env_steps={env_steps}: must be at least 1")
        self.every, self.member, self.view = env_steps, member, view or View(320, 240)
        self._say, self._done = say, -1
        self._renderer: PolicyRenderer | None = None

    def on_start(self, run: RunStart) -> None:
        # Of a resumed run those up to here are there already.
        self._done = run.env_steps // self.every if run.env_steps else -1

    def on_eval(self, event: Event) -> None:
        number = event.env_steps // self.every
        if number <= self._done:
            return
        self._done = number
        path = event.path / "videos" / f"step_{event.env_steps}.mp4"
        try:
            policy = event.policy(event.members[0] if self.member is None else self.member)
            if self._renderer is None:
                self._renderer = PolicyRenderer(policy, view=self.view)
            self._renderer.render(policy, 0, [path], Timing())
        except Exception as error:  # a picture is no reason to lose a run
            reason = next(iter(str(error).splitlines()), type(error).__name__)
            self._say(f"note: no video {path} ({reason}); training goes on")

    def on_end(self, result: Any) -> None:
        if self._renderer is not None:
            self._renderer.source.close()
            self._renderer = None

"""Videos of policies: of a run's, and of a run in training."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from sacformer_jax.callbacks import Callback, Event, RunStart
from sacformer_jax.config import ConfigError
from sacformer_jax.envs import Env
from sacformer_jax.frames import frame_source
from sacformer_jax.model_renderer import View
from sacformer_jax.policy import load_policy, member_index
from sacformer_jax.policy_renderer import (
    HTML_SUFFIX,
    VIDEO_SUFFIXES,
    PolicyRenderer,
    Rendering,
    Timing,
)
from sacformer_jax.run_folder import RunFolder
from sacformer_jax.video import check_packages

_TRIAL = 32
"""Pixels of a view that only tries whether it can be had."""


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
    check_target(to)
    loaded = load_policy(run, policy, member)
    to = Path(to) if to is not None else _member_folder(run, member) / "videos" / policy
    with PolicyRenderer(loaded, episodes, view) as renderer:
        paths = [to]
        if not to.suffix:
            page = (HTML_SUFFIX,) if hasattr(renderer.source, "html") else ()
            paths = [to.with_name(to.name + suffix) for suffix in (*VIDEO_SUFFIXES, *page)]
        return renderer.render(loaded, seed, paths, timing or Timing())


def check_target(to: str | Path | None) -> None:
    """Refuses a file that no video can be written to.

    Raises:
      ConfigError: another suffix, or a folder.
    """
    if to is None:
        return
    if Path(to).suffix not in ("", *VIDEO_SUFFIXES, HTML_SUFFIX):
        raise ConfigError(f"to={str(to)!r}: must end in .mp4, .gif, .html or in no suffix")
    if Path(to).is_dir():
        raise ConfigError(f"to={str(to)!r}: is a folder; give a file in it")


def check_drawable(env: Env) -> None:
    """Refuses an environment that cannot be drawn here.

    Raises:
      ConfigError: a package or OpenGL is missing, or nobody can draw it.
    """
    check_packages()
    frame_source(env, View(_TRIAL, _TRIAL)).close()


def _member_folder(run: str | Path, member: str | int | None) -> Path:
    folder = RunFolder(run).opened()
    members = folder.read_config().members
    return folder.member_path(members[member_index(members, member)].name)


class VideoEvery(Callback):
    """Writes ``videos/step_N.mp4`` in the run's folder at evaluations: the policy as it is then.

    An episode of the first member, or of another one. Nothing that is computed changes; a video
    that cannot be made is said and left out.

    Args:
      env_steps: a video at the first evaluation, and at each that reaches a multiple or passes one.
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
        self._done = run.env_steps // self.every if run.resumed else -1

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

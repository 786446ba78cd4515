"""The commands that make pictures of runs: ``sacformer render | plot``."""

from __future__ import annotations

import contextlib
import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import tyro

from sacformer_jax.config import ConfigError


@dataclasses.dataclass(frozen=True)
class RenderArgs:
    """Make a video of a run's policy under its mean action: MP4 and GIF, of brax a page, too."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    to: Path | None = None
    """File; without a suffix .mp4 and .gif are made. Default: videos/best in the run's folder."""
    episodes: int = 1
    """Episodes, one after the other."""
    policy: Literal["best", "latest"] = "best"
    """Which policy: best or latest."""
    member: str | None = None
    """Of a run of several, which: its seed in training, or its name; default: each."""
    seed: int = 0
    """Seed of the resets; the returns are those of `sacformer evaluate` with the same."""
    size: str = "480x360"
    """Width and height in pixels, even."""
    camera: str | None = None
    """Name or number of the model's camera; default: the one that follows."""
    fps: float | None = None
    """Frames a second, in real time; default: each step's, or so many that they are at most 50."""
    gif_seconds: float = 10.0
    """Length of the GIF."""


@dataclasses.dataclass(frozen=True)
class PlotArgs:
    """Draw the pictures of a run (or compare several): returns, diagnostics and, of SACFormer, the
    return achieved against the target and the attention over the context.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of the runs."""
    to: Path | None = None
    """Folder of the pictures; default: the run's (members: theirs), of several runs this one."""
    policy: Literal["best", "latest"] = "best"
    """Which policy is evaluated: best or latest."""
    episodes: int = 4
    """Episodes for each target return; 0: only what needs no policy."""
    seed: int = 0
    """Seed of the resets."""


def parse_size(text: str) -> tuple[int, int]:
    """``"480x360"`` as width and height.

    Raises:
      ConfigError: it is not of that form.
    """
    found = re.fullmatch(r"(\d+)x(\d+)", text)
    if found is None:
        raise ConfigError(f"size={text!r}: must be WIDTHxHEIGHT, as 480x360")
    return int(found[1]), int(found[2])


@contextlib.contextmanager
def _told() -> Iterator[None]:
    """What a file cannot be written for, in a line."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            raise
        raise ConfigError(f"{str(error.filename)!r}: {error.strerror}") from error


@_told()
def render(args: list[str]) -> int:
    """``sacformer render``."""
    from sacformer_jax.model_renderer import View
    from sacformer_jax.policy_renderer import Timing
    from sacformer_jax.render import check_target
    from sacformer_jax.render import render as draw
    from sacformer_jax.run_folder import RunFolder

    parsed = tyro.cli(RenderArgs, args=args, prog="sacformer render")
    view = View(*parse_size(parsed.size), parsed.camera)
    timing = Timing(parsed.fps, parsed.gif_seconds)
    check_target(parsed.to)
    names = [member.name for member in RunFolder(parsed.run).opened().read_config().members]
    each = parsed.member is None and len(names) > 1
    for member in names if each else [parsed.member]:
        to = parsed.to
        if each and to is not None:
            to = to.with_name(f"{to.stem}-{member}{to.suffix}")
        drawn = draw(
            parsed.run,
            to=to,
            episodes=parsed.episodes,
            seed=parsed.seed,
            policy=parsed.policy,
            member=member,
            view=view,
            timing=timing,
        )
        who = f"{member}: " if each else ""
        for number, (value, length) in enumerate(zip(drawn.returns, drawn.lengths, strict=True)):
            print(f"{who}episode {number + 1}: return {value:.1f}, {length} steps")
        for path in drawn.paths:
            print(f"  {path}  {path.stat().st_size / 2**20:.1f} MiB")
    return 0


@_told()
def plot(args: list[str]) -> int:
    """``sacformer plot``."""
    from sacformer_jax.pictures import draw_runs

    parsed = tyro.cli(PlotArgs, args=args, prog="sacformer plot")
    if not parsed.runs:
        raise ConfigError("runs=(): name at least one run folder")
    if parsed.episodes < 0:
        raise ConfigError(f"episodes={parsed.episodes}: must not be negative")
    for path in draw_runs(
        parsed.runs, parsed.to, policy=parsed.policy, episodes=parsed.episodes, seed=parsed.seed
    ):
        print(path)
    return 0

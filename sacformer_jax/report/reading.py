"""What a run's folder tells, for a report: also of one that is running, or was killed."""

from __future__ import annotations

import contextlib
import dataclasses
import json
from pathlib import Path

import numpy as np

from sacformer_jax.config import Config
from sacformer_jax.logging import Record, read_records
from sacformer_jax.run_folder import RunFolder

RESAMPLES = 2_000
"""Of a bootstrap interval."""


@dataclasses.dataclass(frozen=True)
class Faults:
    """What went wrong in a run and was survived, over all its members.

    Attributes:
      bad_physics: steps dropped because the physics broke down.
      skipped_updates: updates skipped because a tensor was not finite.
      damaged_checkpoints: checkpoints found damaged and moved aside.
      given_up: members that learn no more, with the first tensor that was not finite.
    """

    bad_physics: int
    skipped_updates: int
    damaged_checkpoints: int
    given_up: dict[str, str]

    @property
    def total(self) -> int:
        return (
            self.bad_physics + self.skipped_updates + self.damaged_checkpoints + len(self.given_up)
        )


@dataclasses.dataclass(frozen=True)
class Curve:
    """Evaluations of a run where all its members were evaluated, E of them.

    Attributes:
      env_steps: ``[E]``.
      members: ``[M, E]`` mean return of each member.
      mean: ``[E]`` over the members.
      low: ``[E]``, lower end of the interval.
      high: ``[E]``, upper end.
      interval: what the interval is.
    """

    env_steps: np.ndarray
    members: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    interval: str


@dataclasses.dataclass(frozen=True)
class Run:
    """A run as its folder shows it.

    Attributes:
      label: what to call it beside the others.
      path: its folder.
      config: the configuration.
      sources: where each value comes from.
      task: the environment, and how it is wrapped.
      engine: which physics ran it.
      train: by member, the records of kind ``"train"``.
      evaluations: by member, those of kind ``"eval"``.
      timings: records of ``timings.jsonl``.
      faults: what went wrong.
      video: the newest there is, or None.
    """

    label: str
    path: Path
    config: Config
    sources: dict[str, str]
    task: str
    engine: str
    train: dict[str, list[Record]]
    evaluations: dict[str, list[Record]]
    timings: list[Record]
    faults: Faults
    video: Path | None

    @property
    def records(self) -> dict[str, list[Record]]:
        """Of both kinds, by member."""
        return {name: [*own, *self.evaluations[name]] for name, own in self.train.items()}

    @property
    def env_steps(self) -> int:
        """Environment steps done by each member, as far as metrics tell."""
        rows = [*self.train.values(), *self.evaluations.values()]
        return max((record["env_steps"] for own in rows for record in own), default=0)

    @property
    def steps_per_second(self) -> float | None:
        """Environment steps a second over all members: the median over chunks."""
        if not self.timings:
            return None
        return float(np.median([record["steps_per_second"] for record in self.timings]))

    @property
    def stretches(self) -> int:
        """How many times it was started or resumed, as far as timings tell."""
        wall = [record["wall_seconds"] for record in self.timings]
        return 1 + int(np.sum(np.diff(wall) < 0)) if wall else 0

    @property
    def training_seconds(self) -> np.ndarray:
        """For each of ``timings``, training time so far, over all stretches."""
        wall = np.array([record["wall_seconds"] for record in self.timings])
        before = np.where(np.diff(wall, prepend=0.0) < 0, np.roll(wall, 1), 0.0)
        return wall + np.cumsum(before)

    def curve(self) -> Curve | None:
        """Its evaluations; None without any."""
        own = [
            {record["env_steps"]: record for record in records}
            for records in self.evaluations.values()
        ]
        steps = sorted(set.intersection(*(set(records) for records in own)))
        if not steps:
            return None
        means = np.array([[records[step]["return_mean"] for step in steps] for records in own])
        mean = means.mean(axis=0)
        if len(own) > 1:
            low, high = bootstrap_interval(means)
            interval = f"95 % bootstrap interval of the mean over {len(own)} members"
        else:
            spread = np.array([own[0][step]["return_std"] for step in steps])
            low, high = mean - spread, mean + spread
            interval = "mean ± standard deviation over the episodes"
        return Curve(np.array(steps), means, mean, low, high, interval)


def bootstrap_interval(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ends of the 95 % percentile-bootstrap interval of the mean over the members.

    Args:
      values: ``[M, E]``; members are drawn anew, all their values together.
    """
    generator = np.random.default_rng(0)
    drawn = generator.integers(len(values), size=(RESAMPLES, len(values)))
    low, high = np.percentile(values[drawn].mean(axis=1), [2.5, 97.5], axis=0)
    return low, high


def read_run(path: str | Path, label: str) -> Run:
    """Reads a run's folder.

    Raises:
      CheckpointError: there is no run, or its ``config.json`` is damaged.
    """
    folder = RunFolder(path).opened()
    known, spec = folder.read_config(), folder.read_spec()
    metrics = {
        member.name: read_records(folder.metrics_path(member.name)) for member in known.members
    }
    by_kind = {
        kind: {
            name: [record for record in records if record["kind"] == kind]
            for name, records in metrics.items()
        }
        for kind in ("train", "eval", "pretrain")
    }
    learning = [*by_kind["train"].values(), *by_kind["pretrain"].values()]
    return Run(
        label=label,
        path=folder.path,
        config=known.config,
        sources=known.sources,
        task=", ".join([known.config.task.env, *spec.wrapping.words()]),
        engine=spec.engine,
        train=by_kind["train"],
        evaluations=by_kind["eval"],
        timings=read_records(folder.timings_path),
        faults=_faults(folder, list(metrics), learning),
        video=_newest_video(folder.path),
    )


def _faults(folder: RunFolder, names: list[str], learning: list[list[Record]]) -> Faults:
    def total(name: str) -> int:
        return sum(record.get(name) or 0 for records in learning for record in records)

    given_up = {}
    for name in names:
        file = folder.member_path(name) / "fault.json"
        if file.exists():
            given_up[name] = str(json.loads(file.read_text())["first_tensor_not_finite"])
    damaged = folder.path / "damaged"
    return Faults(
        bad_physics=int(total("bad_physics")),
        skipped_updates=int(total("skipped_updates")),
        damaged_checkpoints=len(list(damaged.iterdir())) if damaged.is_dir() else 0,
        given_up=given_up,
    )


def _newest_video(path: Path) -> Path | None:
    found = [*path.glob("*.mp4"), *path.glob("videos/*.mp4"), *path.glob("*/videos/*.mp4")]
    times: dict[Path, float] = {}
    for video in found:
        if video.name.startswith("."):  # being drawn
            continue
        with contextlib.suppress(FileNotFoundError):
            times[video] = video.stat().st_mtime
    return max(times, key=times.__getitem__, default=None)

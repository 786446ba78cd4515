"""Weights & Biases: a run of theirs for each member of a run, offline too.

TensorBoard, JSONL and CSV need nothing of this; see :mod:`sacformer_jax.logging`.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import secrets
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from sacformer_jax.callbacks import Callback, Event, RunStart
from sacformer_jax.config import ConfigError
from sacformer_jax.logging import Record
from sacformer_jax.results import RunResult
from sacformer_jax.run_folder import write_whole
from sacformer_jax.values import first_line

WandbMode = Literal["online", "offline"]
_FILE = "wandb.json"
_NOT_METRICS = ("kind", "env_steps", "updates", "member")


@dataclasses.dataclass(frozen=True)
class Tracking:
    """Where a run is tracked besides its folder. A resumed run stays where it was."""

    wandb_project: str | None = None
    """Project of Weights & Biases to track the run in; needs the extra wandb."""
    wandb_entity: str | None = None
    """User or team there; default: your own."""
    wandb_mode: WandbMode = "online"
    """Send at once, or write to the run's folder for `wandb sync`."""

    def callbacks(self) -> list[Callback]:
        """The trackers asked for.

        Raises:
          ConfigError: an entity or a mode without a project.
        """
        if self.wandb_project is not None:
            return [WandbTracker(self.wandb_project, self.wandb_entity, self.wandb_mode)]
        if self.wandb_entity is not None or self.wandb_mode != "online":
            raise ConfigError(
                f"wandb_entity={self.wandb_entity!r}, wandb_mode={self.wandb_mode!r}: "
                "give wandb_project, too"
            )
        return []


class WandbTracker(Callback):
    """Tracks a run in Weights & Biases: a run of theirs for each member, grouped by ours.

    Names and ids are in ``wandb.json`` in the run's folder, so that a resumed run goes on in the
    same ones (see :func:`resumed_tracking`). Metrics are over ``env_steps``; where a killed run is
    resumed from an older checkpoint, what it computes again, to the same values, is there twice.
    Once training has begun, a failure of theirs is a warning: the run's own files have everything.

    Args:
      project: theirs.
      entity: user or team; None: one's own.
      mode: ``"online"``, or ``"offline"``: into the run's folder, for ``wandb sync``.

    Raises:
      ConfigError: the package is not installed.
    """

    def __init__(self, project: str, entity: str | None = None, mode: WandbMode = "online"):
        try:
            import wandb
        except ModuleNotFoundError as error:
            raise ConfigError(
                f"wandb_project={project!r}: Weights & Biases is not installed; "
                "pip install 'sacformer-jax[wandb]'"
            ) from error
        self._wandb = wandb
        self.project, self.entity, self.mode = project, entity, mode
        self._runs: dict[str, Any] = {}
        self._path: Path | None = None
        self._failed = False

    def on_start(self, run: RunStart) -> None:
        """Starts or continues their runs.

        Raises:
          ConfigError: they do not let us in.
        """
        self._path = run.path
        ids = self._ids(run)
        for member in run.members:
            settings = self._wandb.Settings(console="off", silent=self.mode == "offline")
            try:
                started = self._wandb.init(
                    project=self.project,
                    entity=self.entity,
                    mode=self.mode,
                    dir=run.path,
                    id=ids[member.name],
                    resume="allow",
                    reinit="create_new",  # members run side by side
                    name=f"{run.path.name}-{member.name}" if len(ids) > 1 else run.path.name,
                    group=run.path.name,
                    config=member.config(run.config).flat(),
                    settings=settings,
                )
            except self._wandb.errors.Error as error:
                raise ConfigError(
                    f"wandb_mode={self.mode!r}: {first_line(error)}; log in with 'wandb login', "
                    "or use wandb_mode=offline"
                ) from error
            started.define_metric("env_steps")
            started.define_metric("*", step_metric="env_steps")
            self._runs[member.name] = started

    def on_chunk(self, event: Event) -> None:
        """Sends training metrics, and timings."""
        timings = _named("timing", event.timings)
        for name, record in event.records.items():
            self._send(name, event, {**_named("train", record), **timings})

    def on_eval(self, event: Event) -> None:
        """Sends evaluations."""
        for name, record in event.records.items():
            self._send(name, event, _named("eval", record))

    def on_end(self, result: RunResult | None) -> None:
        """Finishes their runs."""
        for started in self._runs.values():
            self._guarded(functools.partial(started.finish, exit_code=int(result is None)))
        self._runs = {}

    def _send(self, name: str, event: Event, values: Record) -> None:
        values = {**values, "env_steps": event.env_steps, "updates": event.records[name]["updates"]}
        self._guarded(lambda: self._runs[name].log(values))

    def _guarded(self, do: Callable[[], None]) -> None:
        try:
            do()
        except Exception as error:
            if not self._failed:
                warnings.warn(
                    f"Weights & Biases: {first_line(error)}; training goes on, and everything is "
                    f"in {self._path}",
                    stacklevel=2,
                )
            self._failed = True

    def _ids(self, run: RunStart) -> dict[str, str]:
        """An id of theirs for each member, kept in the run's folder."""
        path = run.path / _FILE
        known = _remembered(path) if path.exists() and run.resumed else {}
        ids = dict(known.get("ids", {}))
        for member in run.members:
            ids.setdefault(member.name, secrets.token_hex(4))
        chosen = {"project": self.project, "entity": self.entity, "mode": self.mode}
        if known != {**chosen, "ids": ids}:
            write_whole(path, json.dumps({**chosen, "ids": ids}, indent=2) + "\n")
        return ids


def resumed_tracking(path: Path) -> list[Callback]:
    """The trackers that a run had before it was stopped.

    Args:
      path: the run's folder.

    Raises:
      ConfigError: what the run remembers of them cannot be read.
    """
    file = path / _FILE
    if not file.exists():
        return []
    known = _remembered(file)
    return Tracking(known["project"], known["entity"], known["mode"]).callbacks()


def _remembered(file: Path) -> dict[str, Any]:
    """Project, entity, mode and ids."""
    try:
        known = json.loads(file.read_text())
        return {name: known[name] for name in ("project", "entity", "mode", "ids")}
    except OSError as error:
        raise ConfigError(
            f"{file} cannot be read ({first_line(error)}): make it readable, or remove it to go on "
            "without Weights & Biases"
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"{file} is damaged ({first_line(error)}): remove it to go on without Weights & Biases"
        ) from error


def _named(kind: str, record: Record) -> Record:
    """A record's metrics as ``kind/name``; those without a value are left out."""
    return {
        f"{kind}/{name}": value
        for name, value in record.items()
        if name not in _NOT_METRICS and value is not None
    }

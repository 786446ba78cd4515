"""Run folders: configuration, members, and the newest checkpoint that is good.

A run folder holds::

    config.json        configuration, source of each value, members, environment facts, version
    lock               held while a process trains here
    checkpoints/STEP/  Orbax: "state" (everything), "policy" (of all members), "metadata"
    damaged/STEP/      checkpoints that turned out to be damaged
    videos/            see sacformer_jax.render
    best/STEP/         Orbax: "policy", "metadata" of the best evaluation so far
    metrics.jsonl      see sacformer_jax.logging

With several members the last two lie in a folder for each, by its name.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sacformer_jax import processes, stored
from sacformer_jax.config import Config, ConfigError
from sacformer_jax.envs.core import EnvSpec
from sacformer_jax.members import Member
from sacformer_jax.restoring import Restored, restore_newest
from sacformer_jax.stored import FORMAT, CheckpointError
from sacformer_jax.types import TrainState
from sacformer_jax.version import __version__


@dataclasses.dataclass(frozen=True)
class RunConfigFile:
    """Contents of ``config.json`` that decide the run.

    Attributes:
      config: the configuration.
      sources: where each value comes from.
      members: what is trained.
    """

    config: Config
    sources: dict[str, str]
    members: tuple[Member, ...]


class RunFolder:
    """A run's folder.

    Args:
      path: the folder, which may not exist yet.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path).expanduser().absolute()
        self._num_members: int | None = None

    @property
    def timings_path(self) -> Path:
        return self.path / "timings.jsonl"

    @property
    def checkpoints_path(self) -> Path:
        return self.path / "checkpoints"

    def member_path(self, name: str) -> Path:
        """The folder of a member: the run's own where there is no other."""
        if self._num_members is None:
            self._num_members = len(self.read_config().members)
        return self.path if self._num_members == 1 else self.path / name

    def metrics_path(self, name: str) -> Path:
        """The metrics of a member."""
        return self.member_path(name) / "metrics.jsonl"

    # --- the folder ------------------------------------------------------------------------------

    def create(
        self,
        config: Config,
        sources: dict[str, str],
        spec: EnvSpec,
        members: tuple[Member, ...],
    ) -> None:
        """Makes the folder and writes ``config.json``; of several processes the first does.

        Raises:
          CheckpointError: the folder holds a run with a checkpoint already (one that was stopped
            before its first may be started again), or cannot be written.
        """
        if self.latest_step() is not None:
            raise CheckpointError(
                f"run_dir={str(self.path)!r} holds a run already: "
                f"continue it with 'sacformer resume {self.path}' or choose another folder"
            )
        self._num_members = len(members)
        contents = {
            "format": FORMAT,
            "version": __version__,
            "config": config.to_dict(),
            "sources": sources,
            "members": [dataclasses.asdict(member) for member in members],
            "env_spec": dataclasses.asdict(spec),
        }
        if not processes.is_first():
            return
        try:
            for member in members:
                path = self.member_path(member.name)
                path.mkdir(parents=True, exist_ok=True)
                # Left by a run that was stopped before its first checkpoint.
                if (path / "best").exists():
                    shutil.rmtree(path / "best")
            write_whole(self.path / "config.json", json.dumps(contents, indent=2) + "\n")
        except OSError as error:
            raise CheckpointError(
                f"run_dir={str(self.path)!r} cannot be written ({error.strerror}): "
                "choose a folder that can"
            ) from error

    def opened(self) -> RunFolder:
        """Itself, if it holds a run.

        Raises:
          CheckpointError: it does not.
        """
        if not (self.path / "config.json").is_file():
            raise CheckpointError(
                f"run {str(self.path)!r}: no config.json there; give the folder of a run, "
                "as printed at the start of 'sacformer train'"
            )
        return self

    def _config_json(self) -> dict[str, Any]:
        path = self.path / "config.json"
        try:
            contents = json.loads(path.read_text())
            made_with = contents["format"]
            parts = {"config", "sources", "members", "env_spec"}
            if made_with == FORMAT and not parts <= set(contents):
                raise KeyError("config, sources, members or env_spec")
        except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError, OSError) as error:
            raise CheckpointError(f"{path} is damaged: restore it from a copy") from error
        if made_with != FORMAT:
            raise CheckpointError(
                f"{path} has format {made_with}, this version reads format {FORMAT}: "
                f"use sacformer-jax {contents.get('version')}"
            )
        return contents

    def read_config(self) -> RunConfigFile:
        """The run's configuration and members."""
        contents = self._config_json()
        config = Config.from_dict(contents["config"])
        # A run of an earlier version knows no source of later fields: they are at their defaults.
        sources = dict.fromkeys(config.flat(), "default")
        members = tuple(Member(**member) for member in contents["members"])
        return RunConfigFile(config, {**sources, **contents["sources"]}, members)

    def read_spec(self) -> EnvSpec:
        """Facts of the run's environment, without making it."""
        return EnvSpec.from_dict(self._config_json()["env_spec"])

    # --- checkpoints -----------------------------------------------------------------------------

    def steps(self) -> list[int]:
        """Environment steps of the checkpoints there are, oldest first, good or not."""
        return stored.steps_in(self.checkpoints_path)

    def latest_step(self) -> int | None:
        """Environment steps of the newest checkpoint; None without any."""
        return max(self.steps(), default=None)

    def latest_devices(self) -> dict[str, int]:
        """Over how many devices what is split in the newest checkpoint whose metadata is good, by
        name; empty where that is not known.
        """
        for step in reversed(self.steps()):
            try:
                metadata = stored.read_metadata(self.checkpoints_path / str(step))
            except (stored.DamagedError, CheckpointError):  # restoring it tells
                continue
            return metadata.get("devices") or {}
        return {}

    def restore(
        self,
        abstract_state: TrainState,
        block_axes: Any = None,
        shardings: Any = None,
        move_aside: bool = True,
    ) -> Restored:
        """Reads the newest checkpoint that is good; newer ones go to ``damaged/``.

        With several processes all have to call it; the first moves folders.

        Args:
          abstract_state: shapes of the train state.
          block_axes: of the digests; None: those with which it was saved.
          shardings: how to lay it on devices, whatever they were when it was saved, a PyTree like
            ``abstract_state``; None: on the first device.
          move_aside: false: only passes over what is damaged.

        Raises:
          CheckpointError: there is none; or all are damaged; or one is of another version,
            configuration or shape, and nothing was moved because of it.
        """
        config = self.read_config().config
        return restore_newest(self.path, config, abstract_state, block_axes, shardings, move_aside)


def write_whole(path: Path, text: str) -> None:
    """Writes a file so that at any moment there is the old one or the new one."""
    new = path.with_name(path.name + ".new")
    with open(new, "w") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    os.replace(new, path)


def labels(paths: Sequence[str | Path]) -> list[str]:
    """A short name for each run's folder, unique among them: its last part, or more where needed.

    Raises:
      ConfigError: one was given twice.
    """
    folders = [RunFolder(path).path for path in paths]
    twice = [str(folder) for folder in folders if folders.count(folder) > 1]
    if twice:
        raise ConfigError(f"runs: {twice[0]!r} was given twice")
    names, length = [folder.name for folder in folders], 1
    while len(set(names)) < len(names):
        length += 1
        names = ["/".join(folder.parts[1:][-length:]) for folder in folders]
    return names

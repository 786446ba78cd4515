"""Taking members out of a run: a run folder of their own, to be resumed alone."""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np

from sacformer_jax.checkpoint import CheckpointError, CheckpointWriter, RunFolder
from sacformer_jax.config import Config, ConfigError
from sacformer_jax.members import Member
from sacformer_jax.policy import member_index
from sacformer_jax.population import make_population
from sacformer_jax.train import policy_of
from sacformer_jax.values import first_line

_PART = ".new"
"""Where it is put together, in the new folder."""


def extract(path: str | Path, members: Sequence[str | int], to: str | Path) -> Path:
    """Writes some members of a run, as of its newest good checkpoint, as a run of its own.

    Their train states, metrics and best policies go with them; the run itself stays as it is. One
    member becomes a run like any other, with its seed and settings in the configuration.

    Args:
      path: the run's folder.
      members: their seeds or names, each once.
      to: the new run's folder.

    Returns:
      the new folder.

    Raises:
      ConfigError: no such member, or one twice.
      CheckpointError: there is no checkpoint, or the new folder holds something already or cannot
        be written. The run is there as a whole or not at all (after a kill the folder may hold
        parts of it, which are no run).
    """
    folder, target = RunFolder(path).opened(), RunFolder(to)
    _check_new(target.path)
    run = folder.read_config()
    places = [member_index(run.members, member) for member in members]
    if not places or len(set(places)) < len(places):
        raise ConfigError(f"members={list(members)}: name at least one, and each once")
    chosen = tuple(run.members[place] for place in places)
    population = make_population(run.config, run.members)
    block_axes = population.stored(population.block_axes)
    abstract = population.stored(population.abstract())
    restored = folder.restore(abstract, block_axes, move_aside=False)
    state = jax.tree.map(
        lambda spec, leaf: leaf[np.array(places)] if len(spec) else leaf,
        population.stored(population.specs),
        restored.state,
    )
    progress = dataclasses.replace(
        restored.progress,
        best=tuple(restored.progress.best[place] for place in places),
        metrics_bytes=tuple(restored.progress.metrics_bytes[place] for place in places),
    )
    config = _config_of(run.config, chosen).replace(run_dir=str(target.path))
    if len(chosen) == 1:
        chosen = (Member(chosen[0].name, chosen[0].seed),)  # its settings are the run's own now
    made = not target.path.exists()
    # A folder without a checkpoint would be a run that is to start from the beginning.
    part = RunFolder(target.path / _PART)
    try:
        _remove(part.path)
        part.create(config, run.sources, folder.read_spec(), chosen)
        for member, place, num_bytes in zip(chosen, places, progress.metrics_bytes, strict=True):
            source = folder.member_path(run.members[place].name)
            goal = part.member_path(member.name)
            goal.mkdir(exist_ok=True)
            metrics = folder.metrics_path(run.members[place].name)
            if metrics.exists():
                part.metrics_path(member.name).write_bytes(metrics.read_bytes()[:num_bytes])
            if (source / "best").is_dir():
                shutil.copytree(source / "best", goal / "best")
        with CheckpointWriter(part, config, block_axes, restored.devices) as writer:
            writer.save(state, policy_of(state), progress)
        _move_up(part.path)
    except (OSError, CheckpointError) as error:
        raise _not_written(target.path, error) from error
    finally:
        _remove(part.path)
        if made:
            with contextlib.suppress(OSError):  # it was never there, or holds the run
                target.path.rmdir()
    return target.path


def _move_up(part: Path) -> None:
    """Moves all that is in a folder to the one around it, or nothing.

    The folder itself may be a link or a mount, which cannot be replaced. What makes it a run comes
    last.
    """
    moved: list[Path] = []
    try:
        for path in sorted(part.iterdir(), key=lambda path: path.name == "config.json"):
            moved.append(path.rename(part.parent / path.name))
        part.rmdir()
    except BaseException:
        for path in moved:
            _remove(path)
        raise


def _remove(path: Path) -> None:
    shutil.rmtree(path, ignore_errors=True)
    with contextlib.suppress(OSError):  # it is there no more, or cannot be removed
        path.unlink()


def _check_new(path: Path) -> None:
    """Refuses all but an empty folder, or one in which nothing was finished."""
    try:
        new = not path.exists() or (
            path.is_dir() and {each.name for each in path.iterdir()} <= {_PART}
        )
    except OSError as error:
        raise _not_written(path, error) from error
    if not new:
        raise CheckpointError(
            f"to={str(path)!r} holds a run already, or something else: choose a new folder"
        )


def _not_written(path: Path, error: Exception) -> CheckpointError:
    why = first_line(error.__cause__ or error)
    return CheckpointError(
        f"to={str(path)!r} cannot be written ({why}): choose a folder "
        "that can, or try again where the run is being trained"
    )


def _config_of(config: Config, members: Sequence[Member]) -> Config:
    if len(members) == 1:
        return members[0].config(config)
    if any(member.values for member in members):
        return config
    seeds = tuple(member.seed for member in members)
    return config.replace(seed=seeds[0], seeds=seeds)

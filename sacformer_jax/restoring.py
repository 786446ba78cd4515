"""The newest checkpoint that is good, onto whatever devices there are."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any

from sacformer_jax import processes, stored
from sacformer_jax.config import Config, ConfigError
from sacformer_jax.stored import CheckpointError, DamagedError, Progress
from sacformer_jax.types import TrainState

MAY_DIFFER = (
    "total_env_steps", "eval_every", "eval_episodes", "checkpoint_every", "max_skipped_updates",
    "run_dir",
)  # fmt: skip
"""Settings that may be other ones than those a checkpoint was made with."""


@dataclasses.dataclass(frozen=True)
class Restored:
    """A checkpoint read back and verified.

    Attributes:
      state: the whole train state.
      progress: of the host loop.
      host_threads: XLA's CPU threads in the process that wrote it; sums are split over them, so
        only the same number continues bit for bit.
      devices: over how many of them what was split, by name, of which the same holds; empty where
        that is not known.
      moved_aside: a line on each newer checkpoint that was damaged.
    """

    state: TrainState
    progress: Progress
    host_threads: int
    devices: dict[str, int]
    moved_aside: tuple[str, ...]


def restore_newest(
    run: Path,
    config: Config,
    abstract: TrainState,
    block_axes: Any,
    shardings: Any,
    move_aside: bool,
) -> Restored:
    """See :meth:`~sacformer_jax.run_folder.RunFolder.restore`.

    Args:
      run: the run's folder.
      config: what ``config.json`` says.
      abstract: shapes of the train state.
      block_axes: of the digests, or None.
      shardings: of the state, or None.
      move_aside: what is damaged, or only pass over it.
    """
    damaged: list[tuple[Path, str]] = []
    steps = stored.steps_in(run / "checkpoints")
    while (step := processes.of_the_first(steps.pop() if steps else None)) is not None:
        path = run / "checkpoints" / str(step)
        try:
            metadata, state = _read(path, config, abstract, block_axes, shardings)
            stored.check_digests("state", metadata, state)
        except DamagedError as error:
            damaged.append((path, str(error)))
            continue
        progress = Progress.from_dict(metadata["progress"])
        # Not before there is another: a folder without checkpoints is a run that has none yet, and
        # would start from the beginning.
        moved = [
            _told(path, reason)
            + (f": moved to {_move_aside(path, run / 'damaged', reason)}" if move_aside else "")
            for path, reason in damaged
        ]
        return Restored(
            state=state,
            progress=progress,
            host_threads=metadata["host_threads"],
            devices=metadata.get("devices") or {},
            moved_aside=tuple(moved),
        )
    if damaged:
        told = "; ".join(_told(path, reason) for path, reason in damaged)
        raise CheckpointError(
            f"run {str(run)!r} has no checkpoint left that is good: {told}. All are still there: "
            "put one back from a copy, or train in a new folder"
        )
    raise CheckpointError(f"run {str(run)!r} has no checkpoint yet: start it again in a new folder")


def _told(path: Path, reason: str) -> str:
    return f"checkpoint {path} is damaged ({reason})"


def _read(
    path: Path, config: Config, abstract: TrainState, block_axes: Any, shardings: Any
) -> tuple[dict[str, Any], TrainState]:
    """Metadata and state of a checkpoint, or the same kind of error on all processes."""
    problem: Exception | None = None
    try:
        metadata = stored.read_metadata(path)
        if str(metadata["progress"]["env_steps"]) != path.name:
            raise DamagedError(f"it is that of step {metadata['progress']['env_steps']}")
        _check_config(path, metadata, config)
        if block_axes is not None:
            _check_block_axes(path, metadata, stored.leaf_table(abstract, block_axes))
        state = stored.read_item(path, "state", metadata, abstract, shardings)
    except (DamagedError, CheckpointError) as error:
        problem = error
    kinds = (DamagedError, CheckpointError)
    own = 0 if problem is None else 1 + kinds.index(type(problem))
    worst = processes.most(own)
    if problem is not None and own == worst:
        raise problem
    if worst:
        raise kinds[worst - 1](f"another process could not read {path}")
    return metadata, state


def _move_aside(path: Path, folder: Path, reason: str) -> Path:
    """Moves a damaged checkpoint into a folder; returns where to."""
    target, count = folder / path.name, 1
    while target.exists():
        count += 1
        target = folder / f"{path.name}-{count}"
    processes.all_here()  # all have to see where to before it is moved
    if processes.is_first():
        try:
            folder.mkdir(exist_ok=True)
            os.rename(path, target)
        except OSError as error:
            raise CheckpointError(
                f"{_told(path, reason)} and cannot be moved to {target} "
                f"({error.strerror}): make the folder writable"
            ) from error
    processes.all_here()
    return target


def _check_config(path: Path, metadata: dict[str, Any], config: Config) -> None:
    now = config.flat()
    try:
        made_with = Config.from_dict(metadata["config"]).flat()
    except ConfigError as error:
        raise CheckpointError(
            f"checkpoint {path} is of sacformer-jax {metadata['version']}: use that one ({error})"
        ) from error
    for name, value in now.items():
        if name not in MAY_DIFFER and made_with[name] != value:
            raise CheckpointError(
                f"checkpoint {path} was made with {name}={made_with[name]!r}, config.json says "
                f"{name}={value!r}: put config.json back as it was"
            )


def _check_block_axes(path: Path, metadata: dict[str, Any], wanted: dict[str, Any]) -> None:
    found = metadata["items"]["state"]
    for name, entry in wanted.items():
        if name in found and found[name]["block_axes"] != entry["block_axes"]:
            raise CheckpointError(
                f"checkpoint {path} does not fit: {name} was divided along "
                f"{found[name]['block_axes']} axes, not {entry['block_axes']}"
            )

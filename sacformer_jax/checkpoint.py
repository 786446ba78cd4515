"""Writing checkpoints in the background."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
from types import TracebackType
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import orbax.checkpoint as ocp

from sacformer_jax import processes, stored
from sacformer_jax.config import Config
from sacformer_jax.cores import xla_threads
from sacformer_jax.run_folder import Restored, RunConfigFile, RunFolder
from sacformer_jax.saved_policies import kept_best, prune_best, restore_policy, save_best
from sacformer_jax.stored import (
    FORMAT,
    BestSoFar,
    CheckpointError,
    Progress,
)
from sacformer_jax.types import PolicyState, TrainState

__all__ = [
    "FORMAT",
    "KEEP",
    "BestSoFar",
    "CheckpointError",
    "CheckpointWriter",
    "Progress",
    "Restored",
    "RunConfigFile",
    "RunFolder",
    "kept_best",
    "prune_best",
    "restore_policy",
    "save_best",
]

Tree = TypeVar("Tree")

KEEP = 2
"""Newest full checkpoints kept, so that a damaged one leaves another."""


class CheckpointWriter:
    """Writes the checkpoints of a run in the background, one at a time.

    A context manager: leaving it waits for the last one. With several processes all have to do
    the same with it. Only the process that holds the run's lock may use it.

    Args:
      folder: of the run.
      config: kept with each checkpoint, to tell when ``config.json`` was changed.
      block_axes: of the digests of the state's leaves, a PyTree of ints like it: at least the axes
        that are split over processes; None: 0 of all.
      devices: over how many what is split, by name, to tell when it is split otherwise; None: it is
        not told.
    """

    def __init__(
        self,
        folder: RunFolder,
        config: Config,
        block_axes: Any = None,
        devices: dict[str, int] | None = None,
    ):
        self._folder, self._config, self._block_axes = folder, config, block_axes
        self._devices = devices
        self._manager: ocp.CheckpointManager | None = None
        self._writing: int | None = None
        self._silence = contextlib.ExitStack()

    def __enter__(self) -> CheckpointWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            self.wait()
        except CheckpointError as failure:
            if error is None:
                raise
            error.add_note(str(failure))  # that one came first
        finally:
            self._close()
            self._silence.close()

    def save(
        self, state: TrainState, policy: PolicyState, progress: Progress
    ) -> CheckpointError | None:
        """Saves a checkpoint under ``progress.env_steps``, where there is none yet.

        Returns when it has a copy of the arrays, so that they may be donated at once.

        Args:
          state: of all members.
          policy: of all members, leaves ``[S, ...]``.
          progress: of the host loop.

        Returns:
          what became of the save before this one, if it failed since.

        Raises:
          CheckpointError: this one fails already. Older checkpoints are as they were, and the next
            call tries again.
        """
        failed_before: CheckpointError | None = None
        try:
            self.wait()
        except CheckpointError as error:
            failed_before = error
        step = progress.env_steps
        if processes.of_the_first(step if step in self._folder.steps() else None) is not None:
            return failed_before
        state, policy = _snapshot(state), _snapshot(policy)
        each = jax.tree.map(lambda _: 1, policy)
        metadata = stored.sealed(
            {
                "config": self._config.to_dict(),
                "progress": dataclasses.asdict(progress),
                "host_threads": xla_threads(),
                "devices": self._devices,
                "items": {
                    "state": stored.described(state, self._block_axes),
                    "policy": stored.described(policy, each),
                },
            }
        )
        self._writing = step
        self._silence.enter_context(stored.Silence())  # what fails may do so at any time from now
        try:
            if self._manager is None:
                self._manager = self._opened()
            self._check_writable()
            self._manager.save(
                step,
                args=ocp.args.Composite(
                    state=ocp.args.StandardSave(stored.without_empty(state)),
                    policy=ocp.args.StandardSave(policy),
                    metadata=ocp.args.JsonSave(metadata),
                ),
                force=True,
            )
        except Exception as error:  # Orbax raises many kinds
            raise self._failed(error) from error
        return failed_before

    def wait(self) -> None:
        """Returns when the checkpoint given last is on disk.

        Raises:
          CheckpointError: it could not be written.
        """
        if self._writing is None or self._manager is None:
            return
        try:
            self._manager.wait_until_finished()
            if processes.is_first() and self._writing not in self._folder.steps():
                raise OSError(f"{self._folder.checkpoints_path} lacks it")
        except Exception as error:
            raise self._failed(error) from error
        self._writing = None
        self._silence.close()
        self._prune()

    def _opened(self) -> ocp.CheckpointManager:
        path = self._folder.checkpoints_path
        if processes.is_first():
            path.mkdir(parents=True, exist_ok=True)
            stored.remove_unfinished(path)  # of a process that was killed
        processes.all_here()
        # Folders are made before Orbax returns: made beside it, they are waited for by signals that
        # a policy saved at the same time (save_best) takes for its own; and where a folder cannot
        # be made, they are waited for 20 minutes.
        beside = ocp.AsyncOptions(create_directories_asynchronously=False)
        return ocp.CheckpointManager(
            path,
            options=ocp.CheckpointManagerOptions(
                max_to_keep=KEEP, create=False, async_options=beside
            ),
        )

    def _check_writable(self) -> None:
        """Raises on all processes where the first cannot make a folder: the others would wait."""
        problem: OSError | None = None
        probe = self._folder.checkpoints_path / f"probe{stored.UNFINISHED}"
        try:
            if processes.is_first():
                probe.mkdir(exist_ok=True)
                probe.rmdir()
        except OSError as error:
            problem = error
        if processes.any_process(problem is not None):
            raise problem or OSError("the first process cannot write")

    def _close(self) -> None:
        """Lets go of the manager; after a failure it knows no longer what is on disk."""
        manager, self._manager, self._writing = self._manager, None, None
        if manager is not None:
            try:
                manager.close()
            except Exception as error:  # of a save that failed and has been reported
                logging.getLogger(__name__).debug("closing: %s", error)

    def _failed(self, error: Exception) -> CheckpointError:
        step = self._writing
        self._close()
        if processes.is_first():
            stored.remove_failed(self._folder.checkpoints_path)  # frees the disk
        self._silence.__exit__(type(error), error, error.__traceback__)
        return CheckpointError(
            f"checkpoint {self._folder.checkpoints_path / str(step)} could not be saved "
            f"({stored.one_line(error)}); the ones before it are as they were"
        )

    def _prune(self) -> None:
        """Deletes best policies that no kept checkpoint refers to."""
        if not processes.is_first():
            return
        newest = self._folder.latest_step()
        for member, keep in zip(
            self._folder.read_config().members, kept_best(self._folder), strict=True
        ):
            # Those after the newest checkpoint will be referred to by the next.
            steps = stored.steps_in(self._folder.member_path(member.name) / "best")
            later = {step for step in steps if newest is None or step > newest}
            prune_best(self._folder, member.name, keep | later)


def _snapshot(tree: Tree) -> Tree:
    """Arrays that stay what they are when the ones given are donated."""
    # Other devices' arrays are copied to the host before Orbax returns; those of the CPU are not.
    if jax.default_backend() != "cpu":
        return tree
    return jax.tree.map(jnp.copy, tree)

"""Writing checkpoints in the background."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
from collections.abc import Iterator
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
            self._wait(agree=error is None)  # what this process fails at, others may not know of
        except CheckpointError as failure:
            if error is None:
                raise
            error.add_note(str(failure))  # that one came first
        finally:
            self._close()
            self._silence.close()

    def save(self, state: TrainState, policy: PolicyState, progress: Progress) -> None:
        """Saves a checkpoint under ``progress.env_steps``, where there is none yet.

        Returns when it has a copy of the arrays, so that they may be donated at once.

        Args:
          state: of all members.
          policy: of all members, leaves ``[S, ...]``.
          progress: of the host loop.

        Raises:
          CheckpointError: this one fails already; or the one before has failed since, unless
            :meth:`wait` has told so, and this one was not tried. Older checkpoints are as they
            were, and the next call tries again.
        """
        self.wait()
        step = progress.env_steps
        if processes.of_the_first(step if step in self._folder.steps() else None) is not None:
            return
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
        arguments = ocp.args.Composite(
            state=ocp.args.StandardSave(stored.without_empty(state)),
            policy=ocp.args.StandardSave(policy),
            metadata=ocp.args.JsonSave(metadata),
        )
        with self._all_or_none():
            self._check_writable()
        with self._all_or_none():
            self._opened().save(step, args=arguments, force=True)

    def wait(self) -> None:
        """Returns when the checkpoint given last is on disk.

        Raises:
          CheckpointError: it could not be written.
        """
        self._wait()

    def _wait(self, agree: bool = True) -> None:
        if self._writing is None or self._manager is None:
            return
        with self._all_or_none(agree):
            self._manager.wait_until_finished()
            if processes.is_first() and self._writing not in self._folder.steps():
                raise OSError(f"{self._folder.checkpoints_path} lacks it")
        self._writing = None
        self._silence.close()
        self._prune()

    @contextlib.contextmanager
    def _all_or_none(self, agree: bool = True) -> Iterator[None]:
        """What fails inside in one process fails in all: each goes on as the others do.

        Args:
          agree: ask the others, which have to be here, too.

        Raises:
          CheckpointError: it has failed; what there was of the checkpoint is gone.
        """
        problem: Exception | None = None
        try:
            yield
        except Exception as error:  # Orbax raises many kinds
            problem = error
        failed = problem is not None
        if processes.any_process(failed) if agree else failed:
            problem = problem or OSError("another process could not write it")
            raise self._failed(problem) from problem

    def _check_writable(self) -> None:
        """Of the first process, before all of them would wait for what it cannot make."""
        if not processes.is_first():
            return
        path = self._folder.checkpoints_path
        if self._manager is None:
            path.mkdir(parents=True, exist_ok=True)
            stored.remove_unfinished(path)  # of a process that was killed
        probe = path / f"probe{stored.UNFINISHED}"
        probe.mkdir(exist_ok=True)
        probe.rmdir()

    def _opened(self) -> ocp.CheckpointManager:
        if self._manager is None:
            # Folders are made before Orbax returns: made beside it, they are waited for by signals
            # that a policy saved at the same time (save_best) takes for its own; and where a folder
            # cannot be made, they are waited for 20 minutes.
            beside = ocp.AsyncOptions(create_directories_asynchronously=False)
            options = ocp.CheckpointManagerOptions(
                max_to_keep=KEEP, create=False, async_options=beside
            )
            self._manager = ocp.CheckpointManager(self._folder.checkpoints_path, options=options)
        return self._manager

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

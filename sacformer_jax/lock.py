"""One process at a time trains in a run folder."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import socket
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import jax

from sacformer_jax.stored import CheckpointError

_NO_LOCKS = {errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP}


@contextlib.contextmanager
def locked(path: str | Path) -> Iterator[None]:
    """Holds the lock of a run folder, which is made where it is missing.

    The operating system releases it when the process ends, however it ends. Of several processes
    that train together the first holds it for all.

    Args:
      path: the run's folder.

    Raises:
      CheckpointError: another process holds it, or the folder cannot be written.
    """
    if jax.process_index() != 0:
        yield
        return
    folder = Path(path).expanduser().absolute()
    with contextlib.ExitStack() as stack:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            # Not emptied on opening: it may name the process that holds it.
            file = stack.enter_context(open(folder / "lock", "a+"))
        except OSError as error:
            raise CheckpointError(
                f"run {str(folder)!r} cannot be written ({error.strerror}): "
                "choose a folder that can"
            ) from error
        _take(file, folder)
        yield


def _take(file: IO[str], folder: Path) -> None:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise CheckpointError(
            f"run {str(folder)!r} is being trained by {_holder(file)}: wait for it or stop it, or "
            "choose another folder"
        ) from error
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        warnings.warn(
            f"{folder}: this file system has no locks, so nothing stops a second process from "
            "training in the same folder",
            stacklevel=3,
        )
    name = json.dumps({"pid": os.getpid(), "host": socket.gethostname()}) + "\n"
    with contextlib.suppress(OSError):  # a full disk: the lock holds all the same
        os.ftruncate(file.fileno(), 0)
        os.write(file.fileno(), name.encode())


def _holder(file: IO[str]) -> str:
    """Who wrote its name into the lock."""
    file.seek(0)
    try:
        values = json.load(file)
        return f"process {values['pid']} on {values['host']}"
    except (ValueError, KeyError, TypeError):
        return "another process"

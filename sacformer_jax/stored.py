"""One checkpoint on disk: what its metadata says, and reading its arrays so that no damage passes.

A checkpoint is a folder with arrays (Orbax) and ``metadata``, JSON that tells each leaf's type,
shape and digest, and has a digest of its own: it can be believed, or it is damaged.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import errno
import gc
import hashlib
import inspect
import json
import logging
import math
import os
import re
import shutil
import sys
import threading
import time
import traceback
import warnings
from pathlib import Path
from types import TracebackType
from typing import Any

import jax
import jax.numpy as jnp
import orbax.checkpoint as ocp
import tensorstore

from sacformer_jax import processes
from sacformer_jax.digests import leaf_digests
from sacformer_jax.version import __version__

FORMAT = 2
"""Version of a run folder's layout; raised when an older program could not read it."""
UNFINISHED = ".orbax-checkpoint-tmp"
"""Ending of the names of folders that are being written."""

logging.getLogger("absl").setLevel(logging.CRITICAL)  # Orbax's errors are raised as well


class CheckpointError(Exception):
    """A run folder or checkpoint that cannot be used; the message says what would help."""


class DamagedError(Exception):
    """What is wrong with a checkpoint that is damaged: the one before it may be good."""


@dataclasses.dataclass(frozen=True)
class BestSoFar:
    """The best evaluation of a member.

    Attributes:
      env_steps: when it was; its policy is kept under this step.
      return_mean: mean return of its episodes.
      bad_physics: how many of them were cut off because the physics broke down.
    """

    env_steps: int
    return_mean: float
    bad_physics: int = 0


@dataclasses.dataclass(frozen=True)
class Progress:
    """What the host loop needs besides the train state, kept in every checkpoint.

    Attributes:
      env_steps: environment steps so far, of each member.
      best: each member's best evaluation so far, None before any.
      metrics_bytes: length of each member's ``metrics.jsonl`` at that moment.
    """

    env_steps: int
    best: tuple[BestSoFar | None, ...]
    metrics_bytes: tuple[int, ...]

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Progress:
        """Inverse of ``dataclasses.asdict``, also after JSON."""
        best = tuple(None if one is None else BestSoFar(**one) for one in values["best"])
        return cls(values["env_steps"], best, tuple(values["metrics_bytes"]))


def steps_in(folder: Path) -> list[int]:
    """The steps saved in a folder, oldest first; those being written are none yet."""
    if not folder.is_dir():
        return []
    return sorted(int(path.name) for path in folder.iterdir() if path.name.isdecimal())


def remove_unfinished(folder: Path) -> None:
    """Removes what was begun to be written in a folder and never finished."""
    for unfinished in folder.glob(f"*{UNFINISHED}*"):
        shutil.rmtree(unfinished, ignore_errors=True)


def remove_failed(folder: Path) -> None:
    """:func:`remove_unfinished` after a save that failed.

    Orbax raises the first error while other parts are still being written; they would come back.

    Args:
      folder: where it was saved.
    """
    until = time.monotonic() + 60.0
    for thread in threading.enumerate():
        if type(thread).__module__.startswith("orbax."):
            threading.Thread.join(thread, timeout=max(0.0, until - time.monotonic()))
    for _ in range(100):  # TensorStore's own threads have no handle
        remove_unfinished(folder)
        time.sleep(0.05)
        if not any(folder.glob(f"*{UNFINISHED}*")):
            break


_ORBAX = f"{os.sep}orbax{os.sep}"
"""In the paths of Orbax's modules."""


class Silence:
    """Drops what the abandoned tasks of a failed read or write print; a context manager.

    At the first error Orbax closes its event loop, while other reads or writes are under way. Each
    of them complains then, when TensorStore is done with it or when its coroutine is collected.
    Everything else is passed on. Leaving with an error waits until nothing can complain any more.
    """

    def __enter__(self) -> Silence:
        self._others = sys.unraisablehook
        sys.unraisablehook = self._hook
        logging.getLogger("asyncio").addFilter(_not_of_orbax)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        _: TracebackType | None,
    ) -> None:
        if isinstance(error, Exception):
            _settle(error)
        logging.getLogger("asyncio").removeFilter(_not_of_orbax)
        sys.unraisablehook = self._others

    def _hook(self, raised: sys.UnraisableHookArgs) -> None:
        if not _of_orbax(raised):
            self._others(raised)


def _of_orbax(raised: sys.UnraisableHookArgs) -> bool:
    if inspect.iscoroutine(raised.object):
        return _ORBAX in raised.object.cr_code.co_filename
    # TensorStore's threads call this method, and no other Python around it.
    first = raised.exc_traceback and raised.exc_traceback.tb_frame.f_code.co_name
    return first == "call_soon_threadsafe" and str(raised.exc_value) == "Event loop is closed"


def _not_of_orbax(record: logging.LogRecord) -> bool:
    """Whether to pass on what asyncio logs: not of futures whose results nobody asked for."""
    message = record.getMessage()
    if "was never retrieved" not in message and "was destroyed but it is pending" not in message:
        return True
    error = record.exc_info[1] if record.exc_info else None
    told = message + "".join(traceback.format_exception(error)) if error else message
    # TensorStore's own errors have a status and no traceback.
    status = error and not error.__traceback__ and re.match("[A-Z_]+: ", str(error))
    return not (_ORBAX in told or status)


def _settle(error: BaseException) -> None:
    """Waits until what was begun beside a failed read or write is over, and collects its tasks."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "coroutine .* was never awaited", RuntimeWarning)
        link: BaseException | None = error
        while link is not None:
            _clear(link)
            link = link.__cause__ or link.__context__
        start = time.monotonic()
        while True:
            gc.collect()
            left = [thing for thing in gc.get_objects() if _may_complain(thing)]
            busy = any(type(thing) is tensorstore.Future and not thing.done() for thing in left)
            # Where an error in flight holds on to some, they are no longer waited for.
            if not left or time.monotonic() - start > (20.0 if busy else 0.5):
                break
            del left
            time.sleep(0.02)


def _clear(error: BaseException) -> None:
    """Lets go of what the frames of Orbax hold, which are over: its tasks."""
    for frame, _ in traceback.walk_tb(error.__traceback__):
        if frame.f_globals.get("__name__", "").partition(".")[0] in ("orbax", "asyncio"):
            with contextlib.suppress(RuntimeError):  # it is not over
                frame.clear()


def _may_complain(thing: Any) -> bool:
    """Whether it is of what was abandoned: TensorStore's futures live until they called back."""
    if type(thing) is asyncio.Task:
        return not thing.done() and thing.get_loop().is_closed()
    return type(thing) is tensorstore.Future


# --- metadata ------------------------------------------------------------------------------------


def leaf_table(tree: Any, block_axes: Any = None) -> dict[str, dict[str, Any]]:
    """Type, shape and block axes of each leaf, by its path; ``tree`` may hold shapes only."""
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    axes = [0] * len(leaves) if block_axes is None else jax.tree.leaves(block_axes)
    return {
        jax.tree_util.keystr(path): {
            "dtype": str(leaf.dtype),
            "shape": list(leaf.shape),
            "block_axes": num_axes,
        }
        for (path, leaf), num_axes in zip(leaves, axes, strict=True)
    }


def described(tree: Any, block_axes: Any = None) -> dict[str, dict[str, Any]]:
    """:func:`leaf_table` of arrays, and their digests."""
    table, digests = leaf_table(tree, block_axes), leaf_digests(tree, block_axes)
    return {path: {**entry, "digest": digests[path]} for path, entry in table.items()}


def sealed(contents: dict[str, Any]) -> dict[str, Any]:
    """Metadata: the contents, format and version, and a digest over all of it."""
    contents = {"format": FORMAT, "version": __version__, **contents}
    return {**contents, "digest": _seal(contents)}


def _seal(contents: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(contents, sort_keys=True).encode()).hexdigest()


def read_metadata(step_path: Path) -> dict[str, Any]:
    """The metadata of a checkpoint.

    Raises:
      DamagedError: it cannot be read or is not what was written.
      CheckpointError: another version wrote it.
    """
    try:
        metadata = json.loads((step_path / "metadata" / "metadata").read_text())
        digest = metadata.pop("digest")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        if _says_nothing(error):
            reason = one_line(error)
            raise CheckpointError(f"checkpoint {step_path} cannot be read ({reason})") from error
        raise DamagedError("its metadata cannot be read") from error
    if _seal(metadata) != digest:
        raise DamagedError("the digest of its metadata differs")
    if metadata["format"] != FORMAT:
        raise CheckpointError(
            f"checkpoint {step_path} has format {metadata['format']}, this version reads format "
            f"{FORMAT}: use sacformer-jax {metadata.get('version')}"
        )
    return metadata


# --- arrays --------------------------------------------------------------------------------------


def without_empty(tree: Any) -> Any:
    """The tree with None for arrays of no elements, which Orbax refuses to save.

    A physics state may well have some: contacts of a model without any.
    """
    return jax.tree.map(lambda leaf: leaf if math.prod(leaf.shape) else None, tree)


def _with_empty(tree: Any, abstract: Any, shardings: Any) -> Any:
    """Inverse of :func:`without_empty`, for a tree like ``abstract``."""
    found = iter(jax.tree.leaves(tree))
    leaves = [
        next(found)
        if math.prod(leaf.shape)
        else jax.device_put(jnp.zeros(leaf.shape, leaf.dtype), sharding)
        for leaf, sharding in zip(
            jax.tree.leaves(abstract), jax.tree.leaves(shardings), strict=True
        )
    ]
    return jax.tree.unflatten(jax.tree.structure(abstract), leaves)


def read_item(
    step_path: Path, item: str, metadata: dict[str, Any], abstract: Any, shardings: Any = None
) -> Any:
    """Reads the arrays of an item; their digests are still to be checked (:func:`check_digests`).

    Args:
      step_path: folder of the checkpoint.
      item: which of its parts.
      metadata: as :func:`read_metadata` gave it.
      abstract: shapes of what is expected.
      shardings: how to lay it on devices, a PyTree like ``abstract``; None: on the first.

    Raises:
      DamagedError: it cannot be read.
      CheckpointError: it holds something else, or this process may not read it.
    """
    _check_leaves(step_path, metadata, leaf_table(abstract), metadata["items"][item])
    if shardings is None:
        device = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
        shardings = jax.tree.map(lambda _: device, abstract)
    target = jax.tree.map(
        lambda leaf, sharding: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding),
        abstract,
        shardings,
    )
    # Every process reads for itself what it needs: one that fails must not leave others waiting.
    handler = ocp.StandardCheckpointHandler(multiprocessing_options=processes.alone())
    try:
        with Silence():
            args = ocp.args.StandardRestore(without_empty(target))
            restored = handler.restore(step_path / item, args=args)
            return _with_empty(restored, abstract, shardings)
    except Exception as error:  # Orbax raises many kinds for damaged files
        reason = one_line(error)
        if _says_nothing(error):
            raise CheckpointError(f"checkpoint {step_path} cannot be read ({reason})") from error
        raise DamagedError(f"its {item} cannot be read: {reason}") from error


def check_digests(item: str, metadata: dict[str, Any], tree: Any) -> None:
    """Compares arrays with what the metadata says; all processes have to call it.

    Raises:
      DamagedError: a leaf is not what was written.
    """
    table = metadata["items"][item]
    axes = [table[path]["block_axes"] for path in leaf_table(tree)]
    digests = leaf_digests(tree, jax.tree.unflatten(jax.tree.structure(tree), axes))
    for path, digest in digests.items():
        if digest != table[path]["digest"]:
            raise DamagedError(f"the digest of {item}{path} differs")


def _check_leaves(
    step_path: Path, metadata: dict[str, Any], wanted: dict[str, Any], found: dict[str, Any]
) -> None:
    def text(entry: dict[str, Any] | None) -> str:
        return f"{entry['dtype']}{entry['shape']}" if entry else "no such array"

    for path in [*wanted, *(path for path in found if path not in wanted)]:
        expected, stored = text(wanted.get(path)), text(found.get(path))
        if expected != stored:
            raise CheckpointError(
                f"checkpoint {step_path} does not fit: for {path} it has {stored}, the program "
                f"{expected}; use what wrote it, sacformer-jax {metadata['version']} with the "
                "configuration of the run"
            )


def one_line(error: BaseException) -> str:
    """What an error says, in one line that is not too long."""
    error = _root(error)
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    # TensorStore's messages go on for pages; what the system said is inside.
    if (number := _system_error(error)) is not None:
        return os.strerror(number)
    lines = re.split(r"[.\s]*See full TensorStore details", str(error))[0].strip().splitlines()
    return lines[0][:200] if lines else type(error).__name__


_AWAY = {errno.ESTALE, errno.ETIMEDOUT, errno.ENOTCONN, errno.EHOSTDOWN}  # a network's disk
_NOT_DAMAGE = {errno.EACCES, errno.EPERM, errno.EMFILE, errno.ENFILE, *_AWAY}


def _says_nothing(error: BaseException) -> bool:
    """Whether an error says nothing about what is in a file: another time it may be read."""
    cause = _root(error)
    kinds = (MemoryError, PermissionError, jax.errors.JaxRuntimeError)
    statuses = "PERMISSION_DENIED|RESOURCE_EXHAUSTED"
    return (
        isinstance(cause, kinds)
        or _system_error(cause) in _NOT_DAMAGE
        or re.search(statuses, str(cause)) is not None
    )


def _system_error(error: BaseException) -> int | None:
    """The operating system's number of an error, which TensorStore has in its text."""
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno
    found = re.search(r"(?:OS error |os_error_code=')(\d+)", str(error))
    return int(found.group(1)) if found else None


def _root(error: BaseException) -> BaseException:
    return error if error.__cause__ is None else _root(error.__cause__)

"""One checkpoint on disk: what its metadata says, and reading its arrays so that no damage passes.

A checkpoint is a folder with arrays (Orbax) and ``metadata``, JSON that tells each leaf's type,
shape and digest, and ends with a digest of its own: what the metadata says can be believed, or
it is damaged.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import re
import shutil
import threading
import time
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp

from sacformer_jax import processes
from sacformer_jax.digests import leaf_digests
from sacformer_jax.version import __version__

FORMAT = 2
"""Version of a run folder's layout; raised when an older program could not read it."""
UNFINISHED = ".orbax-checkpoint-tmp"
"""Ending of the names of folders that are being written."""


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
    """

    env_steps: int
    return_mean: float


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
    """
    for thread in threading.enumerate():
        if type(thread).__module__.startswith("orbax."):
            threading.Thread.join(thread, timeout=60.0)
    for _ in range(100):  # TensorStore's own threads have no handle
        remove_unfinished(folder)
        time.sleep(0.05)
        if not any(folder.glob(f"*{UNFINISHED}*")):
            break


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
    except PermissionError as error:
        raise CheckpointError(f"checkpoint {step_path} cannot be read ({one_line(error)})") from (
            error
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
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
        return handler.restore(step_path / item, args=ocp.args.StandardRestore(target))
    except Exception as error:  # Orbax raises many kinds for damaged files
        reason = one_line(error)
        not_the_files = isinstance(
            error, (MemoryError, PermissionError, jax.errors.JaxRuntimeError)
        )
        if not_the_files or re.search("PERMISSION_DENIED|RESOURCE_EXHAUSTED", str(error)):
            raise CheckpointError(f"checkpoint {step_path} cannot be read ({reason})") from error
        raise DamagedError(f"its {item} cannot be read: {reason}") from error


def check_digests(item: str, metadata: dict[str, Any], tree: Any) -> None:
    """Compares arrays with what the metadata says; all processes have to call it.

    Raises:
      DamagedError: a leaf is not what was written.
    """
    table = metadata["items"][item]
    structure = jax.tree.structure(tree)
    axes = [table[path]["block_axes"] for path in leaf_table(tree)]
    digests = leaf_digests(tree, jax.tree.unflatten(structure, axes))
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
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    text = str(error) or type(error).__name__
    # TensorStore's messages go on for pages; what the system said is inside.
    if system := re.search(r"(?:OS error |os_error_code=')(\d+)", text):
        return os.strerror(int(system.group(1)))
    return text.splitlines()[0][:200]

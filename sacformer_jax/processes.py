"""What the processes of one run (``jax.distributed``) have to agree on; with one process, nothing.

Every process runs the same host loop on the same numbers; the first one writes.
"""

from __future__ import annotations

from typing import Any, TypeVar

import jax
import numpy as np
import orbax.checkpoint as ocp
from jax.experimental import multihost_utils

Tree = TypeVar("Tree")


def is_first() -> bool:
    """Whether this process is the one that changes what all share."""
    return jax.process_index() == 0


def all_here() -> None:
    """Waits until every process is here."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices("run folder")


def of_the_first(step: int | None) -> int | None:
    """What the first process says: others may see its changes of the folder late."""
    if jax.process_count() == 1:
        return step
    said = int(multihost_utils.broadcast_one_to_all(np.int32(-1 if step is None else step)))
    return None if said < 0 else said


def most(number: int) -> int:
    """The largest of what the processes say."""
    if jax.process_count() == 1:
        return number
    return int(np.max(multihost_utils.process_allgather(np.int32(number))))


def any_process(flag: bool) -> bool:
    """Whether it is true in any of them."""
    return most(int(flag)) > 0


def gathered(tree: Tree) -> Tree:
    """The whole of every array as NumPy, in every process."""
    if jax.process_count() == 1:
        return jax.device_get(tree)
    everything: Any = multihost_utils.process_allgather(tree, tiled=True)
    return everything


def alone() -> ocp.options.MultiprocessingOptions:
    """Orbax's options for work that this process does by itself."""
    process = jax.process_index()
    return ocp.options.MultiprocessingOptions(
        primary_host=process,
        active_processes={process},
        barrier_sync_key_prefix=f"process{process}",
    )

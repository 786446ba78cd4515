"""Policies in a run folder: the best ones, and those that checkpoints hold."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from sacformer_jax import processes, stored
from sacformer_jax.agents.core import Agent
from sacformer_jax.run_folder import RunFolder
from sacformer_jax.stored import BestSoFar, CheckpointError, DamagedError, Progress
from sacformer_jax.train import policy_state
from sacformer_jax.types import Hyperparameters, PolicyState


def save_best(folder: RunFolder, name: str, policy: PolicyState, best: BestSoFar) -> None:
    """Writes the policy of a member's best evaluation so far; returns when it is on disk.

    Those before it stay (see :func:`prune_best`); one of the same step is replaced. Of several
    processes the first writes.

    Args:
      folder: of the run.
      name: of the member.
      policy: the member's, without an axis of members; this process has to hold all of it.
      best: the evaluation.

    Raises:
      CheckpointError: it cannot be written.
    """
    if not processes.is_first():
        return
    path = folder.member_path(name) / "best"
    policy = jax.tree.map(np.asarray, policy)
    metadata = stored.sealed(
        {**dataclasses.asdict(best), "items": {"policy": stored.described(policy)}}
    )
    final, new = path / str(best.env_steps), path / f"{best.env_steps}{stored.UNFINISHED}"
    # By hand, since a checkpointer of one process only would count its saves apart from the others
    # and the checkpoints that all write together would wait for each other's signals for ever.
    handler = ocp.StandardCheckpointHandler(multiprocessing_options=processes.alone())
    try:
        stored.remove_unfinished(path)
        (new / "metadata").mkdir(parents=True)
        handler.save(new / "policy", args=ocp.args.StandardSave(policy))
        handler.finalize(new / "policy")
        (new / "metadata" / "metadata").write_text(json.dumps(metadata))
        if final.exists():
            shutil.rmtree(final)
        os.rename(new, final)
    except Exception as error:  # Orbax raises many kinds
        stored.remove_failed(path)
        raise CheckpointError(
            f"best policy {final} could not be saved "
            f"({stored.one_line(error)}); the ones before it are as they were"
        ) from error


def prune_best(folder: RunFolder, name: str, keep: set[int]) -> None:
    """Deletes a member's best policies of all steps but ``keep``; the first process does."""
    if processes.is_first():
        path = folder.member_path(name) / "best"
        for step in set(stored.steps_in(path)) - keep:
            shutil.rmtree(path / str(step), ignore_errors=True)


def kept_best(folder: RunFolder) -> tuple[set[int], ...]:
    """For each member the steps of best policies that the kept checkpoints refer to."""
    kept: tuple[set[int], ...] = tuple(set() for _ in folder.read_config().members)
    for step in folder.steps():
        try:
            metadata = stored.read_metadata(folder.checkpoints_path / str(step))
        except (DamagedError, CheckpointError):
            continue  # it cannot be restored, so it refers to nothing
        for steps, best in zip(kept, Progress.from_dict(metadata["progress"]).best, strict=True):
            if best is not None:
                steps.add(best.env_steps)
    return kept


def restore_policy(folder: RunFolder, agent: Agent, which: str, member: int) -> PolicyState:
    """Reads the ``"best"`` or ``"latest"`` policy of a member: the newest one that is good.

    Args:
      folder: of the run.
      agent: the algorithm.
      which: the one of the highest evaluation return, or the one of the newest checkpoint.
      member: which of the run's members, by its place.

    Raises:
      CheckpointError: there is none, or all are damaged.
    """
    members = folder.read_config().members
    if which == "best":
        path, when = folder.member_path(members[member].name) / "best", "evaluation"
        abstract, taken = _abstract_policy(agent), lambda policy: policy
    elif which == "latest":
        path, when = folder.checkpoints_path, "checkpoint"
        abstract = _with_members(_abstract_policy(agent), len(members))
        taken = _member_of(member)
    else:
        raise CheckpointError(f"which={which!r}: must be best or latest")
    damaged = []
    for step in reversed(stored.steps_in(path)):
        try:
            metadata = stored.read_metadata(path / str(step))
            policy = stored.read_item(path / str(step), "policy", metadata, abstract)
            stored.check_digests("policy", metadata, policy)
        except DamagedError as error:
            damaged.append(f"{path / str(step)} is damaged ({error})")
            continue
        return taken(policy)
    if damaged:
        other = "latest" if which == "best" else "best"
        raise CheckpointError(
            f"run {str(folder.path)!r} has no {which} policy that is good: "
            f"{'; '.join(damaged)}; use the {other} one"
        )
    raise CheckpointError(
        f"run {str(folder.path)!r} has no {which} policy yet: let it train up to its first {when}"
    )


def _member_of(index: int) -> Callable[[PolicyState], PolicyState]:
    return lambda policy: jax.tree.map(lambda leaf: leaf[index], policy)


def _with_members(abstract: PolicyState, num_members: int) -> PolicyState:
    return jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct((num_members, *leaf.shape), leaf.dtype), abstract
    )


def _abstract_policy(agent: Agent) -> PolicyState:
    learner = jax.eval_shape(agent.init, jax.random.key(0))
    number: Any = jax.ShapeDtypeStruct((), np.float32)
    fields = {field.name: number for field in dataclasses.fields(Hyperparameters)}
    return policy_state(learner, Hyperparameters(**fields))

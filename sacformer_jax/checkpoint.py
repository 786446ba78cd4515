"""Run folders: configuration, Orbax checkpoints of the whole train state, exported policies.

A run folder holds::

    config.json        configuration, source of each value, environment facts, package version
    checkpoints/STEP/  Orbax: "state" (everything), "policy", "metadata"
    best/STEP/         Orbax: "policy", "metadata" of the best evaluation so far
    metrics.jsonl      see sacformer_jax.logging
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from sacformer_jax.agents.core import Agent
from sacformer_jax.config import Config
from sacformer_jax.cores import usable_cores
from sacformer_jax.envs.core import EnvSpec
from sacformer_jax.train import policy_state
from sacformer_jax.types import Hyperparameters, PolicyState, TrainState
from sacformer_jax.version import __version__

FORMAT = 1
"""Version of the layout above; raised when an older program could not read it."""
KEEP = 2
"""Newest full checkpoints kept, so that a damaged one leaves another."""

logging.getLogger("absl").setLevel(logging.ERROR)


class CheckpointError(Exception):
    """A run folder or checkpoint that cannot be used; the message says what would help."""


@dataclasses.dataclass(frozen=True)
class RunConfigFile:
    """Contents of ``config.json`` that decide the run: configuration and source of each value."""

    config: Config
    sources: dict[str, str]


@dataclasses.dataclass(frozen=True)
class Progress:
    """What the host loop needs besides the train state, kept in every checkpoint.

    Attributes:
      env_steps: environment steps so far.
      metrics_bytes: length of ``metrics.jsonl`` at that moment.
      best_return: highest evaluation return so far, None before any.
    """

    env_steps: int
    metrics_bytes: int
    best_return: float | None


@dataclasses.dataclass(frozen=True)
class Restored:
    """A checkpoint read back and verified.

    Attributes:
      state: the whole train state.
      progress: of the host loop.
      host_threads: CPU threads of the process that wrote it; sums are split over them, so only
        the same number continues bit for bit.
    """

    state: TrainState
    progress: Progress
    host_threads: int


def digest(tree: Any) -> str:
    """SHA-256 over every leaf's path, type, shape and bytes: equal exactly when the trees are."""
    sha = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            leaf = jax.random.key_data(leaf)
        array = np.asarray(leaf)
        sha.update(f"{jax.tree_util.keystr(path)}|{array.dtype}|{array.shape}|".encode())
        sha.update(array.tobytes())
    return sha.hexdigest()


def num_bytes(tree: Any) -> int:
    """Bytes of all leaves (arrays or shapes; PRNG keys not counted)."""
    leaves = [
        x for x in jax.tree.leaves(tree) if not jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)
    ]
    return sum(int(np.prod(leaf.shape)) * leaf.dtype.itemsize for leaf in leaves)


class RunFolder:
    """A run's folder.

    Args:
      path: the folder, which may not exist yet.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path).expanduser().absolute()

    @property
    def metrics_path(self) -> Path:
        return self.path / "metrics.jsonl"

    @property
    def timings_path(self) -> Path:
        return self.path / "timings.jsonl"

    # --- the folder --------------------------------------------------------------------------

    def create(self, config: Config, sources: dict[str, str], spec: EnvSpec) -> None:
        """Makes the folder and writes ``config.json``.

        Raises:
          CheckpointError: the folder holds a run with a checkpoint already (one that was stopped
            before its first may be started again), or cannot be written.
        """
        if self.latest_step() is not None:
            raise CheckpointError(
                f"run_dir={str(self.path)!r} holds a run already: "
                f"continue it with 'sacformer resume {self.path}' or choose another folder"
            )
        contents = {
            "format": FORMAT,
            "version": __version__,
            "config": config.to_dict(),
            "sources": sources,
            "env_spec": dataclasses.asdict(spec),
        }
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            (self.path / "config.json").write_text(json.dumps(contents, indent=2) + "\n")
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
            if made_with == FORMAT and not {"config", "sources", "env_spec"} <= set(contents):
                raise KeyError("config, sources or env_spec")
        except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError, OSError) as error:
            raise CheckpointError(f"{path} is damaged: restore it from a copy") from error
        if made_with != FORMAT:
            raise CheckpointError(
                f"{path} has format {made_with}, this version reads format {FORMAT}: "
                f"use sacformer-jax {contents.get('version')}"
            )
        return contents

    def read_config(self) -> RunConfigFile:
        """The run's configuration."""
        contents = self._config_json()
        config = Config.from_dict(contents["config"])
        # A run of an earlier version knows no source of later fields: they are at their defaults.
        sources = dict.fromkeys(config.flat(), "default")
        return RunConfigFile(config, {**sources, **contents["sources"]})

    def read_spec(self) -> EnvSpec:
        """Facts of the run's environment, without making it."""
        values = self._config_json()["env_spec"]
        for name in ("action_low", "action_high"):
            values[name] = tuple(values[name])
        return EnvSpec(**values)

    # --- checkpoints -------------------------------------------------------------------------

    def save(self, state: TrainState, policy: PolicyState, progress: Progress) -> None:
        """Writes a checkpoint; returns when it is on disk."""
        metadata = {
            "format": FORMAT,
            "version": __version__,
            "progress": dataclasses.asdict(progress),
            "state_digest": digest(state),
            "policy_digest": digest(policy),
            "host_threads": usable_cores(),
        }
        with self._manager("checkpoints", KEEP) as manager:
            if progress.env_steps in manager.all_steps():
                return
            manager.save(
                progress.env_steps,
                args=ocp.args.Composite(
                    state=ocp.args.StandardSave(state),
                    policy=ocp.args.StandardSave(policy),
                    metadata=ocp.args.JsonSave(metadata),
                ),
            )

    def save_best(self, policy: PolicyState, env_steps: int, return_mean: float) -> None:
        """Writes the best policy so far and removes the one before."""
        metadata = {
            "format": FORMAT,
            "env_steps": env_steps,
            "return_mean": return_mean,
            "policy_digest": digest(policy),
        }
        with self._manager("best", 1) as manager:
            if env_steps in manager.all_steps():
                return
            manager.save(
                env_steps,
                args=ocp.args.Composite(
                    policy=ocp.args.StandardSave(policy), metadata=ocp.args.JsonSave(metadata)
                ),
            )

    def latest_step(self) -> int | None:
        """Environment steps of the newest checkpoint; None without any."""
        with self._manager("checkpoints", None) as manager:
            return manager.latest_step()

    def restore(self, abstract_state: TrainState) -> Restored:
        """Reads the newest checkpoint and verifies its digest.

        Args:
          abstract_state: shapes of the train state (``jax.eval_shape(program.init, key)``).

        Raises:
          CheckpointError: there is none, or it is damaged.
        """
        step = self.latest_step()
        if step is None:
            raise CheckpointError(
                f"run {str(self.path)!r} has no checkpoint yet: start it again in a new folder"
            )
        items = self._read("checkpoints", step, state=abstract_state)
        metadata, state = items["metadata"], items["state"]
        if digest(state) != metadata["state_digest"]:
            raise CheckpointError(
                f"checkpoint {self.path / 'checkpoints' / str(step)} is damaged (its digest "
                "differs): remove that folder to fall back to the one before"
            )
        return Restored(state, Progress(**metadata["progress"]), metadata["host_threads"])

    def restore_policy(self, agent: Agent, which: str) -> PolicyState:
        """Reads the ``"best"`` or ``"latest"`` policy and verifies its digest.

        Raises:
          CheckpointError: there is none, or it is damaged.
        """
        folders = {"best": "best", "latest": "checkpoints"}
        if which not in folders:
            raise CheckpointError(f"which={which!r}: must be best or latest")
        folder = folders[which]
        with self._manager(folder, None) as manager:
            step = manager.latest_step()
        if step is None:
            raise CheckpointError(
                f"run {str(self.path)!r} has no {which} policy yet: let it train up to its first "
                + ("evaluation" if which == "best" else "checkpoint")
            )
        items = self._read(folder, step, policy=_abstract_policy(agent))
        if digest(items["policy"]) != items["metadata"]["policy_digest"]:
            raise CheckpointError(
                f"policy {self.path / folder / str(step)} is damaged (its digest differs): "
                f"use the {'latest' if which == 'best' else 'best'} one"
            )
        return items["policy"]

    def _read(self, folder: str, step: int, **abstract: Any) -> dict[str, Any]:
        device = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
        targets = {
            name: jax.tree.map(
                lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=device), tree
            )
            for name, tree in abstract.items()
        }
        restores = {name: ocp.args.StandardRestore(target) for name, target in targets.items()}
        with self._manager(folder, None) as manager:
            try:
                items = manager.restore(
                    step,
                    args=ocp.args.Composite(metadata=ocp.args.JsonRestore(), **restores),
                )
            except Exception as error:  # Orbax raises many kinds for damaged files
                reason = str(error).splitlines()[0] if str(error) else type(error).__name__
                raise CheckpointError(
                    f"checkpoint {self.path / folder / str(step)} cannot be read ({reason[:200]}): "
                    "if it is damaged, remove that folder to fall back to the one before; if "
                    "another version of sacformer-jax wrote it, resume with that one"
                ) from error
        return {name: items[name] for name in ("metadata", *abstract)}

    def _manager(self, folder: str, keep: int | None) -> ocp.CheckpointManager:
        return ocp.CheckpointManager(
            self.path / folder,
            options=ocp.CheckpointManagerOptions(
                max_to_keep=keep, create=keep is not None, enable_async_checkpointing=False
            ),
        )


def _abstract_policy(agent: Agent) -> PolicyState:
    learner = jax.eval_shape(agent.init, jax.random.key(0))
    number: Any = jax.ShapeDtypeStruct((), np.float32)
    fields = {field.name: number for field in dataclasses.fields(Hyperparameters)}
    return policy_state(learner, Hyperparameters(**fields))

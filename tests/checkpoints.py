"""A run folder with two checkpoints for their tests, and what harms one."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sacformer_jax import CheckpointError, Config, stored
from sacformer_jax.checkpoint import BestSoFar, CheckpointWriter, Progress, RunFolder, save_best
from sacformer_jax.members import seed_members
from sacformer_jax.train import Program, make_program, policy_of
from sacformer_jax.types import PolicyState, TrainState

OLD, NEW = 200, 300
MEMBERS = seed_members([4, 9])
PROGRESS = {
    step: Progress(step, (BestSoFar(100, 1.25), BestSoFar(step, -0.1)), (77, step))
    for step in (OLD, NEW)
}


@pytest.fixture(scope="module", name="program")
def program_fixture() -> Program:
    # SAC's networks are traced fastest; what is in the state does not matter here.
    return make_program(
        Config.from_preset(
            "cpu", agent="sac", env="Hopper", num_envs=2, max_episode_steps=50,
            prefill_env_steps=200, total_env_steps=600, actor_width=8, actor_layers=1,
            critic_width=8, batch_size=4, buffer_capacity=2000, updates_per_env_step=1.0,
            seeds=(4, 9),
        )
    )  # fmt: skip


@pytest.fixture(scope="module", name="abstract")
def abstract_fixture(program: Program) -> TrainState:
    return with_members(jax.eval_shape(program.init, jax.random.key(0)))


def with_members(one: Any, num_members: int = 2) -> Any:
    """Shapes of members side by side, of those of one."""
    return jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct((num_members, *leaf.shape), leaf.dtype), one
    )


@pytest.fixture(scope="module", name="axes")
def axes_fixture(abstract: TrainState) -> Any:
    return jax.tree.map(lambda leaf: min(2, leaf.ndim), abstract)


def filled(abstract: Any, seed: int) -> Any:
    """Arrays whose every leaf holds something else than zeros."""
    rng = np.random.default_rng(seed)

    def filled(leaf: jax.ShapeDtypeStruct) -> jax.Array:
        if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return jax.random.split(jax.random.key(seed), leaf.shape)
        if leaf.dtype == jnp.bool_:
            return jnp.asarray(rng.random(leaf.shape) < 0.5)
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            return jnp.asarray(rng.normal(size=leaf.shape), leaf.dtype)
        return jnp.asarray(rng.integers(0, 2**31, leaf.shape), leaf.dtype)

    return jax.tree.map(filled, abstract)


@pytest.fixture(scope="module", name="states")
def states_fixture(abstract: TrainState) -> dict[int, TrainState]:
    return {step: filled(abstract, step) for step in (OLD, NEW)}


def member_policy(state: TrainState, member: int) -> PolicyState:
    return jax.tree.map(lambda leaf: leaf[member], policy_of(state))


@pytest.fixture(scope="module", name="saved")
def saved_fixture(
    program: Program,
    states: dict[int, TrainState],
    axes: Any,
    tmp_path_factory: pytest.TempPathFactory,
) -> RunFolder:
    """A run folder with two checkpoints and best policies; not to be changed."""
    folder = RunFolder(tmp_path_factory.mktemp("saved"))
    folder.create(program.config, {"env": "given"}, program.env.spec, MEMBERS)
    save_best(folder, "seed-4", member_policy(states[OLD], 0), BestSoFar(100, 1.25))
    with CheckpointWriter(folder, program.config, axes) as writer:
        for step in (OLD, NEW):
            save_best(folder, "seed-9", member_policy(states[step], 1), BestSoFar(step, -0.1))
            writer.save(states[step], policy_of(states[step]), PROGRESS[step])
    return folder


@pytest.fixture(name="copy")
def copy_fixture(saved: RunFolder, tmp_path: Path) -> RunFolder:
    """A copy of it to be damaged."""
    shutil.copytree(saved.path, tmp_path / "run")
    return RunFolder(tmp_path / "run")


def message_of(refused: pytest.ExceptionInfo[CheckpointError]) -> str:
    """The message, which has to be one line."""
    message = str(refused.value)
    assert "\n" not in message
    return message


def checkpoint_names(folder: RunFolder) -> list[str]:
    """What is in the folder of checkpoints, whatever it is."""
    return sorted(path.name for path in (folder.path / "checkpoints").iterdir())


def best_names(folder: RunFolder, name: str) -> list[str]:
    return sorted(path.name for path in (folder.member_path(name) / "best").iterdir())


def contents_of(path: Path) -> dict[str, bytes]:
    return {str(file): file.read_bytes() for file in path.rglob("*") if file.is_file()}


def reseal(step_path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Changes metadata as a program would that wrote it so."""
    path = step_path / "metadata" / "metadata"
    metadata = json.loads(path.read_text())
    metadata.pop("digest")
    change(metadata)
    path.write_text(json.dumps(stored.sealed(metadata)))


def flip_bits(path: Path, start: int, count: int = 16) -> None:
    """Flips one bit in each of ``count`` bytes in a row."""
    content = bytearray(path.read_bytes())
    for i in range(start, min(start + count, len(content))):
        content[i] ^= 1 << i % 8
    path.write_bytes(bytes(content))


def metadata_file(step: Path) -> Path:
    return step / "metadata" / "metadata"


def cut(path: Path, share: float) -> None:
    os.truncate(path, int(share * path.stat().st_size))


def flip(path: Path, share: float) -> None:
    flip_bits(path, int(share * path.stat().st_size))


def full_disk(*arguments: Any, **named: Any) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


async def full_disk_later(*arguments: Any, **named: Any) -> None:
    full_disk()


def refusal_of(folder: RunFolder, abstract: Any, **more: Any) -> str:
    """The message of a checkpoint that is refused, after which all is as it was."""
    before = contents_of(folder.path)
    with pytest.raises(CheckpointError) as refused:
        folder.restore(abstract, **more)
    assert contents_of(folder.path) == before
    return message_of(refused)

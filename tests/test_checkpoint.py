"""Checkpoints: round trips bit for bit, writing in the background, damage that must not pass."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import pytest

from sacformer_jax import CheckpointError, Config, stored
from sacformer_jax.checkpoint import (
    FORMAT,
    KEEP,
    BestSoFar,
    CheckpointWriter,
    Progress,
    RunFolder,
    kept_best,
    prune_best,
    restore_policy,
    save_best,
)
from sacformer_jax.digests import digest
from sacformer_jax.members import Member, seed_members
from sacformer_jax.train import Program, make_program, policy_of
from sacformer_jax.types import PolicyState, TrainState

OLD, NEW = 200, 300
MEMBERS = seed_members([4, 9])
PROGRESS = {
    step: Progress(step, (BestSoFar(100, 1.25), BestSoFar(step, -0.1)), (77, step))
    for step in (OLD, NEW)
}


@pytest.fixture(scope="module")
def program() -> Program:
    # SAC's networks are traced fastest; what is in the state does not matter here.
    return make_program(
        Config.from_preset(
            "cpu", agent="sac", env="Hopper", num_envs=2, max_episode_steps=50,
            prefill_env_steps=200, total_env_steps=600, actor_width=8, actor_layers=1,
            critic_width=8, batch_size=4, buffer_capacity=2000, updates_per_env_step=1.0,
            seeds=(4, 9),
        )
    )  # fmt: skip


@pytest.fixture(scope="module")
def abstract(program: Program) -> TrainState:
    return _with_members(jax.eval_shape(program.init, jax.random.key(0)))


def _with_members(one: Any, num_members: int = 2) -> Any:
    """Shapes of members side by side, of those of one."""
    return jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct((num_members, *leaf.shape), leaf.dtype), one
    )


@pytest.fixture(scope="module")
def axes(abstract: TrainState) -> Any:
    return jax.tree.map(lambda leaf: min(2, leaf.ndim), abstract)


def _filled(abstract: Any, seed: int) -> Any:
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


@pytest.fixture(scope="module")
def states(abstract: TrainState) -> dict[int, TrainState]:
    return {step: _filled(abstract, step) for step in (OLD, NEW)}


def _policy(state: TrainState, member: int) -> PolicyState:
    return jax.tree.map(lambda leaf: leaf[member], policy_of(state))


@pytest.fixture(scope="module")
def saved(
    program: Program,
    states: dict[int, TrainState],
    axes: Any,
    tmp_path_factory: pytest.TempPathFactory,
) -> RunFolder:
    """A run folder with two checkpoints and best policies; not to be changed."""
    folder = RunFolder(tmp_path_factory.mktemp("saved"))
    folder.create(program.config, {"env": "given"}, program.env.spec, MEMBERS)
    save_best(folder, "seed-4", _policy(states[OLD], 0), BestSoFar(100, 1.25))
    with CheckpointWriter(folder, program.config, axes) as writer:
        for step in (OLD, NEW):
            save_best(folder, "seed-9", _policy(states[step], 1), BestSoFar(step, -0.1))
            writer.save(states[step], policy_of(states[step]), PROGRESS[step])
    return folder


@pytest.fixture
def copy(saved: RunFolder, tmp_path: Path) -> RunFolder:
    """A copy of it to be damaged."""
    shutil.copytree(saved.path, tmp_path / "run")
    return RunFolder(tmp_path / "run")


def _message(refused: pytest.ExceptionInfo[CheckpointError]) -> str:
    """The message, which has to be one line."""
    message = str(refused.value)
    assert "\n" not in message
    return message


def _checkpoints(folder: RunFolder) -> list[str]:
    """What is in the folder of checkpoints, whatever it is."""
    return sorted(path.name for path in (folder.path / "checkpoints").iterdir())


def _bests(folder: RunFolder, name: str) -> list[str]:
    return sorted(path.name for path in (folder.member_path(name) / "best").iterdir())


def _contents(path: Path) -> dict[str, bytes]:
    return {str(file): file.read_bytes() for file in path.rglob("*") if file.is_file()}


def _reseal(step_path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Changes metadata as a program would that wrote it so."""
    path = step_path / "metadata" / "metadata"
    metadata = json.loads(path.read_text())
    metadata.pop("digest")
    change(metadata)
    path.write_text(json.dumps(stored.sealed(metadata)))


# --- round trip ----------------------------------------------------------------------------------


def test_restore_is_bit_for_bit(
    saved: RunFolder, states: dict[int, TrainState], abstract: TrainState, axes: Any
) -> None:
    for block_axes in (None, axes):
        restored = saved.restore(abstract, block_axes)
        assert restored.progress == PROGRESS[NEW]
        assert restored.moved_aside == ()
        state = states[NEW]
        assert jax.tree.structure(restored.state) == jax.tree.structure(state)
        for old, new in zip(jax.tree.leaves(state), jax.tree.leaves(restored.state), strict=True):
            assert old.dtype == new.dtype
            if jax.dtypes.issubdtype(old.dtype, jax.dtypes.prng_key):
                old, new = jax.random.key_data(old), jax.random.key_data(new)
            assert np.array(old).tobytes() == np.array(new).tobytes()
        assert digest(restored.state) == digest(state)


def test_one_member_alone(program: Program, tmp_path: Path) -> None:
    config = program.config.replace(seeds=1)
    folder = RunFolder(tmp_path / "run")
    folder.create(config, {}, program.env.spec, seed_members([4]))
    abstract = _with_members(jax.eval_shape(program.init, jax.random.key(0)), 1)
    state = _filled(abstract, 1)
    best = BestSoFar(OLD, 2.5)
    save_best(folder, "seed-4", _policy(state, 0), best)
    progress = Progress(OLD, (best,), (5,))
    with CheckpointWriter(folder, config) as writer:
        writer.save(state, policy_of(state), progress)
    restored = folder.restore(abstract)
    assert digest(restored.state) == digest(state)
    assert restored.progress == progress
    assert folder.metrics_path("seed-4") == folder.path / "metrics.jsonl"
    assert (folder.path / "best" / str(OLD)).is_dir()
    for which in ("best", "latest"):
        policy = restore_policy(folder, program.agent, which, 0)
        assert digest(policy) == digest(_policy(state, 0))


@pytest.mark.parametrize(("which", "member", "step"), [
    ("best", 0, OLD), ("best", 1, NEW), ("latest", 0, NEW), ("latest", 1, NEW),
])  # fmt: skip
def test_restore_policy(
    saved: RunFolder,
    program: Program,
    states: dict[int, TrainState],
    which: str,
    member: int,
    step: int,
) -> None:
    policy = restore_policy(saved, program.agent, which, member)
    assert digest(policy) == digest(_policy(states[step], member))


def test_only_the_newest_checkpoints_are_kept(
    copy: RunFolder, program: Program, states: dict[int, TrainState], abstract: TrainState
) -> None:
    with CheckpointWriter(copy, program.config) as writer:
        for step in (400, 500):
            progress = dataclasses.replace(PROGRESS[NEW], env_steps=step)
            writer.save(states[OLD], policy_of(states[OLD]), progress)
    assert _checkpoints(copy) == ["400", "500"]
    assert len(copy.steps()) == KEEP
    assert copy.latest_step() == 500
    assert digest(copy.restore(abstract).state) == digest(states[OLD])


def test_no_best_return_yet_is_kept_as_none(
    copy: RunFolder, program: Program, states: dict[int, TrainState], abstract: TrainState
) -> None:
    progress = Progress(400, (None, BestSoFar(NEW, float("-inf"))), (0, 0))
    with CheckpointWriter(copy, program.config) as writer:
        writer.save(states[OLD], policy_of(states[OLD]), progress)
    assert copy.restore(abstract).progress == progress


def test_saving_a_step_again_changes_nothing(
    copy: RunFolder, program: Program, states: dict[int, TrainState]
) -> None:
    before = _contents(copy.path / "checkpoints")
    with CheckpointWriter(copy, program.config) as writer:
        for step in (OLD, NEW):
            writer.save(states[OLD], policy_of(states[OLD]), Progress(step, (None, None), (0, 0)))
    assert _contents(copy.path / "checkpoints") == before


def test_arrays_may_be_donated_at_once(program: Program, tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    folder.create(program.config, {}, program.env.spec, seed_members([0]))
    values = np.random.default_rng(0).integers(0, 2**31, (1, 4_000_000), np.int32)
    state: Any = {"big": jnp.asarray(values), "key": jax.random.split(jax.random.key(1), 1)}
    kept = jax.tree.map(jnp.copy, state)
    shapes = jax.eval_shape(lambda: kept)

    @jax.jit
    def other(big: jax.Array) -> jax.Array:
        return big * 0 - 1

    overwrite = jax.jit(other, donate_argnums=0)
    overwrite(jnp.zeros_like(state["big"]))  # compiled before, so that it comes at once
    with CheckpointWriter(folder, program.config) as writer:
        policy: Any = {"big": state["big"]}
        writer.save(state, policy, Progress(1, (None,), (0,)))
        place = state["big"].unsafe_buffer_pointer()
        overwritten = overwrite(state["big"]).block_until_ready()
        assert state["big"].is_deleted()
        assert overwritten.unsafe_buffer_pointer() == place  # nothing else holds on to it
    assert digest(folder.restore(shapes).state) == digest(kept)


# --- best policies -------------------------------------------------------------------------------


def test_a_best_policy_lives_as_long_as_a_checkpoint_refers_to_it(
    program: Program, states: dict[int, TrainState], tmp_path: Path
) -> None:
    folder = RunFolder(tmp_path / "run")
    folder.create(program.config, {}, program.env.spec, MEMBERS)
    state = states[OLD]
    seen = []
    first = BestSoFar(10, 0.0)
    with CheckpointWriter(folder, program.config) as writer:
        for step in (100, 200, 300, 400):
            best = BestSoFar(step - 10, float(step))
            save_best(folder, "seed-4", _policy(state, 0), best)
            if step == 100:
                save_best(folder, "seed-9", _policy(state, 1), first)
            writer.save(state, policy_of(state), Progress(step, (best, first), (0, 0)))
            later = BestSoFar(step + 10, float(step))
            save_best(folder, "seed-4", _policy(state, 0), later)  # no checkpoint knows it yet
            writer.wait()
            seen.append(_bests(folder, "seed-4"))
    assert seen == [["110", "90"], ["190", "210", "90"], ["190", "290", "310"],
                    ["290", "390", "410"]]  # fmt: skip
    assert _bests(folder, "seed-9") == ["10"]
    assert kept_best(folder) == ({290, 390}, {10})
    # As on resuming: what belongs to a future that will be computed again goes.
    prune_best(folder, "seed-4", kept_best(folder)[0])
    assert _bests(folder, "seed-4") == ["290", "390"]


def test_a_best_policy_of_the_same_step_is_replaced(
    copy: RunFolder, program: Program, states: dict[int, TrainState]
) -> None:
    save_best(copy, "seed-9", _policy(states[OLD], 0), BestSoFar(NEW, 7.0))
    restored = restore_policy(copy, program.agent, "best", 1)
    assert digest(restored) == digest(_policy(states[OLD], 0))


def test_host_arrays_can_be_saved_as_best(
    copy: RunFolder, program: Program, states: dict[int, TrainState]
) -> None:
    policy = jax.tree.map(np.asarray, _policy(states[OLD], 1))
    save_best(copy, "seed-4", policy, BestSoFar(900, 7.0))
    assert digest(restore_policy(copy, program.agent, "best", 0)) == digest(policy)


def test_a_best_policy_that_cannot_be_saved_harms_none(
    copy: RunFolder,
    program: Program,
    states: dict[int, TrainState],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(ocp.StandardCheckpointHandler, "finalize", _full_disk)
        with pytest.raises(CheckpointError, match=r"900.*No space left on device") as refused:
            save_best(copy, "seed-9", _policy(states[OLD], 1), BestSoFar(900, 7.0))
    _message(refused)
    assert _bests(copy, "seed-9") == [str(OLD), str(NEW)]
    save_best(copy, "seed-9", _policy(states[OLD], 1), BestSoFar(900, 7.0))
    assert _bests(copy, "seed-9") == [str(OLD), str(NEW), "900"]


@pytest.mark.parametrize("which", ["best", "latest"])
def test_a_damaged_policy_gives_the_one_before(
    copy: RunFolder, program: Program, states: dict[int, TrainState], which: str
) -> None:
    path = copy.path / "checkpoints" if which == "latest" else copy.path / "seed-9" / "best"
    files = [file for file in (path / str(NEW) / "policy").rglob("d/*") if file.is_file()]
    largest = max(files, key=lambda file: file.stat().st_size)
    _flip_bits(largest, largest.stat().st_size // 2)
    restored = restore_policy(copy, program.agent, which, 1)
    assert digest(restored) == digest(_policy(states[OLD], 1))
    assert sorted(entry.name for entry in path.iterdir()) == [str(OLD), str(NEW)]
    shutil.rmtree(path / str(OLD) / "metadata")
    with pytest.raises(CheckpointError) as refused:
        restore_policy(copy, program.agent, which, 1)
    message = _message(refused)
    assert f"no {which} policy that is good" in message
    assert f"use the {'latest' if which == 'best' else 'best'} one" in message


def test_a_policy_of_other_networks_is_refused(copy: RunFolder, program: Program) -> None:
    wider = make_program(program.config.replace(actor_width=16))
    for which in ("best", "latest"):
        with pytest.raises(CheckpointError, match="does not fit") as refused:
            restore_policy(copy, wider.agent, which, 1)
        _message(refused)


# --- damage --------------------------------------------------------------------------------------


def _flip_bits(path: Path, start: int, count: int = 16) -> None:
    """Flips one bit in each of ``count`` bytes in a row."""
    content = bytearray(path.read_bytes())
    for i in range(start, min(start + count, len(content))):
        content[i] ^= 1 << i % 8
    path.write_bytes(bytes(content))


def _largest(step: Path) -> Path:
    return max((step / "state").rglob("d/*"), key=lambda path: path.stat().st_size)


def _manifest(step: Path) -> Path:
    return step / "state" / "manifest.ocdbt"


def _metadata(step: Path) -> Path:
    return step / "metadata" / "metadata"


def _cut(path: Path, share: float) -> None:
    os.truncate(path, int(share * path.stat().st_size))


def _flip(path: Path, share: float) -> None:
    _flip_bits(path, int(share * path.stat().st_size))


DAMAGES: dict[str, Callable[[Path], Any]] = {
    "state, bits at 10%": lambda step: _flip(_largest(step), 0.1),
    "state, bits at 40%": lambda step: _flip(_largest(step), 0.4),
    "state, bits at 70%": lambda step: _flip(_largest(step), 0.7),
    "state, truncated": lambda step: _cut(_largest(step), 0.5),
    "state, emptied": lambda step: _cut(_largest(step), 0),
    "state, file missing": lambda step: _largest(step).unlink(),
    "state, all missing": lambda step: shutil.rmtree(step / "state"),
    "manifest, bits": lambda step: _flip(_manifest(step), 0.5),
    "manifest, truncated": lambda step: _cut(_manifest(step), 0.5),
    "manifest, emptied": lambda step: _cut(_manifest(step), 0),
    "manifest, missing": lambda step: _manifest(step).unlink(),
    "metadata, first bit": lambda step: _flip_bits(_metadata(step), 0, 1),
    "metadata, a bit at 20%": lambda step: _flip_bits(
        _metadata(step), int(0.2 * _metadata(step).stat().st_size), 1
    ),
    "metadata, format": lambda step: _metadata(step).write_text(
        _metadata(step).read_text().replace('"format": 2', '"format": 3')
    ),
    "metadata, steps": lambda step: _metadata(step).write_text(
        _metadata(step).read_text().replace(f'"env_steps": {NEW}', f'"env_steps": {NEW + 1}')
    ),
    "metadata, truncated": lambda step: _cut(_metadata(step), 0.5),
    "metadata, emptied": lambda step: _cut(_metadata(step), 0),
    "metadata, other JSON": lambda step: _metadata(step).write_text("[]"),
    "metadata, missing": lambda step: shutil.rmtree(step / "metadata"),
    "metadata, of another step": lambda step: shutil.copy(
        _metadata(step.with_name(str(OLD))), _metadata(step)
    ),
    "everything missing": lambda step: [shutil.rmtree(path) for path in step.glob("*/")],
}


@pytest.mark.parametrize("damage", list(DAMAGES))
def test_damage_gives_the_checkpoint_before(
    copy: RunFolder, states: dict[int, TrainState], abstract: TrainState, damage: str
) -> None:
    step = copy.path / "checkpoints" / str(NEW)
    DAMAGES[damage](step)
    damaged = {name.split("checkpoints")[1]: content for name, content in _contents(step).items()}
    restored = copy.restore(abstract)
    assert digest(restored.state) == digest(states[OLD])
    assert restored.progress == PROGRESS[OLD]
    (line,) = restored.moved_aside
    moved = copy.path / "damaged" / str(NEW)
    assert line.startswith(f"checkpoint {step} is damaged (")
    assert line.endswith(f": moved to {moved}")
    assert "\n" not in line
    assert _checkpoints(copy) == [str(OLD)]
    now = {name.split("damaged")[1]: content for name, content in _contents(moved).items()}
    assert now == damaged  # nothing of it is lost
    assert copy.restore(abstract).moved_aside == ()


@pytest.mark.parametrize("kind", ["bits", "emptied", "missing"])
def test_damage_beside_the_arrays_does_not_pass_either(
    copy: RunFolder,
    program: Program,
    states: dict[int, TrainState],
    abstract: TrainState,
    kind: str,
) -> None:
    """Files that Orbax may need or not: the state is right, or it is the one before."""
    step = copy.path / "checkpoints" / str(NEW)
    names = [
        str(path.relative_to(step))
        for path in step.rglob("*")
        if path.is_file() and "d" not in path.parts and path.name != "metadata"
    ]
    assert {"_CHECKPOINT_METADATA", "state/_METADATA", "state/_sharding"} <= set(names)
    again = RunFolder(copy.path.with_name("again"))

    def damage(name: str) -> None:
        shutil.rmtree(again.path, ignore_errors=True)
        shutil.copytree(copy.path, again.path)
        path = again.path / "checkpoints" / str(NEW) / name
        if kind == "bits":
            _flip(path, 0.5)
        elif kind == "emptied":
            _cut(path, 0)
        else:
            path.unlink()

    for name in names:
        damage(name)
        restored = again.restore(abstract)
        step_now = restored.progress.env_steps
        assert step_now == (OLD if restored.moved_aside else NEW), name
        assert digest(restored.state) == digest(states[step_now]), name
    for name in ("_CHECKPOINT_METADATA", "state/_METADATA"):  # the writer looks at them as well
        damage(name)
        progress = dataclasses.replace(PROGRESS[OLD], env_steps=400)
        with CheckpointWriter(again, program.config) as writer:
            writer.save(states[OLD], policy_of(states[OLD]), progress)
        assert again.restore(abstract).progress == progress


def test_every_flipped_bit_of_the_metadata_is_seen(copy: RunFolder) -> None:
    step = copy.path / "checkpoints" / str(NEW)
    content = _metadata(step).read_bytes()
    rng = np.random.default_rng(0)
    for place in [*range(60), *rng.integers(0, len(content), 200)]:
        flipped = bytearray(content)
        flipped[place] ^= 1 << rng.integers(0, 8)
        _metadata(step).write_bytes(bytes(flipped))
        with pytest.raises(stored.DamagedError):
            stored.read_metadata(step)


def test_the_leaf_that_differs_is_named(copy: RunFolder, abstract: TrainState) -> None:
    def change(metadata: dict[str, Any]) -> None:
        metadata["items"]["state"][".buffer.steps.reward"]["digest"] = "0" * 64

    _reseal(copy.path / "checkpoints" / str(NEW), change)
    (line,) = copy.restore(abstract).moved_aside
    assert "the digest of state.buffer.steps.reward differs" in line


def test_when_all_are_damaged_that_is_what_it_says(copy: RunFolder, abstract: TrainState) -> None:
    for step in (OLD, NEW):
        _cut(_metadata(copy.path / "checkpoints" / str(step)), 0.3)
    with pytest.raises(CheckpointError) as refused:
        copy.restore(abstract)
    message = _message(refused)
    assert "no checkpoint left that is good" in message
    for step in (OLD, NEW):
        assert str(copy.path / "damaged" / str(step)) in message
        assert (copy.path / "damaged" / str(step)).is_dir()


def test_a_step_damaged_twice_is_kept_twice(
    copy: RunFolder, program: Program, states: dict[int, TrainState], abstract: TrainState
) -> None:
    for name in (str(NEW), f"{NEW}-2", f"{NEW}-3"):
        _cut(_metadata(copy.path / "checkpoints" / str(NEW)), 0.3)
        (line,) = copy.restore(abstract).moved_aside
        assert line.endswith(str(copy.path / "damaged" / name))
        with CheckpointWriter(copy, program.config) as writer:
            writer.save(states[NEW], policy_of(states[NEW]), PROGRESS[NEW])
    assert digest(copy.restore(abstract).state) == digest(states[NEW])


def test_a_damaged_checkpoint_that_cannot_be_moved(copy: RunFolder, abstract: TrainState) -> None:
    (copy.path / "damaged").write_text("in the way")
    _cut(_metadata(copy.path / "checkpoints" / str(NEW)), 0.3)
    with pytest.raises(CheckpointError, match="cannot be moved") as refused:
        copy.restore(abstract)
    _message(refused)
    assert copy.steps() == [OLD, NEW]


# --- not damage ----------------------------------------------------------------------------------


def _refused(folder: RunFolder, abstract: Any, **more: Any) -> str:
    """The message of a checkpoint that is refused, after which all is as it was."""
    before = _contents(folder.path)
    with pytest.raises(CheckpointError) as refused:
        folder.restore(abstract, **more)
    assert _contents(folder.path) == before
    return _message(refused)


def test_a_checkpoint_of_another_version_is_refused(copy: RunFolder, abstract: TrainState) -> None:
    step = copy.path / "checkpoints" / str(NEW)
    _reseal(step, lambda metadata: metadata.update(format=FORMAT + 1, version="9.8.7"))
    message = _refused(copy, abstract)
    assert f"format {FORMAT + 1}" in message
    assert "9.8.7" in message


def test_a_checkpoint_with_settings_unknown_here_is_refused(
    copy: RunFolder, abstract: TrainState
) -> None:
    step = copy.path / "checkpoints" / str(NEW)
    _reseal(step, lambda metadata: metadata["config"].update(unheard_of=1, version="9.8.7"))
    assert "unheard_of" in _refused(copy, abstract)


def test_another_shape_is_refused(copy: RunFolder, program: Program) -> None:
    wider = make_program(program.config.replace(buffer_capacity=3000))
    shapes = _with_members(jax.eval_shape(wider.init, jax.random.key(0)))
    message = _refused(copy, shapes)
    assert "float32[2, 2, 1000, 11]" in message
    assert "float32[2, 2, 1500, 11]" in message
    assert ".buffer.steps.obs" in message


def test_other_leaves_are_refused(copy: RunFolder, abstract: TrainState) -> None:
    assert "for .key it has no such array" in _refused(
        copy, dataclasses.replace(abstract, key=abstract.counters.updates)
    ).replace("key<fry>[2]", "no such array")
    more = dataclasses.replace(abstract, context={"new": abstract.counters.updates})
    assert "for .context['new'] it has no such array, the program int32[2]" in _refused(copy, more)
    fewer = dataclasses.replace(abstract, context=None)
    message = _refused(copy, fewer)
    assert "for .context.obs it has float32[2, 2, " in message
    assert "the program no such array" in message


def test_another_number_of_members_is_refused(copy: RunFolder, program: Program) -> None:
    shapes = _with_members(jax.eval_shape(program.init, jax.random.key(0)), 3)
    assert "does not fit" in _refused(copy, shapes)


def test_other_block_axes_are_refused(copy: RunFolder, abstract: TrainState, axes: Any) -> None:
    others = jax.tree.map(lambda _: 1, axes)
    assert "was divided along 2 axes, not 1" in _refused(copy, abstract, block_axes=others)


def _set_config(folder: RunFolder, section: str, **fields: Any) -> None:
    path = folder.path / "config.json"
    contents = json.loads(path.read_text())
    (contents["config"][section] if section else contents["config"]).update(fields)
    path.write_text(json.dumps(contents))


@pytest.mark.parametrize(
    ("section", "field", "value", "was"),
    [("sac", "tau", 0.5, "0.005"), ("actor", "actor_width", 16, "8"), ("", "seeds", 2, "(4, 9)")],
)
def test_a_changed_config_is_refused(
    copy: RunFolder, abstract: TrainState, section: str, field: str, value: Any, was: str
) -> None:
    _set_config(copy, section, **{field: value})
    message = _refused(copy, abstract)
    assert f"{field}={was}" in message
    assert f"{field}={value}" in message
    assert "put config.json back" in message


def test_what_does_not_decide_the_run_may_change(copy: RunFolder, abstract: TrainState) -> None:
    _set_config(
        copy, "run", total_env_steps=900, eval_every=7, eval_episodes=3, checkpoint_every=5,
        run_dir="elsewhere",
    )  # fmt: skip
    assert copy.restore(abstract).progress == PROGRESS[NEW]


def test_memory_that_is_missing_is_no_damage(
    copy: RunFolder, abstract: TrainState, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(error: Exception) -> Callable[..., None]:
        def fail(*arguments: Any, **named: Any) -> None:
            raise error

        return fail

    for error in (
        MemoryError("no memory"),
        jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: out of memory"),
        PermissionError(errno.EACCES, "Permission denied"),
        ValueError("PERMISSION_DENIED: Error opening x [OS error 13: Permission denied]"),
    ):
        monkeypatch.setattr(ocp.StandardCheckpointHandler, "restore", failing(error))
        assert "cannot be read" in _refused(copy, abstract)


# --- the folder ----------------------------------------------------------------------------------


def test_config_and_spec_are_read_back(saved: RunFolder, program: Program) -> None:
    assert saved.opened() is saved
    file = saved.read_config()
    assert file.config == program.config
    assert file.members == MEMBERS
    assert set(file.sources) == set(program.config.flat())
    assert file.sources["env"] == "given"
    assert saved.read_spec() == program.env.spec


def test_members_keep_their_values(program: Program, tmp_path: Path) -> None:
    members = (Member("a", 1, {"tau": 0.25}), Member("b", 2, {"tau": 0.5, "alpha": 1.0}))
    folder = RunFolder(tmp_path / "run")
    folder.create(program.config, {}, program.env.spec, members)
    assert RunFolder(folder.path).read_config().members == members
    assert RunFolder(folder.path).metrics_path("b") == folder.path / "b" / "metrics.jsonl"
    assert not list(folder.path.glob("*.new"))


@pytest.mark.parametrize("content", ["", "{", "[]", "7", '{"config": {}}'])
def test_a_damaged_config_is_refused(copy: RunFolder, content: str) -> None:
    (copy.path / "config.json").write_text(content)
    for read in (copy.read_config, copy.read_spec):
        with pytest.raises(CheckpointError, match="damaged") as refused:
            read()
        assert "config.json" in _message(refused)


@pytest.mark.parametrize("content", [b'{"format": 2}', b"\xff\xfe{}"])
def test_a_config_without_its_parts_is_refused(copy: RunFolder, content: bytes) -> None:
    (copy.path / "config.json").write_bytes(content)
    with pytest.raises(CheckpointError, match="damaged"):
        copy.read_config()


@pytest.mark.parametrize("other", [1, FORMAT + 1])
def test_another_format_is_refused(copy: RunFolder, abstract: TrainState, other: int) -> None:
    path = copy.path / "config.json"
    values = json.loads(path.read_text())
    path.write_text(json.dumps({**values, "format": other, "version": "9.8.7"}))
    with pytest.raises(CheckpointError) as refused:
        copy.read_config()
    message = _message(refused)
    assert f"format {other}" in message
    assert "9.8.7" in message
    assert _refused(copy, abstract) == message


def test_a_folder_that_is_no_run_is_refused(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "missing"):
        with pytest.raises(CheckpointError) as refused:
            RunFolder(path).opened()
        message = _message(refused)
        assert str(path) in message
        assert "config.json" in message
    assert list(tmp_path.iterdir()) == []


def test_a_run_without_checkpoint(program: Program, abstract: TrainState, tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    folder.create(program.config, {}, program.env.spec, MEMBERS)
    assert folder.latest_step() is None
    with pytest.raises(CheckpointError, match="no checkpoint yet"):
        folder.restore(abstract)
    for which in ("best", "latest"):
        with pytest.raises(CheckpointError, match=f"no {which} policy yet"):
            restore_policy(folder, program.agent, which, 0)
    with pytest.raises(CheckpointError, match="'worst'"):
        restore_policy(folder, program.agent, "worst", 0)


def test_a_run_is_not_created_over_another(saved: RunFolder, program: Program) -> None:
    before = (saved.path / "config.json").read_bytes()
    with pytest.raises(CheckpointError) as refused:
        saved.create(program.config.replace(seed=9), {}, program.env.spec, MEMBERS)
    assert f"sacformer resume {saved.path}" in _message(refused)
    assert (saved.path / "config.json").read_bytes() == before


def test_a_run_stopped_before_its_first_checkpoint_starts_anew(
    program: Program, states: dict[int, TrainState], tmp_path: Path
) -> None:
    folder = RunFolder(tmp_path / "run")
    folder.create(program.config, {}, program.env.spec, MEMBERS)
    save_best(folder, "seed-9", _policy(states[OLD], 1), BestSoFar(OLD, 1.0))
    folder.create(program.config.replace(tau=0.5), {}, program.env.spec, MEMBERS)
    with pytest.raises(CheckpointError, match="no best policy yet"):
        restore_policy(folder, program.agent, "best", 1)


def _not_writable(program: Program, path: Path) -> None:
    with pytest.raises(CheckpointError) as refused:
        RunFolder(path).create(program.config, {}, program.env.spec, MEMBERS)
    message = _message(refused)
    assert str(path) in message
    assert "cannot be written" in message


def test_a_folder_that_cannot_be_written_is_refused(program: Program, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    _not_writable(program, tmp_path / "file" / "run")
    (tmp_path / "run" / "config.json.new").mkdir(parents=True)
    _not_writable(program, tmp_path / "run")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "seed-9").write_text("in the way")
    _not_writable(program, tmp_path / "other")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_read_only_folder_is_refused(program: Program, tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    try:
        _not_writable(program, tmp_path / "run")
        _not_writable(program, tmp_path)
    finally:
        tmp_path.chmod(0o700)


# --- saves that fail -----------------------------------------------------------------------------


def _full_disk(*arguments: Any, **named: Any) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


async def _full_disk_later(*arguments: Any, **named: Any) -> None:
    _full_disk()


FAILING: dict[str, tuple[type, str, Any]] = {
    "at once": (ocp.CheckpointManager, "save", _full_disk),
    "in the background": (ocp.JsonCheckpointHandler, "_save_fn", _full_disk_later),
}


@pytest.mark.parametrize("when", list(FAILING))
@pytest.mark.parametrize("told", ["save", "wait", "exit"])
def test_a_full_disk_harms_nothing_that_is_there(
    copy: RunFolder,
    program: Program,
    states: dict[int, TrainState],
    abstract: TrainState,
    monkeypatch: pytest.MonkeyPatch,
    when: str,
    told: str,
) -> None:
    before = _contents(copy.path)
    state, progress = states[OLD], dataclasses.replace(PROGRESS[OLD], env_steps=400)
    writer = CheckpointWriter(copy, program.config)

    def save() -> None:
        with writer:
            writer.save(state, policy_of(state), progress)
            if told == "save":
                writer.save(state, policy_of(state), progress)
            elif told == "wait":
                writer.wait()

    with monkeypatch.context() as patch:
        patch.setattr(*FAILING[when])
        with pytest.raises(CheckpointError) as refused:
            save()
    message = _message(refused)
    assert str(copy.path / "checkpoints" / "400") in message
    assert "No space left on device" in message
    assert _contents(copy.path) == before
    assert _checkpoints(copy) == [str(OLD), str(NEW)]
    assert copy.restore(abstract).progress == PROGRESS[NEW]
    with writer:  # there is space again
        writer.save(state, policy_of(state), progress)
        writer.wait()
        assert copy.latest_step() == 400
        progress = dataclasses.replace(progress, env_steps=500)
        writer.save(state, policy_of(state), progress)
    assert _checkpoints(copy) == ["400", "500"]
    assert digest(copy.restore(abstract).state) == digest(state)


def test_a_failure_does_not_hide_the_error_that_came_first(
    copy: RunFolder,
    program: Program,
    states: dict[int, TrainState],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(*FAILING["in the background"])
    progress = dataclasses.replace(PROGRESS[OLD], env_steps=400)

    def save() -> None:
        with CheckpointWriter(copy, program.config) as writer:
            writer.save(states[OLD], policy_of(states[OLD]), progress)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError) as first:
        save()
    assert "No space left on device" in first.value.__notes__[0]


# --- processes of their own ----------------------------------------------------------------------

_PRELUDE = """
import faulthandler; faulthandler.dump_traceback_later(50)
import os, resource, sys
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec as P
from sacformer_jax import CheckpointError, Config
from sacformer_jax.checkpoint import *
from sacformer_jax.digests import digest

def tree(seed, size=24):
    rng = np.random.default_rng(seed)
    return {
        "big": rng.integers(0, 2**31, (2, 4, size), np.int32),
        "params": {"w": rng.normal(size=(2, 3)).astype(np.float32)},
        "half": np.asarray(rng.normal(size=(2, 8)), jnp.bfloat16),
        "mask": rng.random((2, 4)) < 0.5,
        "steps": np.int32(seed),
        "key": jax.random.split(jax.random.key(seed), 2),
    }

axes = {"big": 2, "params": {"w": 1}, "half": 1, "mask": 2, "steps": 0, "key": 1}
shapes = lambda size=24: jax.tree.map(
    lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), tree(0, size)
)

def mesh_shardings():
    count = jax.device_count()
    mesh = jax.make_mesh((2, count // 2), ("seed", "data"), axis_types=(AxisType.Auto,) * 2)
    specs = [P(), P("seed"), P("seed", "data")]
    return jax.tree.map(lambda n: NamedSharding(mesh, specs[n]), axes)

def spread(values):
    def put(x, sharding):
        if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
            data = np.asarray(jax.random.key_data(x))
            make = lambda: jax.random.wrap_key_data(jnp.asarray(data))
            return jax.jit(make, out_shardings=sharding)()
        return jax.make_array_from_callback(np.shape(x), sharding, lambda index: x[index])
    return jax.tree.map(put, values, mesh_shardings())

def progress(step):
    return Progress(step, (None, None), (0, 0))

folder = RunFolder(sys.argv[1])
config = Config.from_preset("cpu", env="Hopper", seeds=2)
"""


@pytest.fixture
def tools(tmp_path: Path, program: Program, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What the programs below have at hand, for this process."""
    path = tmp_path / "run"
    monkeypatch.setattr(sys, "argv", ["test", str(path)])
    exec(_PRELUDE, space := {"__name__": "prelude"})
    space["folder"].create(space["config"], {}, program.env.spec, seed_members([0, 1]))
    return space


def _start(code: str, path: Path, *arguments: str, devices: int = 1) -> subprocess.Popen[str]:
    flags = f" --xla_force_host_platform_device_count={devices}"
    environment = {**os.environ, "XLA_FLAGS": os.environ.get("XLA_FLAGS", "") + flags}
    return subprocess.Popen(
        [sys.executable, "-c", _PRELUDE + code, str(path), *arguments],
        env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def _finished(process: subprocess.Popen[str]) -> str:
    try:
        output, errors = process.communicate(timeout=60)
    except subprocess.TimeoutExpired:
        process.kill()
        output, errors = process.communicate()
    assert process.returncode == 0, errors
    return output


_ON_EIGHT = """
assert jax.device_count() == 8
restored = folder.restore(shapes(), axes, mesh_shardings())
assert restored.progress == progress(1)
assert len(restored.state["big"].sharding.device_set) == 8
assert digest(restored.state, axes) == digest(tree(1), axes)
whole = folder.restore(shapes()).state
assert len(whole["big"].sharding.device_set) == 1
assert digest(whole, axes) == digest(tree(1), axes)
with CheckpointWriter(folder, config, axes) as writer:
    state = spread(tree(2))
    writer.save(state, {"w": state["params"]["w"]}, progress(2))
"""


def test_saved_on_one_device_restored_on_eight_and_back(tools: dict[str, Any]) -> None:
    folder, tree, axes = tools["folder"], tools["tree"], tools["axes"]
    state = jax.tree.map(jnp.asarray, tree(1))
    with CheckpointWriter(folder, tools["config"], axes) as writer:
        writer.save(state, {"w": state["params"]["w"]}, tools["progress"](1))
    _finished(_start(_ON_EIGHT, folder.path, devices=8))
    restored = folder.restore(tools["shapes"](), axes)
    assert restored.progress == tools["progress"](2)
    assert digest(restored.state, axes) == digest(tree(2), axes)


_ONE_OF_TWO = """
index = int(sys.argv[2])
jax.distributed.initialize(f"localhost:{sys.argv[3]}", 2, index)
assert jax.device_count() == 4 and jax.local_device_count() == 2
shardings = mesh_shardings()
restored = folder.restore(shapes(), axes, shardings)
assert [line.count("is damaged") for line in restored.moved_aside] == [1], restored.moved_aside
assert digest(restored.state, axes) == sys.argv[4]
assert restored.progress == progress(1)
with CheckpointWriter(folder, config, axes) as writer:
    for step in (2, 3):
        if index == 0:  # only one of them
            save_best(folder, "seed-1", {"w": np.float32(step)}, BestSoFar(step, 1.0))
        state = spread(tree(step))
        writer.save(state, {"w": state["params"]["w"]}, progress(step))
        assert digest(state, axes) == sys.argv[3 + step]
    save_best(folder, "seed-1", {"w": np.float32(index)}, BestSoFar(4, 1.0))
"""


def test_two_processes(tools: dict[str, Any]) -> None:
    """Each sees half of every array; one of them finds the checkpoint damaged."""
    folder, tree, axes = tools["folder"], tools["tree"], tools["axes"]
    with CheckpointWriter(folder, tools["config"], axes) as writer:
        for step in (1, 2):
            state = jax.tree.map(jnp.asarray, tree(step))
            writer.save(state, {"w": state["params"]["w"]}, tools["progress"](step))
    newest = folder.path / "checkpoints" / "2"
    _reseal(newest, lambda metadata: metadata["items"]["state"]["['mask']"].update(digest="0" * 64))
    digests = [digest(tree(step), axes) for step in (1, 2, 3)]
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = str(free.getsockname()[1])
    both = [_start(_ONE_OF_TWO, folder.path, str(i), port, *digests, devices=2) for i in range(2)]
    try:
        for process in both:
            _finished(process)
    finally:
        for process in both:
            process.kill()
            process.wait()
    restored = folder.restore(tools["shapes"](), axes)
    assert restored.progress == tools["progress"](3)
    assert restored.moved_aside == ()
    assert digest(restored.state, axes) == digests[2]
    assert folder.steps() == [2, 3]
    best = json.loads(_metadata(folder.path / "seed-1" / "best" / "4").read_text())
    assert best["items"]["policy"]["['w']"]["shape"] == []


_LIMITED = """
resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, resource.RLIM_INFINITY))
import signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
size = 500_000
state = jax.tree.map(jnp.asarray, tree(2, size))
writer = CheckpointWriter(folder, config, axes)
try:
    with writer:
        writer.save(state, {"w": state["params"]["w"]}, progress(2))
except CheckpointError as error:
    print(error)
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
assert [path.name for path in folder.checkpoints_path.iterdir()] == ["1"]
with writer:
    writer.save(state, {"w": state["params"]["w"]}, progress(2))
assert digest(folder.restore(shapes(size), axes).state, axes) == digest(state, axes)
"""


def test_a_file_that_may_not_grow(tools: dict[str, Any]) -> None:
    """A real error of the system while the arrays are written."""
    state = jax.tree.map(jnp.asarray, tools["tree"](1))
    with CheckpointWriter(tools["folder"], tools["config"], tools["axes"]) as writer:
        writer.save(state, {"w": state["params"]["w"]}, tools["progress"](1))
    output = _finished(_start(_LIMITED, tools["folder"].path))
    assert output.count("\n") == 1
    assert "checkpoints/2 could not be saved" in output
    assert "File too large" in output


_SMALL_DISK = """
size = 500_000
state = jax.tree.map(jnp.asarray, tree(1, 1000))
with CheckpointWriter(folder, config, axes) as writer:
    writer.save(state, {"w": state["params"]["w"]}, progress(1))
large = jax.tree.map(jnp.asarray, tree(2, size))
writer = CheckpointWriter(folder, config, axes)
try:
    with writer:
        writer.save(large, {"w": large["params"]["w"]}, progress(2))
except CheckpointError as error:
    print(error)
assert digest(folder.restore(shapes(1000), axes).state, axes) == digest(state, axes)
with writer:
    writer.save(state, {"w": state["params"]["w"]}, progress(3))
assert folder.restore(shapes(1000), axes).progress == progress(3)
"""


def test_a_disk_that_is_full(tools: dict[str, Any], tmp_path: Path) -> None:
    mount = tmp_path / "small"
    mount.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(mount)]
    try:
        mounted = subprocess.run(command, capture_output=True).returncode == 0
    except FileNotFoundError:
        mounted = False
    if not mounted:
        pytest.skip("no small disk can be mounted here")
    try:
        shutil.copytree(tools["folder"].path, mount / "run")
        output = _finished(_start(_SMALL_DISK, mount / "run"))
    finally:
        subprocess.run(["umount", str(mount)], check=True)
    assert "checkpoints/2 could not be saved" in output
    assert "No space left on device" in output


_KILLED = """
size = 6_000_000
for step in (1, 2):
    state = jax.tree.map(jnp.asarray, tree(step, size))
    writer = CheckpointWriter(folder, config, axes)
    writer.save(state, {"w": state["params"]["w"]}, progress(step))
    if step == 1:
        writer.wait()
print("saving", flush=True)
writer.wait()
print("saved", flush=True)
"""


def test_killed_in_a_save(tools: dict[str, Any]) -> None:
    folder, size = tools["folder"], 6_000_000
    process = _start(_KILLED, folder.path)
    assert process.stdout is not None
    assert process.stdout.readline() == "saving\n"
    time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    assert process.communicate(timeout=60)[0] == ""
    assert any("tmp" in name for name in _checkpoints(folder))  # it was in the middle of it
    assert folder.steps() == [1]
    restored = folder.restore(tools["shapes"](size), tools["axes"])
    assert restored.progress == tools["progress"](1)
    assert restored.moved_aside == ()
    state = jax.tree.map(jnp.asarray, tools["tree"](2))
    with CheckpointWriter(folder, tools["config"], tools["axes"]) as writer:
        writer.save(state, {"w": state["params"]["w"]}, tools["progress"](2))
    assert _checkpoints(folder) == ["1", "2"]
    restored = folder.restore(tools["shapes"](), tools["axes"])
    assert digest(restored.state, tools["axes"]) == digest(state, tools["axes"])

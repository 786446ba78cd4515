"""Checkpoints: round trips bit for bit, best policies, the folder, saves that fail."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import json
import os
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import pytest
from checkpoints import (  # noqa: F401 (fixtures are used by their names)
    MEMBERS,
    NEW,
    OLD,
    PROGRESS,
    abstract_fixture,
    axes_fixture,
    best_names,
    checkpoint_names,
    contents_of,
    copy_fixture,
    filled,
    flip_bits,
    full_disk,
    full_disk_later,
    member_policy,
    message_of,
    program_fixture,
    refusal_of,
    saved_fixture,
    states_fixture,
    with_members,
)

from sacformer_jax import CheckpointError
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
from sacformer_jax.types import TrainState

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
    abstract = with_members(jax.eval_shape(program.init, jax.random.key(0)), 1)
    state = filled(abstract, 1)
    best = BestSoFar(OLD, 2.5)
    save_best(folder, "seed-4", member_policy(state, 0), best)
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
        assert digest(policy) == digest(member_policy(state, 0))


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
    assert digest(policy) == digest(member_policy(states[step], member))


def test_only_the_newest_checkpoints_are_kept(
    copy: RunFolder, program: Program, states: dict[int, TrainState], abstract: TrainState
) -> None:
    with CheckpointWriter(copy, program.config) as writer:
        for step in (400, 500):
            progress = dataclasses.replace(PROGRESS[NEW], env_steps=step)
            writer.save(states[OLD], policy_of(states[OLD]), progress)
    assert checkpoint_names(copy) == ["400", "500"]
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
    before = contents_of(copy.path / "checkpoints")
    with CheckpointWriter(copy, program.config) as writer:
        for step in (OLD, NEW):
            writer.save(states[OLD], policy_of(states[OLD]), Progress(step, (None, None), (0, 0)))
    assert contents_of(copy.path / "checkpoints") == before


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
            save_best(folder, "seed-4", member_policy(state, 0), best)
            if step == 100:
                save_best(folder, "seed-9", member_policy(state, 1), first)
            writer.save(state, policy_of(state), Progress(step, (best, first), (0, 0)))
            later = BestSoFar(step + 10, float(step))
            save_best(
                folder, "seed-4", member_policy(state, 0), later
            )  # no checkpoint knows it yet
            writer.wait()
            seen.append(best_names(folder, "seed-4"))
    assert seen == [["110", "90"], ["190", "210", "90"], ["190", "290", "310"],
                    ["290", "390", "410"]]  # fmt: skip
    assert best_names(folder, "seed-9") == ["10"]
    assert kept_best(folder) == ({290, 390}, {10})
    # As on resuming: what belongs to a future that will be computed again goes.
    prune_best(folder, "seed-4", kept_best(folder)[0])
    assert best_names(folder, "seed-4") == ["290", "390"]


def test_a_best_policy_of_the_same_step_is_replaced(
    copy: RunFolder, program: Program, states: dict[int, TrainState]
) -> None:
    save_best(copy, "seed-9", member_policy(states[OLD], 0), BestSoFar(NEW, 7.0))
    restored = restore_policy(copy, program.agent, "best", 1)
    assert digest(restored) == digest(member_policy(states[OLD], 0))


def test_nothing_waits_for_a_checkpoint_beside_it(
    copy: RunFolder, program: Program, states: dict[int, TrainState]
) -> None:
    """Orbax's signals of a checkpoint under way are all operations'; the last one removes them, and
    whoever waits for one then waits for 5 minutes and fails.
    """
    futures = importlib.import_module("orbax.checkpoint._src.futures.future")
    signals = futures.AwaitableSignalsContract.get_awaitable_signals_from_contract
    policy = policy_of(states[OLD])
    with CheckpointWriter(copy, program.config) as writer:
        for step in (400, 500, 600):
            progress = dataclasses.replace(PROGRESS[OLD], env_steps=step)
            writer.save(states[OLD], policy, progress)
            assert not signals()
            save_best(copy, "seed-4", member_policy(states[OLD], 0), BestSoFar(step, float(step)))
    assert checkpoint_names(copy)[-1] == "600"


def test_host_arrays_can_be_saved_as_best(
    copy: RunFolder, program: Program, states: dict[int, TrainState]
) -> None:
    policy = jax.tree.map(np.asarray, member_policy(states[OLD], 1))
    save_best(copy, "seed-4", policy, BestSoFar(900, 7.0))
    assert digest(restore_policy(copy, program.agent, "best", 0)) == digest(policy)


def test_a_best_policy_that_cannot_be_saved_harms_none(
    copy: RunFolder,
    program: Program,
    states: dict[int, TrainState],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(ocp.StandardCheckpointHandler, "finalize", full_disk)
        with pytest.raises(CheckpointError, match=r"900.*No space left on device") as refused:
            save_best(copy, "seed-9", member_policy(states[OLD], 1), BestSoFar(900, 7.0))
    message_of(refused)
    assert best_names(copy, "seed-9") == [str(OLD), str(NEW)]
    save_best(copy, "seed-9", member_policy(states[OLD], 1), BestSoFar(900, 7.0))
    assert best_names(copy, "seed-9") == [str(OLD), str(NEW), "900"]


@pytest.mark.parametrize("which", ["best", "latest"])
def test_a_damaged_policy_gives_the_one_before(
    copy: RunFolder, program: Program, states: dict[int, TrainState], which: str
) -> None:
    path = copy.path / "checkpoints" if which == "latest" else copy.path / "seed-9" / "best"
    files = [file for file in (path / str(NEW) / "policy").rglob("d/*") if file.is_file()]
    largest = max(files, key=lambda file: file.stat().st_size)
    flip_bits(largest, largest.stat().st_size // 2)
    restored = restore_policy(copy, program.agent, which, 1)
    assert digest(restored) == digest(member_policy(states[OLD], 1))
    assert sorted(entry.name for entry in path.iterdir()) == [str(OLD), str(NEW)]
    shutil.rmtree(path / str(OLD) / "metadata")
    with pytest.raises(CheckpointError) as refused:
        restore_policy(copy, program.agent, which, 1)
    message = message_of(refused)
    assert f"no {which} policy that is good" in message
    assert f"use the {'latest' if which == 'best' else 'best'} one" in message


def test_a_policy_of_other_networks_is_refused(copy: RunFolder, program: Program) -> None:
    wider = make_program(program.config.replace(actor_width=16))
    for which in ("best", "latest"):
        with pytest.raises(CheckpointError, match="does not fit") as refused:
            restore_policy(copy, wider.agent, which, 1)
        message_of(refused)


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
        assert "config.json" in message_of(refused)


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
    message = message_of(refused)
    assert f"format {other}" in message
    assert "9.8.7" in message
    assert refusal_of(copy, abstract) == message


def test_a_folder_that_is_no_run_is_refused(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "missing"):
        with pytest.raises(CheckpointError) as refused:
            RunFolder(path).opened()
        message = message_of(refused)
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
    assert f"sacformer resume {saved.path}" in message_of(refused)
    assert (saved.path / "config.json").read_bytes() == before


def test_a_run_stopped_before_its_first_checkpoint_starts_anew(
    program: Program, states: dict[int, TrainState], tmp_path: Path
) -> None:
    folder = RunFolder(tmp_path / "run")
    folder.create(program.config, {}, program.env.spec, MEMBERS)
    save_best(folder, "seed-9", member_policy(states[OLD], 1), BestSoFar(OLD, 1.0))
    folder.create(program.config.replace(tau=0.5), {}, program.env.spec, MEMBERS)
    with pytest.raises(CheckpointError, match="no best policy yet"):
        restore_policy(folder, program.agent, "best", 1)


def _not_writable(program: Program, path: Path) -> None:
    with pytest.raises(CheckpointError) as refused:
        RunFolder(path).create(program.config, {}, program.env.spec, MEMBERS)
    message = message_of(refused)
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


FAILING: dict[str, tuple[type, str, Any]] = {
    "at once": (ocp.CheckpointManager, "save", full_disk),
    "in the background": (ocp.JsonCheckpointHandler, "_save_fn", full_disk_later),
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
    before = contents_of(copy.path)
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
    message = message_of(refused)
    assert str(copy.path / "checkpoints" / "400") in message
    assert "No space left on device" in message
    assert contents_of(copy.path) == before
    assert checkpoint_names(copy) == [str(OLD), str(NEW)]
    assert copy.restore(abstract).progress == PROGRESS[NEW]
    with writer:  # there is space again
        writer.save(state, policy_of(state), progress)
        writer.wait()
        assert copy.latest_step() == 400
        progress = dataclasses.replace(progress, env_steps=500)
        writer.save(state, policy_of(state), progress)
    assert checkpoint_names(copy) == ["400", "500"]
    assert digest(copy.restore(abstract).state) == digest(state)


def test_a_save_that_failed_does_not_take_the_next_with_it(
    copy: RunFolder,
    program: Program,
    states: dict[int, TrainState],
    abstract: TrainState,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    state, progress = states[OLD], dataclasses.replace(PROGRESS[OLD], env_steps=400)
    with CheckpointWriter(copy, program.config) as writer:
        with monkeypatch.context() as patch:
            patch.setattr(*FAILING["in the background"])
            writer.save(state, policy_of(state), progress)
            assert writer._manager is not None
            with contextlib.suppress(Exception):
                writer._manager.wait_until_finished()
        # There is space again before anybody has asked what became of it.
        progress = dataclasses.replace(progress, env_steps=500)
        with pytest.raises(CheckpointError, match="400 could not be saved"):
            writer.wait()
        writer.save(state, policy_of(state), progress)
        writer.wait()
        assert copy.latest_step() == 500
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

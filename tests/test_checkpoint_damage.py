"""Checkpoints that are damaged or do not fit: no half-read state, and no good one lost."""

from __future__ import annotations

import asyncio
import dataclasses
import errno
import gc
import json
import logging
import os
import shutil
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp
import pytest
from checkpoints import (  # noqa: F401 (fixtures are used by their names)
    NEW,
    OLD,
    PROGRESS,
    abstract_fixture,
    axes_fixture,
    checkpoint_names,
    contents_of,
    copy_fixture,
    cut,
    flip,
    flip_bits,
    message_of,
    metadata_file,
    program_fixture,
    refusal_of,
    reseal,
    saved_fixture,
    states_fixture,
    with_members,
)

from sacformer_jax import CheckpointError, stored
from sacformer_jax.checkpoint import FORMAT, CheckpointWriter, RunFolder
from sacformer_jax.digests import digest
from sacformer_jax.train import Program, make_program, policy_of
from sacformer_jax.types import TrainState

# --- damage --------------------------------------------------------------------------------------


def _largest(step: Path) -> Path:
    return max((step / "state").rglob("d/*"), key=lambda path: path.stat().st_size)


def _manifest(step: Path) -> Path:
    return step / "state" / "manifest.ocdbt"


DAMAGES: dict[str, Callable[[Path], Any]] = {
    "state, bits at 10%": lambda step: flip(_largest(step), 0.1),
    "state, bits at 40%": lambda step: flip(_largest(step), 0.4),
    "state, bits at 70%": lambda step: flip(_largest(step), 0.7),
    "state, truncated": lambda step: cut(_largest(step), 0.5),
    "state, emptied": lambda step: cut(_largest(step), 0),
    "state, file missing": lambda step: _largest(step).unlink(),
    "state, all missing": lambda step: shutil.rmtree(step / "state"),
    "manifest, bits": lambda step: flip(_manifest(step), 0.5),
    "manifest, truncated": lambda step: cut(_manifest(step), 0.5),
    "manifest, emptied": lambda step: cut(_manifest(step), 0),
    "manifest, missing": lambda step: _manifest(step).unlink(),
    "metadata, first bit": lambda step: flip_bits(metadata_file(step), 0, 1),
    "metadata, a bit at 20%": lambda step: flip_bits(
        metadata_file(step), int(0.2 * metadata_file(step).stat().st_size), 1
    ),
    "metadata, format": lambda step: metadata_file(step).write_text(
        metadata_file(step).read_text().replace('"format": 2', '"format": 3')
    ),
    "metadata, steps": lambda step: metadata_file(step).write_text(
        metadata_file(step).read_text().replace(f'"env_steps": {NEW}', f'"env_steps": {NEW + 1}')
    ),
    "metadata, truncated": lambda step: cut(metadata_file(step), 0.5),
    "metadata, emptied": lambda step: cut(metadata_file(step), 0),
    "metadata, other JSON": lambda step: metadata_file(step).write_text("[]"),
    "metadata, missing": lambda step: shutil.rmtree(step / "metadata"),
    "metadata, of another step": lambda step: shutil.copy(
        metadata_file(step.with_name(str(OLD))), metadata_file(step)
    ),
    "everything missing": lambda step: [shutil.rmtree(path) for path in step.glob("*/")],
}


@pytest.mark.parametrize("damage", list(DAMAGES))
def test_damage_gives_the_checkpoint_before(
    copy: RunFolder, states: dict[int, TrainState], abstract: TrainState, damage: str
) -> None:
    step = copy.path / "checkpoints" / str(NEW)
    DAMAGES[damage](step)
    damaged = {name.split("checkpoints")[1]: content for name, content in contents_of(step).items()}
    restored = copy.restore(abstract)
    assert digest(restored.state) == digest(states[OLD])
    assert restored.progress == PROGRESS[OLD]
    (line,) = restored.moved_aside
    moved = copy.path / "damaged" / str(NEW)
    assert line.startswith(f"checkpoint {step} is damaged (")
    assert line.endswith(f": moved to {moved}")
    assert "\n" not in line
    assert checkpoint_names(copy) == [str(OLD)]
    now = {name.split("damaged")[1]: content for name, content in contents_of(moved).items()}
    assert now == damaged  # nothing of it is lost
    assert copy.restore(abstract).moved_aside == ()


@pytest.mark.parametrize(
    "kind",
    ["bits", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("emptied", "missing"))],
)
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
            flip(path, 0.5)
        elif kind == "emptied":
            cut(path, 0)
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
    content = metadata_file(step).read_bytes()
    rng = np.random.default_rng(0)
    for place in [*range(60), *rng.integers(0, len(content), 200)]:
        flipped = bytearray(content)
        flipped[place] ^= 1 << rng.integers(0, 8)
        metadata_file(step).write_bytes(bytes(flipped))
        with pytest.raises(stored.DamagedError):
            stored.read_metadata(step)


def test_the_leaf_that_differs_is_named(copy: RunFolder, abstract: TrainState) -> None:
    def change(metadata: dict[str, Any]) -> None:
        metadata["items"]["state"][".buffer.steps.reward"]["digest"] = "0" * 64

    reseal(copy.path / "checkpoints" / str(NEW), change)
    (line,) = copy.restore(abstract).moved_aside
    assert "the digest of state.buffer.steps.reward differs" in line


def test_when_all_are_damaged_that_is_what_it_says(copy: RunFolder, abstract: TrainState) -> None:
    """Each time it is asked: without checkpoints it would be a run that starts from the beginning,
    over its metrics and best policies.
    """
    for step in (OLD, NEW):
        cut(metadata_file(copy.path / "checkpoints" / str(step)), 0.3)
    before = contents_of(copy.path)
    for _ in range(2):
        with pytest.raises(CheckpointError) as refused:
            copy.restore(abstract)
        message = message_of(refused)
        assert "no checkpoint left that is good" in message
        for step in (OLD, NEW):
            assert str(copy.path / "checkpoints" / str(step)) in message
    assert contents_of(copy.path) == before
    assert copy.latest_step() == NEW


@pytest.mark.parametrize("what", ["metadata", "arrays"])
@pytest.mark.parametrize("number", [errno.EMFILE, errno.ESTALE, errno.ETIMEDOUT, errno.EACCES])
def test_what_may_be_read_another_time_is_not_damaged(
    copy: RunFolder, abstract: TrainState, monkeypatch: pytest.MonkeyPatch, number: int, what: str
) -> None:
    read = Path.read_text

    def read_text(path: Path, *arguments: Any) -> str:
        if path.name == "metadata":
            raise OSError(number, os.strerror(number))
        return read(path, *arguments)

    def restore(*_: Any, **__: Any) -> Any:
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patch:
        if what == "metadata":
            patch.setattr(Path, "read_text", read_text)
        else:
            patch.setattr(ocp.StandardCheckpointHandler, "restore", restore)
        with pytest.raises(CheckpointError, match="cannot be read") as refused:
            copy.restore(abstract)
    assert os.strerror(number) in message_of(refused)
    assert checkpoint_names(copy) == [str(OLD), str(NEW)]
    assert not copy.restore(abstract).moved_aside


def test_a_step_damaged_twice_is_kept_twice(
    copy: RunFolder, program: Program, states: dict[int, TrainState], abstract: TrainState
) -> None:
    for name in (str(NEW), f"{NEW}-2", f"{NEW}-3"):
        cut(metadata_file(copy.path / "checkpoints" / str(NEW)), 0.3)
        (line,) = copy.restore(abstract).moved_aside
        assert line.endswith(str(copy.path / "damaged" / name))
        with CheckpointWriter(copy, program.config) as writer:
            writer.save(states[NEW], policy_of(states[NEW]), PROGRESS[NEW])
    assert digest(copy.restore(abstract).state) == digest(states[NEW])


def test_a_damaged_checkpoint_that_cannot_be_moved(copy: RunFolder, abstract: TrainState) -> None:
    (copy.path / "damaged").write_text("in the way")
    cut(metadata_file(copy.path / "checkpoints" / str(NEW)), 0.3)
    with pytest.raises(CheckpointError, match="cannot be moved") as refused:
        copy.restore(abstract)
    message_of(refused)
    assert copy.steps() == [OLD, NEW]


# --- not damage ----------------------------------------------------------------------------------


def test_a_checkpoint_of_another_version_is_refused(copy: RunFolder, abstract: TrainState) -> None:
    step = copy.path / "checkpoints" / str(NEW)
    reseal(step, lambda metadata: metadata.update(format=FORMAT + 1, version="9.8.7"))
    message = refusal_of(copy, abstract)
    assert f"format {FORMAT + 1}" in message
    assert "9.8.7" in message


def test_a_checkpoint_with_settings_unknown_here_is_refused(
    copy: RunFolder, abstract: TrainState
) -> None:
    step = copy.path / "checkpoints" / str(NEW)
    reseal(step, lambda metadata: metadata["config"].update(unheard_of=1, version="9.8.7"))
    assert "unheard_of" in refusal_of(copy, abstract)


def test_another_shape_is_refused(copy: RunFolder, program: Program) -> None:
    wider = make_program(program.config.replace(buffer_capacity=3000))
    shapes = with_members(jax.eval_shape(wider.init, jax.random.key(0)))
    message = refusal_of(copy, shapes)
    assert "float32[2, 2, 1000, 11]" in message
    assert "float32[2, 2, 1500, 11]" in message
    assert ".buffer.steps.obs" in message


def test_other_leaves_are_refused(copy: RunFolder, abstract: TrainState) -> None:
    assert "for .key it has no such array" in refusal_of(
        copy, dataclasses.replace(abstract, key=abstract.counters.updates)
    ).replace("key<fry>[2]", "no such array")
    more = dataclasses.replace(abstract, context={"new": abstract.counters.updates})
    assert "for .context['new'] it has no such array, the program int32[2]" in refusal_of(
        copy, more
    )
    fewer = dataclasses.replace(abstract, context=None)
    message = refusal_of(copy, fewer)
    assert "for .context.obs it has float32[2, 2, " in message
    assert "the program no such array" in message


def test_another_number_of_members_is_refused(copy: RunFolder, program: Program) -> None:
    shapes = with_members(jax.eval_shape(program.init, jax.random.key(0)), 3)
    assert "does not fit" in refusal_of(copy, shapes)


def test_other_block_axes_are_refused(copy: RunFolder, abstract: TrainState, axes: Any) -> None:
    others = jax.tree.map(lambda _: 1, axes)
    assert "was divided along 2 axes, not 1" in refusal_of(copy, abstract, block_axes=others)


def _set_config(folder: RunFolder, section: str, **fields: Any) -> None:
    path = folder.path / "config.json"
    contents = json.loads(path.read_text())
    (contents["config"][section] if section else contents["config"]).update(fields)
    path.write_text(json.dumps(contents))


@pytest.mark.parametrize(
    ("section", "field", "value", "was"),
    [
        ("learning", "tau", 0.5, "0.005"),
        ("actor", "actor_width", 16, "8"),
        ("", "seeds", 2, "(4, 9)"),
    ],
)
def test_a_changed_config_is_refused(
    copy: RunFolder, abstract: TrainState, section: str, field: str, value: Any, was: str
) -> None:
    _set_config(copy, section, **{field: value})
    message = refusal_of(copy, abstract)
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
        assert "cannot be read" in refusal_of(copy, abstract)


# --- a folder in the way -----------------------------------------------------------------------


@pytest.mark.parametrize("seen", ["before", "by Orbax"])
def test_a_folder_that_can_no_longer_be_written(
    copy: RunFolder,
    program: Program,
    states: dict[int, TrainState],
    abstract: TrainState,
    monkeypatch: pytest.MonkeyPatch,
    seen: str,
) -> None:
    """Orbax's threads would wait 20 minutes for a folder that could not be made."""
    if seen == "by Orbax":
        monkeypatch.setattr(CheckpointWriter, "_check_writable", lambda writer: None)
    path, aside = copy.path / "checkpoints", copy.path / "aside"
    progress = dataclasses.replace(PROGRESS[OLD], env_steps=400)
    with CheckpointWriter(copy, program.config) as writer:
        writer.save(states[OLD], policy_of(states[OLD]), progress)
        writer.wait()
        path.rename(aside)
        path.write_text("in the way")
        start = time.monotonic()
        progress = dataclasses.replace(progress, env_steps=500)

        def save() -> None:
            writer.save(states[NEW], policy_of(states[NEW]), progress)
            writer.wait()

        with pytest.raises(CheckpointError, match="500 could not be saved") as refused:
            save()
        assert time.monotonic() - start < 15
        assert not [one for one in threading.enumerate() if "orbax" in type(one).__module__]
        message_of(refused)
        path.unlink()
        aside.rename(path)
        save()
    assert checkpoint_names(copy) == ["400", "500"]
    assert digest(copy.restore(abstract).state) == digest(states[NEW])


# --- what is printed -----------------------------------------------------------------------------


@pytest.mark.parametrize(("error", "line"), [
    (OSError(errno.ENOSPC, "No space left on device"), "No space left on device"),
    (ValueError("UNKNOWN: Error writing x [OS error 28: ...] and on"), "No space left on device"),
    (Exception("No (slice(0, 2, 1)). See full TensorStore details: <bound method\n{\n})>."),
     "No (slice(0, 2, 1))"),
    (Exception("See full TensorStore details: <bound"), "Exception"),
    (ValueError("one\ntwo"), "one"),
    (ValueError("x" * 300), "x" * 200),
    (KeyError(), "KeyError"),
])  # fmt: skip
def test_what_an_error_says(error: Exception, line: str) -> None:
    assert stored.one_line(error) == line
    outer = RuntimeError("outer")
    outer.__cause__ = error
    assert stored.one_line(outer) == line


class _Careless:
    """Raises where nobody can catch it."""

    def __del__(self) -> None:
        raise ZeroDivisionError


async def _forever() -> None:
    await asyncio.Event().wait()


def test_silence_is_about_nothing_else(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    seen: list[Any] = []

    def hook(raised: Any) -> None:
        seen.append(raised.exc_type)

    monkeypatch.setattr(sys, "unraisablehook", hook)
    filters = list(logging.getLogger("asyncio").filters)
    with stored.Silence():
        _Careless()
        with stored.Silence():
            _Careless()
        loop = asyncio.new_event_loop()
        tasks = [loop.create_task(_forever())]
        loop.run_until_complete(asyncio.sleep(0.0))
        loop.close()
        tasks.clear()
        gc.collect()
        with pytest.raises(RuntimeError, match="Event loop is closed"):
            loop.call_soon_threadsafe(print)
    assert seen == [ZeroDivisionError] * 2
    assert "Task was destroyed but it is pending" in caplog.text
    assert sys.unraisablehook is hook
    assert logging.getLogger("asyncio").filters == filters

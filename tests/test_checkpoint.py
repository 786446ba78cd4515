"""Checkpoints: digests, round trips bit for bit, damage that must not pass unseen."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sacformer_jax import CheckpointError, Config, Program, make_program, policy_of
from sacformer_jax.checkpoint import FORMAT, KEEP, Progress, RunFolder, digest, num_bytes
from sacformer_jax.runner import sources_of
from sacformer_jax.types import TrainState

STEP = 200


@pytest.fixture(scope="module")
def program() -> Program:
    # SAC's networks compile fastest; what is in the state does not matter here.
    return make_program(
        Config.from_preset(
            "cpu", agent="sac", env="Hopper", num_envs=2, max_episode_steps=50,
            prefill_env_steps=200, total_env_steps=600, actor_width=8, actor_layers=1,
            critic_width=8, batch_size=4, buffer_capacity=2000, updates_per_env_step=1.0,
        )
    )  # fmt: skip


@pytest.fixture(scope="module")
def state(program: Program) -> TrainState:
    """A train state whose every leaf holds something else than zeros."""
    rng = np.random.default_rng(0)

    def filled(leaf: jax.Array) -> jax.Array:
        if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return jax.random.key(123)
        if leaf.dtype == jnp.bool_:
            return jnp.asarray(rng.random(leaf.shape) < 0.5)
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            return jnp.asarray(rng.normal(size=leaf.shape), leaf.dtype)
        return jnp.asarray(rng.integers(0, 2**31, leaf.shape), leaf.dtype)

    return jax.tree.map(filled, program.init(jax.random.key(0)))


@pytest.fixture(scope="module")
def abstract(program: Program) -> TrainState:
    return jax.eval_shape(program.init, jax.random.key(0))


@pytest.fixture(scope="module")
def saved(
    program: Program, state: TrainState, tmp_path_factory: pytest.TempPathFactory
) -> RunFolder:
    """A run folder with one checkpoint and a best policy; not to be changed."""
    folder = RunFolder(tmp_path_factory.mktemp("saved"))
    folder.create(program.config, sources_of(program.config), program.env.spec)
    folder.save(state, policy_of(state), Progress(STEP, 77, 1.25))
    folder.save_best(policy_of(state), STEP, 1.25)
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


def _flip_bits(path: Path, start: int, count: int = 16) -> None:
    """Flips one bit in each of ``count`` bytes in a row."""
    content = bytearray(path.read_bytes())
    for i in range(start, start + count):
        content[i] ^= 1 << i % 8
    path.write_bytes(bytes(content))


# --- digest ------------------------------------------------------------------------------------

TREE = {
    "weights": np.arange(6, dtype=np.float32).reshape(2, 3),
    "count": np.int32(4),
    "mask": np.array([True, False]),
    "nested": [np.zeros(2, np.float32), {"key": jax.random.key(0)}],
}


def _changed(**leaves: Any) -> dict[str, Any]:
    return {**TREE, **leaves}


def test_digest_is_equal_for_equal_trees() -> None:
    assert len(digest(TREE)) == 64
    assert int(digest(TREE), 16) >= 0
    again = jax.tree.map(lambda x: x if isinstance(x, jax.Array) else jnp.asarray(x), TREE)
    assert digest(again) == digest(TREE)  # NumPy or JAX arrays
    strided = np.asfortranarray(TREE["weights"])
    assert digest(_changed(weights=strided)) == digest(TREE)


@pytest.mark.parametrize(
    "other",
    [
        _changed(weights=np.arange(6, dtype=np.float32).reshape(2, 3) + np.float32(1e-6)),
        _changed(weights=np.arange(6, dtype=np.float32).reshape(3, 2)),
        _changed(weights=np.arange(6, dtype=np.float32).reshape(2, 3).view(np.int32)),
        _changed(weights=np.arange(6, dtype=np.float64).reshape(2, 3)),
        _changed(weights=np.array([[-0.0, 1, 2], [3, 4, 5]], np.float32)),
        _changed(count=np.int32(5)),
        _changed(count=np.uint32(4)),
        _changed(mask=np.array([True, True])),
        _changed(mask=np.array([1, 0], np.int8)),
        _changed(nested=[np.zeros(2, np.float32), {"key": jax.random.key(1)}]),
        _changed(nested=[np.zeros(2, np.float32), {"key": jax.random.key(0, impl="rbg")}]),
        _changed(nested=[np.zeros(2, np.float32), {"other": jax.random.key(0)}]),
        _changed(nested=[np.zeros(3, np.float32), {"key": jax.random.key(0)}]),
        _changed(more=np.zeros(1)),
        {name: leaf for name, leaf in TREE.items() if name != "mask"},
    ],
)
def test_digest_sees_every_change(other: Any) -> None:
    assert digest(other) != digest(TREE)


def test_digest_tells_a_scalar_from_an_array_of_one() -> None:
    assert digest({"count": np.int32(4)}) != digest({"count": np.array([4], np.int32)})


def test_digest_takes_bfloat16() -> None:
    assert digest(jnp.ones(2, jnp.bfloat16)) != digest(jnp.zeros(2, jnp.bfloat16))


def test_digest_sees_every_leaf_of_a_train_state(state: TrainState) -> None:
    leaves, structure = jax.tree.flatten(state)
    digests = {digest(state)}
    for i, leaf in enumerate(leaves):
        if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            other = jax.random.key(124)
        else:
            array = np.array(leaf)
            array.reshape(-1).view(np.uint8)[-1] ^= 1
            other = array
        digests.add(digest(jax.tree.unflatten(structure, [*leaves[:i], other, *leaves[i + 1 :]])))
    assert len(digests) == len(leaves) + 1


def test_num_bytes() -> None:
    # 6 floats, an int32, 2 bools, 2 floats; the key is not counted.
    assert num_bytes(TREE) == 24 + 4 + 2 + 8


# --- round trip --------------------------------------------------------------------------------


def test_restore_is_bit_for_bit(saved: RunFolder, state: TrainState, abstract: TrainState) -> None:
    restored = saved.restore(abstract)
    assert restored.progress == Progress(STEP, 77, 1.25)
    assert jax.tree.structure(restored.state) == jax.tree.structure(state)
    for old, new in zip(jax.tree.leaves(state), jax.tree.leaves(restored.state), strict=True):
        assert old.dtype == new.dtype
        if jax.dtypes.issubdtype(old.dtype, jax.dtypes.prng_key):
            old, new = jax.random.key_data(old), jax.random.key_data(new)
        assert np.array(old).tobytes() == np.array(new).tobytes()
    assert digest(restored.state) == digest(state)


@pytest.mark.parametrize("which", ["best", "latest"])
def test_restore_policy(saved: RunFolder, program: Program, state: TrainState, which: str) -> None:
    assert digest(saved.restore_policy(program.agent, which)) == digest(policy_of(state))


def test_no_best_return_yet_is_kept_as_none(
    copy: RunFolder, state: TrainState, abstract: TrainState
) -> None:
    copy.save(state, policy_of(state), Progress(STEP + 100, 80, None))
    assert copy.restore(abstract).progress == Progress(STEP + 100, 80, None)


def test_only_the_newest_checkpoints_are_kept(
    copy: RunFolder, state: TrainState, abstract: TrainState
) -> None:
    counters = dataclasses.replace(state.counters, env_steps=jnp.int32(400))
    newer = dataclasses.replace(state, counters=counters)
    for step in (300, 400):
        copy.save(newer, policy_of(newer), Progress(step, 0, None))
    kept = sorted(int(path.name) for path in (copy.path / "checkpoints").iterdir())
    assert kept == [STEP, 300, 400][-KEEP:]
    assert copy.latest_step() == 400
    assert digest(copy.restore(abstract).state) == digest(newer)


def test_saving_a_step_again_changes_nothing(
    copy: RunFolder, state: TrainState, abstract: TrainState
) -> None:
    copy.save(state, policy_of(state), Progress(STEP, 0, None))
    assert copy.restore(abstract).progress == Progress(STEP, 77, 1.25)


def test_only_one_best_policy_is_kept(copy: RunFolder, program: Program, state: TrainState) -> None:
    policy = dataclasses.replace(policy_of(state), target_return=jnp.float32(9.0))
    copy.save_best(policy, 300, 2.0)
    assert [path.name for path in (copy.path / "best").iterdir()] == ["300"]
    assert digest(copy.restore_policy(program.agent, "best")) == digest(policy)


def test_config_and_spec_are_read_back(saved: RunFolder, program: Program) -> None:
    assert saved.opened() is saved
    assert saved.read_config().config == program.config
    assert set(saved.read_config().sources) == set(program.config.flat())
    assert saved.read_spec() == program.env.spec


# --- damage ------------------------------------------------------------------------------------


@pytest.mark.parametrize("where", [0.1, 0.3, 0.5, 0.7])
def test_flipped_bits_in_the_state_are_detected(
    copy: RunFolder, abstract: TrainState, where: float
) -> None:
    files = [path for path in (copy.path / "checkpoints" / str(STEP)).rglob("*") if path.is_file()]
    largest = max(files, key=lambda path: path.stat().st_size)
    assert "state" in largest.parts
    _flip_bits(largest, int(where * largest.stat().st_size))
    with pytest.raises(CheckpointError) as refused:
        copy.restore(abstract)
    message = _message(refused)
    assert str(copy.path / "checkpoints" / str(STEP)) in message
    assert "damaged" in message
    assert "fall back" in message


def test_a_digest_that_differs_is_refused(copy: RunFolder, abstract: TrainState) -> None:
    path = copy.path / "checkpoints" / str(STEP) / "metadata" / "metadata"
    metadata = json.loads(path.read_text())
    path.write_text(json.dumps({**metadata, "state_digest": "0" * 64}))
    with pytest.raises(CheckpointError, match="is damaged"):
        copy.restore(abstract)


@pytest.mark.parametrize(("which", "folder"), [("best", "best"), ("latest", "checkpoints")])
def test_a_damaged_policy_is_detected(
    copy: RunFolder, program: Program, which: str, folder: str
) -> None:
    path = copy.path / folder / str(STEP) / "metadata" / "metadata"
    metadata = json.loads(path.read_text())
    path.write_text(json.dumps({**metadata, "policy_digest": "0" * 64}))
    with pytest.raises(CheckpointError) as refused:
        copy.restore_policy(program.agent, which)
    message = _message(refused)
    assert "damaged" in message
    assert ("latest" if which == "best" else "best") in message


def test_the_checkpoint_before_a_damaged_one_can_be_restored(
    copy: RunFolder, state: TrainState, abstract: TrainState
) -> None:
    copy.save(state, policy_of(state), Progress(300, 99, 2.0))
    newest = copy.path / "checkpoints" / "300"
    for path in newest.rglob("metadata/metadata"):
        path.write_text("{")
    with pytest.raises(CheckpointError) as refused:
        copy.restore(abstract)
    assert str(newest) in _message(refused)
    shutil.rmtree(newest)  # what the message says
    assert copy.restore(abstract).progress.env_steps == STEP


def test_a_missing_array_file_is_refused(copy: RunFolder, abstract: TrainState) -> None:
    state_folder = copy.path / "checkpoints" / str(STEP) / "state"
    max(state_folder.rglob("d/*"), key=lambda path: path.stat().st_size).unlink()
    with pytest.raises(CheckpointError) as refused:
        copy.restore(abstract)
    assert str(STEP) in _message(refused)


def test_another_shape_is_refused(copy: RunFolder, program: Program) -> None:
    wider = make_program(program.config.replace(actor_width=16))
    with pytest.raises(CheckpointError) as refused:
        copy.restore(jax.eval_shape(wider.init, jax.random.key(0)))
    assert str(STEP) in _message(refused)


# --- the folder --------------------------------------------------------------------------------


@pytest.mark.parametrize("content", ["", "{", "[]", "7", '{"config": {}}'])
def test_a_damaged_config_is_refused(copy: RunFolder, content: str) -> None:
    (copy.path / "config.json").write_text(content)
    for read in (copy.read_config, copy.read_spec):
        with pytest.raises(CheckpointError, match="damaged") as refused:
            read()
        assert "config.json" in _message(refused)


@pytest.mark.parametrize("content", [b'{"format": 1}', b"\xff\xfe{}"])
def test_a_config_without_its_parts_is_refused(copy: RunFolder, content: bytes) -> None:
    (copy.path / "config.json").write_bytes(content)
    with pytest.raises(CheckpointError, match="damaged"):
        copy.read_config()


def test_another_format_is_refused(copy: RunFolder) -> None:
    path = copy.path / "config.json"
    values = json.loads(path.read_text())
    path.write_text(json.dumps({**values, "format": FORMAT + 1, "version": "9.8.7"}))
    with pytest.raises(CheckpointError) as refused:
        copy.read_config()
    message = _message(refused)
    assert f"format {FORMAT + 1}" in message
    assert "9.8.7" in message


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
    folder.create(program.config, sources_of(program.config), program.env.spec)
    assert folder.latest_step() is None
    with pytest.raises(CheckpointError, match="no checkpoint yet"):
        folder.restore(abstract)
    for which in ("best", "latest"):
        with pytest.raises(CheckpointError, match=f"no {which} policy yet"):
            folder.restore_policy(program.agent, which)
    with pytest.raises(CheckpointError, match="'worst'"):
        folder.restore_policy(program.agent, "worst")


def test_a_run_is_not_created_over_another(saved: RunFolder, program: Program) -> None:
    before = (saved.path / "config.json").read_bytes()
    with pytest.raises(CheckpointError) as refused:
        saved.create(program.config.replace(seed=9), {}, program.env.spec)
    assert f"sacformer resume {saved.path}" in _message(refused)
    assert (saved.path / "config.json").read_bytes() == before


def test_a_folder_that_cannot_be_written_is_refused(program: Program, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(CheckpointError) as refused:
        RunFolder(tmp_path / "file" / "run").create(program.config, {}, program.env.spec)
    message = _message(refused)
    assert str(tmp_path / "file" / "run") in message
    assert "cannot be written" in message

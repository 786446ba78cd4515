"""Members taken out of a run: the same states, metrics and policies, on their own."""

from __future__ import annotations

import errno
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_devices import TINY
from trees import unequal

from sacformer_jax import (
    CheckpointError,
    Config,
    ConfigError,
    Member,
    extract,
    load_policy,
    make_population,
    resume,
    train,
)
from sacformer_jax.checkpoint import RunFolder
from sacformer_jax.cli import main
from sacformer_jax.logging import read_records
from sacformer_jax.population import member_state

MEMBERS = (Member("slow", 4, {"actor_learning_rate": 1e-5}), Member("fast", 4, {"discount": 0.9}))


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("runs") / "seeds"
    config = Config.from_preset("cpu", **TINY, total_env_steps=400, seeds=[5, 0, 2])
    return train(config.replace(run_dir=str(path)), quiet=True).path


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("runs") / "swept"
    config = Config.from_preset("cpu", **TINY, total_env_steps=400, run_dir=str(path))
    return train(config, members=MEMBERS, quiet=True).path


def _states(path: Path) -> list[Any]:
    """The train state of each member, and the run's progress."""
    folder = RunFolder(path)
    run = folder.read_config()
    population = make_population(run.config, run.members)
    restored = folder.restore(population.abstract(), population.block_axes, move_aside=False)
    places = range(len(run.members))
    return [member_state(population, restored.state, i) for i in places] + [restored.progress]


def test_one_seed_becomes_a_run_like_any_other(seeds: Path, tmp_path: Path) -> None:
    path = extract(seeds, [0], tmp_path / "one")
    (state, progress), before = _states(path), _states(seeds)
    assert unequal(state, before[1]) == {}
    assert progress.best == (before[-1].best[1],)
    assert RunFolder(path).read_config().config == RunFolder(seeds).read_config().config.replace(
        seed=0, seeds=1, run_dir=str(path)
    )
    metrics = (path / "metrics.jsonl").read_bytes()
    assert metrics == (seeds / "seed-0" / "metrics.jsonl").read_bytes()
    for which in ("best", "latest"):
        assert unequal(load_policy(path, which).state, load_policy(seeds, which, 0).state) == {}
    assert resume(path, 600, quiet=True).env_steps == 600
    assert (path / "metrics.jsonl").read_bytes().startswith(metrics)
    assert read_records(path / "metrics.jsonl", "eval")[-1]["env_steps"] == 600


@pytest.mark.slow
def test_some_seeds_in_another_order(seeds: Path, tmp_path: Path) -> None:
    path = extract(seeds, ["seed-2", 5], tmp_path / "two")
    after, before = _states(path), _states(seeds)
    assert unequal(after[0], before[2]) == {}
    assert unequal(after[1], before[0]) == {}
    assert RunFolder(path).read_config().config.all_seeds == (2, 5)
    result = resume(path, 600, quiet=True)
    assert {record["member"] for record in result.evaluations} == {"seed-2", "seed-5"}


def test_a_member_with_its_own_settings_keeps_them(swept: Path, tmp_path: Path) -> None:
    path = extract(swept, ["fast"], tmp_path / "fast")
    run = RunFolder(path).read_config()
    assert run.config.learning.discount == 0.9
    assert run.config.seed == 4
    assert run.members == (Member("fast", 4),)
    state, _ = _states(path)
    assert float(state.hyper.discount) == np.float32(0.9)
    # The policy of a member has its settings in its configuration, taken out or not.
    assert load_policy(swept, "latest", "fast").config.learning.discount == 0.9
    resume(path, 600, quiet=True)


def test_both_members_of_a_sweep(swept: Path, tmp_path: Path) -> None:
    path = extract(swept, ["fast", "slow"], tmp_path / "both")
    assert RunFolder(path).read_config().members == (MEMBERS[1], MEMBERS[0])
    assert resume(path, 600, quiet=True).env_steps == 600


def test_what_cannot_be_taken_out(seeds: Path, swept: Path, tmp_path: Path) -> None:
    to = tmp_path / "to"
    with pytest.raises(ConfigError, match=r"member=7: there is none such; the run has seed-5"):
        extract(seeds, [7], to)
    with pytest.raises(ConfigError, match="several such"):
        extract(swept, [4], to)
    with pytest.raises(ConfigError, match="at least one, and each once"):
        extract(seeds, [0, "seed-0"], to)
    with pytest.raises(ConfigError, match="at least one"):
        extract(seeds, [], to)
    assert not to.exists()
    with pytest.raises(CheckpointError, match="holds a run already"):
        extract(seeds, [0], swept)
    begun = tmp_path / "begun"  # of a run that has no checkpoint yet
    begun.mkdir()
    (begun / "config.json").write_text("{}")
    with pytest.raises(CheckpointError, match="holds a run already"):
        extract(seeds, [0], begun)
    assert (begun / "config.json").read_text() == "{}"
    with pytest.raises(ConfigError, match="several; say which: seed-5, seed-0, seed-2"):
        load_policy(seeds)


def test_a_run_that_cannot_be_written_as_a_whole_is_not_there(
    seeds: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without its checkpoint it would be a run that starts from the beginning."""

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(shutil, "copytree", full)
    with pytest.raises(CheckpointError, match="No space left on device"):
        extract(seeds, [0], tmp_path / "to")
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_moved_to_its_place_leaves_it_empty(
    seeds: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rename = Path.rename

    def failing(path: Path, target: Path) -> Path:
        if path.name == "config.json" and path.parent.name == ".new":
            assert (
                path.parent.parent / "checkpoints" / "400"
            ).is_dir()  # what makes it a run is last
            raise OSError(errno.EIO, "Input/output error")
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", failing)
    with pytest.raises(CheckpointError, match=rf"to='{tmp_path}' cannot be .*Input/output error"):
        extract(seeds, [0], tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_into_a_link_in_which_nothing_was_finished(seeds: Path, tmp_path: Path) -> None:
    """Where a mount or link is, no other folder can be put; what a kill left is no run."""
    (tmp_path / "disk" / ".new" / "checkpoints").mkdir(parents=True)
    (tmp_path / "link").symlink_to("disk")
    path = extract(seeds, [0, 2], tmp_path / "link")
    assert not (path / ".new").exists()
    assert (tmp_path / "link").is_symlink()
    run = RunFolder(tmp_path / "disk")
    assert run.read_config().config.all_seeds == (0, 2)
    assert run.latest_step() == 400
    assert (tmp_path / "disk" / "seed-2" / "best").is_dir()


def test_a_folder_that_cannot_be_made_is_named(seeds: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(CheckpointError, match=rf"to='{tmp_path}/file/to' cannot be written"):
        extract(seeds, [0], tmp_path / "file" / "to")


def test_a_folder_that_cannot_be_read_is_named(
    seeds: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def forbidden(_: Path) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "iterdir", forbidden)
    with pytest.raises(CheckpointError, match=rf"to='{tmp_path}' cannot be .*Permission denied"):
        extract(seeds, [0], tmp_path)


def test_it_is_known_what_the_members_were_split_over(seeds: Path, tmp_path: Path) -> None:
    """Resuming from the command line takes as many devices again, or says that it does not."""
    known = RunFolder(seeds).latest_devices()
    assert known == {"members": 1, "data": 1}
    assert RunFolder(extract(seeds, [0, 2], tmp_path / "two")).latest_devices() == known


def test_from_the_command_line(
    seeds: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["extract", str(seeds), "--members", "5", "2", "--to", str(tmp_path / "to")]) == 0
    assert f"sacformer resume {tmp_path / 'to'}" in capsys.readouterr().out
    assert RunFolder(tmp_path / "to").read_config().config.all_seeds == (5, 2)
    assert main(["evaluate", str(seeds), "--episodes", "2"]) == 0
    said = capsys.readouterr().out
    assert [line.split()[3] for line in said.splitlines()[1:]] == ["seed-5", "seed-0", "seed-2"]
    assert main(["evaluate", str(seeds), "--episodes", "2", "--member", "2", "--json"]) == 0
    said = capsys.readouterr().out
    assert '"member": "2"' in said
    assert said.count("\n") == 1

"""One run on several devices and processes, stopped and continued on others."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from describing import described

from sacformer_jax import Config, load_policy, resume, train
from sacformer_jax.cli import main
from sacformer_jax.cores import usable_cores
from sacformer_jax.logging import read_records

TINY = {
    "env": "Hopper", "agent": "sac", "num_envs": 2, "max_episode_steps": 50,
    "prefill_env_steps": 200, "chunk_env_steps": 100, "eval_every": 200, "eval_episodes": 2,
    "checkpoint_every": 200, "actor_width": 8, "actor_layers": 1, "critic_width": 8,
    "batch_size": 4, "buffer_capacity": 2000, "updates_per_env_step": 0.5, "normalize_obs": True,
}  # fmt: skip
STOP, TOTAL = 400, 600


def _environment(num_devices: int | None) -> dict[str, str]:
    """Of a process with so many devices; None: with those that the command line chooses."""
    if num_devices is None:
        return dict(os.environ)
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count={num_devices}"
    return {**os.environ, "XLA_FLAGS": flags}


def _start(num_devices: int | None, *args: object) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "sacformer_jax.cli", *map(str, args)],
        env=_environment(num_devices),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def _finish(process: subprocess.Popen[str], code: int = 0) -> str:
    try:
        out, err = process.communicate(timeout=240)
    finally:
        process.kill()
    assert process.returncode == code, err[-3000:]
    return out


def _sacformer(num_devices: int | None, *args: object) -> str:
    return _finish(_start(num_devices, *args))


def _copy(run: Path, to: Path) -> Path:
    shutil.copytree(run, to)
    return to


def _digest(run: Path, num_devices: int = 1) -> Any:
    """Env steps and digest, as ``describe`` says in this process, or in one with more devices."""
    if num_devices > 1:
        said = json.loads(_sacformer(num_devices, "describe", run, "--json"))
    else:
        said = described(run)
    return said["counters"]["env_steps"], said["digest"]


def _losses(run: Path) -> np.ndarray:
    """What the two seeds' lines of training say, ``[2, chunks, 2]``."""
    names = ("critic_loss", "entropy")
    return np.array(
        [
            [[r[n] for n in names] for r in read_records(run / seed / "metrics.jsonl", "train")]
            for seed in ("seed-0", "seed-1")
        ]
    )


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seeds trained on one device up to ``STOP``."""
    path = tmp_path_factory.mktemp("runs") / "stopped"
    config = Config.from_preset("cpu", **TINY, total_env_steps=STOP, seeds=2, run_dir=str(path))
    return train(config, quiet=True).path


@pytest.fixture(scope="module")
def straight(stopped: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same on one device to the end."""
    path = _copy(stopped, tmp_path_factory.mktemp("runs") / "straight")
    return resume(path, TOTAL, quiet=True).path


@pytest.fixture(scope="module")
def on_eight(stopped: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same, continued where there are eight devices: the seeds take two of them."""
    path = _copy(stopped, tmp_path_factory.mktemp("runs") / "eight")
    said = _sacformer(8, "resume", path, "--total-env-steps", TOTAL)
    assert "2 for the members times 1 for the data" in " ".join(said.split())
    assert f"resuming at  {STOP}" in said
    return path


def test_saved_on_one_device_and_restored_on_eight(straight: Path, on_eight: Path) -> None:
    np.testing.assert_allclose(_losses(on_eight), _losses(straight), rtol=1e-3)


def test_a_digest_does_not_depend_on_the_devices(on_eight: Path) -> None:
    assert _digest(on_eight, 8) == _digest(on_eight, 1)


def test_saved_on_eight_devices_and_restored_on_one(on_eight: Path, tmp_path: Path) -> None:
    path = _copy(on_eight, tmp_path / "run")
    assert resume(path, TOTAL + 200, quiet=True).env_steps == TOTAL + 200
    assert [r["env_steps"] for r in read_records(path / "seed-1" / "metrics.jsonl", "eval")] == [
        200, 400, 600, 800,
    ]  # fmt: skip
    obs = np.zeros(11, np.float32)
    for seed in (0, 1):  # a policy saved there acts here
        assert np.isfinite(load_policy(on_eight, "latest", seed).predict(obs)[0]).all()


def test_seeds_begun_on_one_device_stay_there(
    stopped: Path, straight: Path, tmp_path: Path
) -> None:
    path = _copy(stopped, tmp_path / "run")
    said = _sacformer(None, "resume", path, "--total-env-steps", TOTAL)
    assert "for the members" not in said  # neither of devices, nor that bits would differ
    assert _digest(path) == _digest(straight)


@pytest.mark.skipif(usable_cores() < 2, reason="a core for each of two seeds is what is tested")
def test_seeds_begun_on_cores_of_their_own_stay_there(straight: Path, tmp_path: Path) -> None:
    path = tmp_path / "run"
    devices = "devices 2 for the members times 1 for the data of each, 1 processes"
    assert devices in " ".join(_sacformer(None, "train", *_flags(path, STOP)).split())
    said = _sacformer(None, "resume", path, "--total-env-steps", TOTAL)
    assert devices in " ".join(said.split())
    assert "bit for bit" not in said
    np.testing.assert_allclose(_losses(path), _losses(straight), rtol=1e-3)


@pytest.mark.slow
def test_the_data_may_be_split_otherwise_on_the_way(stopped: Path, tmp_path: Path) -> None:
    path = _copy(stopped, tmp_path / "run")
    said = _sacformer(8, "resume", path, "--total-env-steps", TOTAL, "--data-devices", 2)
    assert "2 for the members times 2 for the data" in " ".join(said.split())
    assert np.isfinite(_losses(path)).all()
    assert _digest(path)[0] == TOTAL
    refused = _start(8, "resume", path, "--total-env-steps", 800, "--data-devices", 3)
    _, err = refused.communicate(timeout=120)
    assert refused.returncode == 2
    assert "data_devices=3: must be at least 1 and divide num_envs=2" in err


# --- processes ------------------------------------------------------------------------------------


def _free_port() -> int:
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        return int(listening.getsockname()[1])


def _two_processes(*args: object) -> list[str]:
    """What both print, in order."""
    meeting = ["--coordinator", f"127.0.0.1:{_free_port()}", "--num-processes", 2]
    processes = [_start(1, *args, *meeting, "--process-id", index) for index in (0, 1)]
    return [_finish(process) for process in processes]


def _flags(run: Path, total: int) -> list[object]:
    settings = {**TINY, "seeds": 2, "total_env_steps": total, "run_dir": run}
    flags: list[object] = []
    for name, value in settings.items():
        name = name.replace("_", "-")
        flags += [f"--{name}"] if value is True else [f"--{name}", value]
    return flags


def test_two_processes_train_one_run_and_one_continues_it(straight: Path, tmp_path: Path) -> None:
    path = tmp_path / "run"
    first, second = _two_processes("train", *_flags(path, STOP))
    assert "2 processes" in " ".join(first.split())
    assert "eval return" in first
    assert "eval return" not in second  # one talks and writes
    np.testing.assert_allclose(_losses(path), _losses(straight)[:, :2], rtol=1e-3)
    # Each wrote its own shards.
    shards = {p.name for p in (path / "checkpoints" / str(STOP) / "state").glob("ocdbt.process_*")}
    assert shards == {"ocdbt.process_0", "ocdbt.process_1"}
    assert resume(path, TOTAL, quiet=True).env_steps == TOTAL
    np.testing.assert_allclose(_losses(path), _losses(straight), rtol=1e-3)


@pytest.mark.slow
def test_two_processes_continue_what_one_began(
    straight: Path, stopped: Path, tmp_path: Path
) -> None:
    path = _copy(stopped, tmp_path / "run")
    _two_processes("resume", path, "--total-env-steps", TOTAL)
    np.testing.assert_allclose(_losses(path), _losses(straight), rtol=1e-3)
    assert _digest(path)[0] == TOTAL


@pytest.mark.parametrize(
    "flags",
    [["--coordinator", "127.0.0.1:1"], ["--num-processes", "2", "--process-id", "0"]],
    ids=lambda flags: flags[0],
)
def test_half_a_meeting_is_refused(
    tmp_path: Path, flags: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", *map(str, _flags(tmp_path / "run", STOP)), *flags]) == 2
    assert "give all three, or --distributed alone" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_processes_that_cannot_meet(tmp_path: Path) -> None:
    process = _start(1, "train", *_flags(tmp_path / "run", STOP), "--distributed")
    _, err = process.communicate(timeout=120)
    assert process.returncode == 2
    assert "the other processes cannot be found" in err
    assert not (tmp_path / "run").exists()

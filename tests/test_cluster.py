"""The job script for SLURM, with stand-ins for `srun` and `scontrol` that note their calls."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "experiments" / "cluster" / "slurm.sh"


def _submitted(tmp_path: Path, run: Path | None, code: int, *flags: str) -> tuple[int, list[str]]:
    """The script's exit code and the commands it gave, where training exits with ``code``."""
    calls = tmp_path / "calls"
    for name, exits in (("srun", code), ("scontrol", 0)):
        program = tmp_path / name
        program.write_text(f'#!/bin/sh\necho "{name} $*" >> "{calls}"\nexit {exits}\n')
        program.chmod(0o755)
    environment = {
        "PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}",
        "SLURM_JOB_ID": "42",
        **({"RUN": str(run)} if run else {}),
    }
    done = subprocess.run(
        ["bash", SCRIPT, *flags], env=environment, capture_output=True, text=True, check=False
    )
    return done.returncode, calls.read_text().splitlines() if calls.exists() else [done.stderr]


def test_the_first_time_it_trains(tmp_path: Path) -> None:
    run = tmp_path / "run"
    code, calls = _submitted(tmp_path, run, 0, "--env", "Ant", "--seeds", "8")
    assert code == 0
    assert calls == [f"srun sacformer train --run-dir {run} --env Ant --seeds 8 --distributed"]


@pytest.mark.parametrize(("exits", "requeued"), [(0, False), (1, False), (2, False), (3, True)])
def test_afterwards_it_resumes_and_goes_back_into_the_queue_only_if_it_was_stopped(
    tmp_path: Path, exits: int, requeued: bool
) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.json").write_text("{}")
    code, calls = _submitted(tmp_path, run, exits, "--env", "Ant")
    assert code == exits
    again = ["scontrol requeue 42"] if requeued else []
    assert calls == [f"srun sacformer resume {run} --distributed", *again]


def test_resuming_lies_on_the_same_devices(tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.json").write_text("{}")
    flags = ("--seeds", "2", "--data-devices", "4", "--env", "Ant", "--seed_devices=2")
    _, calls = _submitted(tmp_path, run, 0, *flags)
    assert calls == [f"srun sacformer resume {run} --data-devices 4 --seed_devices=2 --distributed"]


def test_it_asks_for_a_folder(tmp_path: Path) -> None:
    code, said = _submitted(tmp_path, None, 0)
    assert code != 0
    assert "set RUN to a folder that all nodes see" in said[0]


def test_the_code_is_that_of_the_command_line() -> None:
    from sacformer_jax.cli import EXIT_INTERRUPTED

    assert f"STOPPED_AFTER_SAVING={EXIT_INTERRUPTED}\n" in SCRIPT.read_text()

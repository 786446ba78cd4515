"""Studies: workers started, stopped and resumed, and a table that loses nothing."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
import study as studies

from sacformer_jax import Config
from sacformer_jax.checkpoint import RunFolder
from sacformer_jax.cores import usable_cores
from sacformer_jax.envs import EnvSpec
from sacformer_jax.members import seed_members
from sacformer_jax.runner import sources_of

EXPERIMENTS = Path(__file__).parents[1] / "experiments"

TINY = {
    "agent": "sac", "env": "Hopper", "num_envs": 2, "max_episode_steps": 50,
    "prefill_env_steps": 200, "chunk_env_steps": 100, "eval_every": 100, "eval_episodes": 2,
    "checkpoint_every": 1_000_000, "actor_width": 8, "actor_layers": 1, "critic_width": 8,
    "batch_size": 4, "buffer_capacity": 2000, "updates_per_env_step": 1.0,
}  # fmt: skip
SPEC = EnvSpec("Hopper", 11, 3, (-1.0,) * 3, (1.0,) * 3, 50, "native", "a test")


def _config(seed: int, total: int = 400) -> Config:
    return Config.from_preset("cpu", **TINY, seed=seed, total_env_steps=total)


def _pretend(study: studies.Study, name: str, returns: list[float], commits: str = "abc") -> None:
    """A run's folder with what the table is made of, an evaluation every 100 steps."""
    config = study.configs[name]
    folder = RunFolder(config.run.run_dir)
    folder.create(config, sources_of(config), SPEC, seed_members([config.seed]))
    steps = range(100, 100 * len(returns) + 1, 100)
    metrics_path = folder.path / "metrics.jsonl"
    with metrics_path.open("w") as metrics, folder.timings_path.open("w") as timings:
        for step, value in zip(steps, returns, strict=True):
            record = {"env_steps": step, "return_mean": value, "return_std": 0.5, "episodes": 2}
            metrics.write(json.dumps({"kind": "train", "env_steps": step}) + "\n")
            metrics.write(json.dumps({"kind": "eval", **record}) + "\n")
            timings.write(json.dumps({"env_steps": step, "chunk_seconds": 1.5}) + "\n")
    (study.runs / f"{name}.commits").write_text(commits)


def _study(folder: Path, script: str = "raise SystemExit(5)") -> studies.Study:
    path = folder / "script.py"
    path.write_text(script)
    configs = {f"run-{seed}": _config(seed) for seed in (0, 1)}
    return studies.Study("tiny", configs, path, runs=folder / "runs")


def test_the_table_holds_every_evaluation(tmp_path: Path) -> None:
    study = _study(tmp_path)
    _pretend(study, "run-1", [1.0, 2.0], "abc\ndef-dirty\n")
    study.write(["run-0", "run-1"])  # run-0 has not begun
    with (tmp_path / "results" / "tiny.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["env_steps"], row["return_mean"], row["wall_s"]) for row in rows] == [
        ("100", "1.0", "1.5"),
        ("200", "2.0", "3.0"),
    ]
    same = {"study": "tiny", "run": "run-1", "agent": "sac", "env": "Hopper", "seed": "1",
            "engine": "native", "preset": "cpu", "commit": "abc+def-dirty"}  # fmt: skip
    assert all(row.items() >= same.items() for row in rows)
    assert (tmp_path / "results" / "tiny.png").read_bytes().startswith(b"\x89PNG")


def test_rows_of_runs_not_asked_for_stay(tmp_path: Path) -> None:
    study = _study(tmp_path)
    _pretend(study, "run-1", [1.0, 2.0])
    study.write(["run-1"])
    before = study.read_table()
    # Trained on another machine, say: no folder here any more.
    (study.runs / "run-1" / "metrics.jsonl").unlink()
    _pretend(study, "run-0", [3.0])
    study.write(["run-0", "run-1"])
    after = study.read_table()
    assert [row["run"] for row in after] == ["run-0", "run-1", "run-1"]  # the study's order
    assert after[1:] == before
    _pretend(study, "run-0", [4.0, 5.0])
    study.write(["run-0"])
    assert [row["return_mean"] for row in study.read_table()] == [4.0, 5.0, 1.0, 2.0]


def test_the_summary(tmp_path: Path) -> None:
    study = _study(tmp_path)
    _pretend(study, "run-0", [100.0, 60.0, 1.0, 2.0, 3.0, 4.0])
    _pretend(study, "run-1", [7.0])
    study.write(study.configs)
    lines = study.summary(["run-0"]).splitlines()
    assert lines[2:] == ["| run-0 | 600 | 4 | 14 | 100 | 9 |"]
    assert len(study.summary(study.configs).splitlines()) == 4


def test_a_worker_that_fails_is_reported_and_the_others_run(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    script = "import sys\nprint('worker of', sys.argv[2], flush=True)\nsys.exit(5)"
    assert _study(tmp_path, script).main([]) == studies.EXIT_FAILED == 1
    out, err = capfd.readouterr()
    assert "worker of run-0" in out
    assert "worker of run-1" in out
    assert "run-0: ended with code 5" in out
    assert err == "failed: run-0, run-1\n"


@pytest.mark.parametrize("jobs", ["0", "-1", "100000", "two"])
def test_impossible_numbers_of_jobs_are_refused(
    tmp_path: Path, jobs: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as refused:
        _study(tmp_path).main(["--jobs", jobs])
    assert refused.value.code == 2
    assert jobs in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


def test_an_unknown_run_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as refused:
        _study(tmp_path).main(["--only", "run-7"])
    assert refused.value.code == 2
    assert "run-7" in capsys.readouterr().err


def test_the_foundation_study_names_its_runs() -> None:
    listed = subprocess.run(
        [sys.executable, EXPERIMENTS / "foundation.py", "--list"],
        capture_output=True, text=True, check=True,
    ).stdout.split()  # fmt: skip
    assert len(listed) == 12
    assert {"Hopper-sac-0", "HalfCheetah-sacformer-1"} <= set(listed)


def test_runs_are_trained_stopped_and_resumed(tmp_path: Path) -> None:
    script = tmp_path / "tiny.py"
    script.write_text(
        textwrap.dedent(f"""
            import os, sys
            sys.path.insert(0, {str(EXPERIMENTS)!r})
            from study import Study
            from sacformer_jax import Config
            fields = {TINY!r} | {{"critic_width": int(os.environ.get("WIDTH", "8"))}}
            total = int(os.environ["TOTAL"])
            configs = {{
                f"run-{{seed}}": Config.from_preset(
                    "cpu", **fields, seed=seed, total_env_steps=total)
                for seed in (0, 1)
            }}
            sys.exit(Study("tiny", configs, __file__).main())
        """)
    )

    def start(*args: str, total: int, **environment: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-u", str(script), *args],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=tmp_path,
            env={**os.environ, "TOTAL": str(total), **environment},
        )  # fmt: skip

    endless = start(total=1_000_000)
    assert endless.stdout is not None
    try:
        for line in endless.stdout:
            if "eval return" in line:
                break
        endless.send_signal(signal.SIGINT)
        said, _ = endless.communicate()
    finally:
        endless.kill()
    assert endless.returncode == 3, said
    assert "Traceback" not in said
    assert "run-1: started" not in said
    stopped_at = RunFolder(tmp_path / "runs" / "tiny" / "run-0").latest_step()
    assert stopped_at is not None

    total = max(400, stopped_at + 100)
    ended = start("--jobs", str(min(2, usable_cores())), total=total)
    said, _ = ended.communicate()
    assert ended.returncode == 0, said
    table = (tmp_path / "results" / "tiny.csv").read_text()
    rows = list(csv.DictReader(table.splitlines()))
    assert {row["run"] for row in rows if row["env_steps"] == str(total)} == {"run-0", "run-1"}
    assert f"| run-0 | {total:,} |" in said

    again = start(total=total)
    said, _ = again.communicate()
    assert again.returncode == 0
    assert "started" not in said
    assert (tmp_path / "results" / "tiny.csv").read_text() == table

    changed = start(total=total, WIDTH="16")
    said, _ = changed.communicate()
    assert changed.returncode == 2
    assert "run-0 was trained with other settings (critic_width)" in said


def test_a_runs_name_without_task_and_seed_is_its_variant() -> None:
    row = {"env": "Hopper", "seed": "1"}
    names = {"Hopper-sac-1": "sac", "64-windows-1": "64-windows", "Ant-sac-1": "Ant-sac"}
    assert {name: studies._variant({**row, "run": name}) for name in names} == names

"""Studies: workers started, stopped and resumed, and a table that loses nothing."""

from __future__ import annotations

import csv
import importlib
import json
import os
import shutil
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import machine
import pytest
import study as studies
from study_table import read_table, summary

from sacformer_jax import Config
from sacformer_jax.agents.sacformer import predicted_steps
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


def _config(seeds: tuple[int, ...], total: int = 400) -> Config:
    chosen = {"seeds": seeds} if len(seeds) > 1 else {"seed": seeds[0]}
    return Config.from_preset("cpu", **TINY, **chosen, total_env_steps=total)


def _pretend(study: studies.Study, name: str, *returns: list[float], commits: str = "abc") -> None:
    """A run's folder with what the table is made of, an evaluation every 100 steps.

    Args:
      study: whose run.
      name: of it.
      returns: of each seed.
      commits: what it was trained by.
    """
    config = study.configs[name]
    folder = RunFolder(config.run.run_dir)
    members = seed_members(config.all_seeds)
    folder.create(config, sources_of(config), SPEC, members)
    steps = range(100, 100 * len(returns[0]) + 1, 100)
    for member, values in zip(members, returns, strict=True):
        with folder.metrics_path(member.name).open("w") as metrics:
            for step, value in zip(steps, values, strict=True):
                record = {"env_steps": step, "return_mean": value, "return_std": 0.5, "episodes": 2}
                metrics.write(json.dumps({"kind": "train", "env_steps": step}) + "\n")
                metrics.write(json.dumps({"kind": "eval", **record}) + "\n")
    with folder.timings_path.open("w") as timings:
        for step in steps:
            timings.write(json.dumps({"env_steps": step, "chunk_seconds": 1.5}) + "\n")
    (study.runs / f"{name}.commits").write_text(commits)
    (study.runs / f"{name}.cpus").write_text("A CPU\n")


def _study(folder: Path, script: str = "raise SystemExit(5)") -> studies.Study:
    """Run ``Hopper-a`` of one seed and ``Hopper-b`` of two."""
    path = folder / "script.py"
    path.write_text(script)
    configs = {"Hopper-a": _config((3,)), "Hopper-b": _config((5, 4))}
    return studies.Study("tiny", configs, path, runs=folder / "runs")


def test_the_table_holds_every_evaluation(tmp_path: Path) -> None:
    study = _study(tmp_path)
    _pretend(study, "Hopper-b", [1.0, 2.0], [8.0, 9.0], commits="abc\ndef-dirty\n")
    study.write(["Hopper-a", "Hopper-b"])  # Hopper-a has not begun
    with (tmp_path / "results" / "tiny.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["seed"], row["env_steps"], row["return_mean"], row["wall_s"]) for row in rows] == [
        ("4", "100", "8.0", "1.5"),
        ("4", "200", "9.0", "3.0"),
        ("5", "100", "1.0", "1.5"),
        ("5", "200", "2.0", "3.0"),
    ]
    same = {"study": "tiny", "run": "Hopper-b", "agent": "sac", "env": "Hopper",
            "engine": "native", "preset": "cpu", "return_std": "0.5", "episodes": "2",
            "commit": "abc+def-dirty", "cpu": "A CPU"}  # fmt: skip
    assert all(row.items() >= same.items() for row in rows)
    assert (tmp_path / "results" / "tiny.png").read_bytes().startswith(b"\x89PNG")


def test_a_run_that_goes_further_in_the_table_stays_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As where its folder was left on another machine, and it is begun again here."""
    study = _study(tmp_path)
    _pretend(study, "Hopper-b", [1.0, 2.0], [8.0, 9.0])
    study.write(["Hopper-b"])
    finished = study.table.read_bytes()
    shutil.rmtree(study.runs)
    _pretend(study, "Hopper-b", [5.0], [5.0])
    study.write(["Hopper-b"])
    assert study.table.read_bytes() == finished
    assert "tiny.csv has 200 env steps of it" in capsys.readouterr().out
    study.write(["Hopper-a"])  # of which there is nothing here: nothing is said of it
    assert capsys.readouterr().out == ""
    _pretend(study, "Hopper-b", [5.0, 6.0], [5.0, 6.0])  # as far: the newer ones
    study.write(["Hopper-b"])
    assert study.table.read_bytes() != finished
    # Of other settings it is not the same run.
    study.configs["Hopper-b"] = study.configs["Hopper-b"].replace(alpha=0.123)
    shutil.rmtree(study.runs)
    _pretend(study, "Hopper-b", [5.0], [5.0])
    study.write(["Hopper-b"])
    assert {row["env_steps"] for row in read_table(study.table)} == {100}


def test_where_a_run_was_trained_is_noted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study, latest = _study(tmp_path), None
    study.runs.mkdir()
    monkeypatch.setattr(RunFolder, "latest_step", lambda folder: latest)
    for cpu in ("A", "B"):  # it had no checkpoint, and begins anew
        monkeypatch.setattr(machine, "cpu_model", lambda cpu=cpu: cpu)
        study._note_origin("Hopper-a")
    _pretend(study, "Hopper-b", [1.0], [2.0])
    (study.runs / "Hopper-b.cpus").unlink()  # begun before they were noted, or elsewhere
    latest = 100
    study._note_origin("Hopper-b")
    study._note_origin("Hopper-b")
    cores = usable_cores()
    cpu = f"B, {cores} core{'s' if cores > 1 else ''}"
    assert (study.runs / "Hopper-a.cpus").read_text() == f"{cpu}\n"
    assert {row["cpu"] for row in study.rows("Hopper-b")} == {f"unknown+{cpu}"}


def test_seconds_that_are_lost_are_unknown(tmp_path: Path) -> None:
    """Not 0, as before the first update."""
    study = _study(tmp_path)
    _pretend(study, "Hopper-a", [1.0, 2.0, 3.0, 4.0])
    timings = RunFolder(study.configs["Hopper-a"].run.run_dir).timings_path
    timings.write_text(json.dumps({"env_steps": 400, "chunk_seconds": 1.5}) + "\n")
    assert [row["wall_s"] for row in study.rows("Hopper-a")] == [0.0, 0.0, "", 1.5]
    study.write(["Hopper-a"])
    assert "| Hopper-a | 3 | 400 | 4 | 2 | 4 | 2 |" in summary(
        read_table(study.table), ["Hopper-a"]
    )


def test_seeds_of_other_settings_are_no_seeds_of_the_same(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A preset that changes must not go on under the name that it had."""
    study = _study(tmp_path, "")
    _pretend(study, "Hopper-a", [5.0])
    study.write(["Hopper-a"])
    shutil.rmtree(study.runs)

    def with_more_seeds(**changed: float) -> studies.Study:
        more = {"Hopper-a-from-7": _config((7,)).replace(**changed), **study.configs}
        return studies.Study("tiny", more, study.script, runs=tmp_path / "runs")

    with pytest.raises(SystemExit) as refused:
        with_more_seeds(tau=0.1).main(["--only", "Hopper-a-from-7"])
    assert refused.value.code == 2
    said = capsys.readouterr().err
    assert "tiny.csv has Hopper-a, trained with other settings than Hopper-a-from-7" in said
    assert not study.runs.exists()
    assert with_more_seeds().main(["--only", "Hopper-a-from-7"]) == 0
    assert with_more_seeds(tau=0.1).main(["--only", "Hopper-b"]) == 0


def test_rows_of_runs_not_asked_for_stay(tmp_path: Path) -> None:
    study = _study(tmp_path)
    _pretend(study, "Hopper-b", [1.0, 2.0], [3.0, 4.0])
    study.write(["Hopper-b"])
    before = read_table(study.table)
    # Trained on another machine, say: no folder here any more.
    shutil.rmtree(study.runs / "Hopper-b")
    _pretend(study, "Hopper-a", [5.0])
    study.write(["Hopper-a", "Hopper-b"])
    after = read_table(study.table)
    assert [row["run"] for row in after] == ["Hopper-a", *4 * ["Hopper-b"]]  # the study's order
    assert after[1:] == before
    _pretend(study, "Hopper-a", [6.0, 7.0])
    study.write(["Hopper-a"])
    assert [row["return_mean"] for row in read_table(study.table)] == [6.0, 7.0, 3.0, 4.0, 1.0, 2.0]


def test_the_summary(tmp_path: Path) -> None:
    study = _study(tmp_path)
    _pretend(study, "Hopper-a", [7.0])
    _pretend(study, "Hopper-b", [100.0, 60.0, 1.0, 2.0, 3.0, 4.0], [0.0] * 6)
    study.write(study.configs)
    rows = read_table(study.table)
    assert summary(rows, ["Hopper-b"]).splitlines()[2:] == [
        "| Hopper-b | 4 | 600 | 0 | 0 | 0 | 9 |",
        "| Hopper-b | 5 | 600 | 4 | 14 | 100 | 9 |",
    ]
    assert len(summary(rows, study.configs).splitlines()) == 5


def test_a_worker_that_fails_is_reported_and_the_others_run(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    script = "import sys\nprint('worker of', sys.argv[2], flush=True)\nsys.exit(5)"
    assert _study(tmp_path, script).main([]) == studies.EXIT_FAILED == 1
    out, err = capfd.readouterr()
    assert "worker of Hopper-a" in out
    assert "worker of Hopper-b" in out
    assert "Hopper-a: ended with code 5" in out
    assert err == "failed: Hopper-a, Hopper-b\n"


def test_workers_are_started_at_the_scale_asked_for(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    script = "import sys\nprint(*sys.argv[1:4], flush=True)"
    asked: list[str] = []

    def study_at(scale: str) -> studies.Study:
        asked.append(scale)
        return _study(tmp_path, script)

    assert studies.main_of_scales(study_at, ["--scale", "full", "--only", "Hopper-b"]) == 0
    assert studies.main_of_scales(study_at, ["--list"]) == 0
    assert asked == ["full", "cpu"]
    out = capfd.readouterr().out
    assert "--scale full --worker\n" in out
    assert out.endswith("Hopper-a\nHopper-b\n")
    with pytest.raises(SystemExit):
        studies.main_of_scales(study_at, ["--help"])
    assert "--scale {cpu,full}" in capfd.readouterr().out


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
        _study(tmp_path).main(["--only", "Hopper-7"])
    assert refused.value.code == 2
    assert "Hopper-7" in capsys.readouterr().err


def test_a_folder_of_another_version_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    study = _study(tmp_path)
    _pretend(study, "Hopper-b", [1.0], [2.0])
    path = study.runs / "Hopper-b" / "config.json"
    contents = json.loads(path.read_text())
    contents["config"]["context"]["taken_out"] = 1
    path.write_text(json.dumps(contents))
    monkeypatch.setattr(RunFolder, "latest_step", lambda folder: 100)
    with pytest.raises(SystemExit) as refused:
        study.main(["--only", "Hopper-b"])
    assert refused.value.code == 2
    said = capsys.readouterr().err
    assert str(path.parent) in said
    assert "taken_out" in said


SCRIPTS = ("figure2", "figure3", "ablations")


@pytest.mark.parametrize("scale", studies.SCALES)
@pytest.mark.parametrize("name", SCRIPTS)
def test_every_study_can_be_trained_as_it_is(name: str, scale: str) -> None:
    study = importlib.import_module(name).study(scale)
    assert study.name == f"{name}-{scale}"
    for run, config in study.configs.items():
        config.validated()
        assert run.startswith(f"{config.task.env}-")
        assert len(config.all_seeds) >= 3
        assert config.preset == {"cpu": "cpu", "full": "paper"}[scale]


@pytest.mark.parametrize(
    ("name", "arguments"),
    [("improve", ()), ("improve", ("100k",)), ("memory", ("hidden",)), ("memory", ("delay",))],
)
def test_the_agents_are_compared_on_the_same_task(name: str, arguments: tuple[str, ...]) -> None:
    """In studies of what makes SACFormer better: the same steps, updates, seeds, evaluations."""
    study = importlib.import_module(name).study(*arguments)
    assert study.name == "-".join([name, *arguments])
    same = (
        "preset", "seeds", "total_env_steps", "prefill_env_steps", "updates_per_env_step",
        "num_envs", "eval_every", "eval_episodes", "hide_velocities", "action_delay",
    )  # fmt: skip
    for field in same:
        assert len({config.flat()[field] for config in study.configs.values()}) == 1, field
    for run, config in study.configs.items():
        config.validated()
        assert run.startswith(f"{config.task.env}-")
    assert {config.agent for config in study.configs.values()} == {"sacformer", "sac"}


@pytest.mark.parametrize(
    ("arena", "preset", "kept"),
    [
        ("full", "best", (False, 0)),
        ("hidden", "memory", (True, 0)),
        ("delay", "memory", (False, 2)),
    ],
)
def test_the_arena_is_fair_and_its_seeds_are_fresh(
    arena: str, preset: str, kept: tuple[bool, int]
) -> None:
    study = importlib.import_module("arena").study(arena)
    configs = study.configs
    assert study.name == ("arena" if arena == "full" else f"arena-{arena}")
    same = (
        "total_env_steps", "updates_per_env_step", "num_envs", "eval_every", "eval_episodes",
        "hide_velocities", "action_delay",
    )  # fmt: skip
    for field in same:
        assert len({config.flat()[field] for config in configs.values()}) == 1, field
    tuned = {
        seed
        for arguments in (("improve",), ("memory", "hidden"), ("memory", "delay"))
        for config in importlib.import_module(arguments[0]).study(*arguments[1:]).configs.values()
        for seed in config.all_seeds
    }
    for config in configs.values():
        config.validated()
        assert not tuned & set(config.all_seeds)
    tasks = ("HalfCheetah", "Hopper", "Walker2d", "Ant", "Humanoid")[: 5 if arena == "full" else 3]
    for task in tasks:
        own, opponent = configs[f"{task}-sacformer"], configs[f"{task}-sac"]
        for config in (own, opponent):
            assert config.preset == preset
            assert (config.task.hide_velocities, config.task.action_delay) == kept
        assert own.all_seeds == opponent.all_seeds
        assert len(own.all_seeds) >= 5


def test_seeds_added_to_the_arena_are_as_the_first_five_but_others() -> None:
    configs = importlib.import_module("arena").study("full").configs
    more = {name: config for name, config in configs.items() if "-from-" in name}
    assert len(more) == 5 * 2
    for name, config in more.items():
        first = configs[name.removesuffix("-from-105")]
        assert config.all_seeds == (105, 106, 107, 108, 109)
        assert first.all_seeds == (100, 101, 102, 103, 104)
        assert config.replace(seed=100, run_dir=first.run.run_dir) == first


def _differing(one: Config, other: Config) -> set[str]:
    """Fields of two configurations that are not the same."""
    of_other = other.flat()
    return {name for name, value in one.flat().items() if of_other[name] != value}


def test_preset_best_is_what_was_tuned() -> None:
    tuned = importlib.import_module("improve").study("100k").configs
    for agent, variant in {"sacformer": "lambda-belief-joint-42", "sac": "sac-lambda"}.items():
        preset = Config.from_preset("best", env="Hopper", agent=agent)
        other = tuned[f"Hopper-{variant}"]
        # "effect" is a step where an action comes into effect at once.
        assert predicted_steps(preset, 0) == predicted_steps(other, 0)
        assert _differing(preset, other) - {"prediction_steps"} == {"preset", "seeds", "run_dir"}


def test_preset_memory_is_what_was_tuned() -> None:
    tuned = importlib.import_module("memory").study("delay").configs
    for agent, variant in {"sacformer": "belief-joint-42", "sac": "sac-lambda"}.items():
        preset = Config.from_preset("memory", env="Hopper", agent=agent, action_delay=2)
        differs = _differing(preset, tuned[f"Hopper-{variant}"])
        assert differs == {"preset", "total_env_steps", "seeds", "run_dir"}


def test_the_studies_are_those_of_the_paper() -> None:
    runs = {name: set(importlib.import_module(name).study("full").configs) for name in SCRIPTS}
    agents, tasks = (
        ["sacformer", "sac", "td3", "ddpg", "ppo"],
        ["HalfCheetah", "Hopper", "Walker2d", "Ant"],
    )
    assert runs["figure2"] == {f"{task}-{agent}" for task in tasks for agent in agents}
    assert runs["figure3"] >= {f"Humanoid-K={length}" for length in (5, 10, 15)}
    listed = subprocess.run(
        [sys.executable, EXPERIMENTS / "ablations.py", "--list", "--scale", "full"],
        capture_output=True, text=True, check=True,
    ).stdout.split()  # fmt: skip
    assert set(listed) == runs["ablations"]


def test_ablations_change_one_thing_of_the_preset() -> None:
    for scale in studies.SCALES:
        configs = importlib.import_module("ablations").study(scale).configs
        for run, config in configs.items():
            task = config.task.env
            changed = _differing(config, configs[f"{task}-sacformer"])
            changed -= {"run_dir", "prefill_env_steps"}
            allowed = {
                "transformer-critic": {"critic", "critic_width", "critic_heads"},
                "acting-4K": {"acting_context", "acting_context_limit"},
            }.get(run.removeprefix(f"{task}-"))
            assert len(changed) <= 1 or changed <= (allowed or set()), (run, changed)
            assert changed or run.endswith("-sacformer")


@pytest.mark.slow
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
                name: Config.from_preset("cpu", **fields, **seeds, total_env_steps=total)
                for name, seeds in {{"Hopper-a": {{"seeds": 2}}, "Hopper-b": {{"seed": 2}}}}.items()
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
    assert "Hopper-b: started" not in said
    stopped_at = RunFolder(tmp_path / "runs" / "tiny" / "Hopper-a").latest_step()
    assert stopped_at is not None

    total = max(400, stopped_at + 100)
    ended = start("--jobs", str(min(2, usable_cores())), total=total)
    said, _ = ended.communicate()
    assert ended.returncode == 0, said
    table = (tmp_path / "results" / "tiny.csv").read_text()
    rows = list(csv.DictReader(table.splitlines()))
    assert {(row["run"], row["seed"]) for row in rows if row["env_steps"] == str(total)} == {
        ("Hopper-a", "0"), ("Hopper-a", "1"), ("Hopper-b", "2"),
    }  # fmt: skip
    assert f"| Hopper-a | 1 | {total:,} |" in said

    again = start(total=total)
    said, _ = again.communicate()
    assert again.returncode == 0
    assert "started" not in said
    assert (tmp_path / "results" / "tiny.csv").read_text() == table

    changed = start(total=total, WIDTH="16")
    said, _ = changed.communicate()
    assert changed.returncode == 2
    assert "Hopper-a was trained with other settings (critic_width)" in said

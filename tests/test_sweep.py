"""Sweeps: which settings, what is refused, the tables, and a tiny one from start to end."""

from __future__ import annotations

import argparse
import csv
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sweep
import sweep_results

from sacformer_jax import Config, ConfigError, load_policy
from sacformer_jax.checkpoint import RunConfigFile, RunFolder
from sacformer_jax.cli import EXIT_BAD_INPUT, EXIT_INTERRUPTED
from sacformer_jax.runner import RunResult

TINY = {
    "agent": "sac", "env": "Hopper", "num_envs": 2, "max_episode_steps": 50,
    "prefill_env_steps": 200, "chunk_env_steps": 100, "total_env_steps": 400, "eval_every": 100,
    "eval_episodes": 2, "checkpoint_every": 1_000_000, "actor_width": 8, "actor_layers": 1,
    "critic_width": 8, "batch_size": 4, "buffer_capacity": 2000, "updates_per_env_step": 1.0,
}  # fmt: skip
RANGES = {"tau": sweep.Range(1e-4, 1e-1, log=True), "discount": sweep.Range(0.9, 0.99)}


def config_of(**fields: Any) -> Config:
    return Config.from_preset("cpu", **{**TINY, **fields})


def flags(path: Path, *more: str, **fields: Any) -> list[str]:
    given = {**TINY, **fields}.items()
    return [
        *(f"--{name.replace('_', '-')}={value}" for name, value in given),
        f"--run-dir={path}",
        *more,
    ]


def row(setting: str, seed: int, score: float, tau: float) -> dict[str, Any]:
    return {
        "setting": setting, "member": f"{setting}-seed-{seed}", "seed": seed, "tau": tau,
        "score": score, "best_return": score + 1, "final_return": score - 1, "skipped_updates": 1,
    }  # fmt: skip


# --- settings ----------------------------------------------------------------------------------


def test_a_grid_is_every_combination() -> None:
    assert sweep.grid({"tau": [0.1, 0.2], "alpha": [1.0, 2.0]}) == [
        {"tau": 0.1, "alpha": 1.0},
        {"tau": 0.1, "alpha": 2.0},
        {"tau": 0.2, "alpha": 1.0},
        {"tau": 0.2, "alpha": 2.0},
    ]


def test_draws_are_those_of_their_seed_and_lie_in_the_range() -> None:
    drawn = sweep.draws(RANGES, 400, seed=3)
    assert drawn == sweep.draws(RANGES, 400, seed=3) != sweep.draws(RANGES, 400, seed=4)
    for name, each in RANGES.items():
        values = np.array([setting[name] for setting in drawn])
        assert each.low <= values.min()
        assert values.max() <= each.high
    # Half of them below the middle: of the logarithm, or of the numbers themselves.
    for name, middle in (("tau", math.sqrt(1e-4 * 1e-1)), ("discount", 0.945)):
        assert 0.4 < np.mean([setting[name] < middle for setting in drawn]) < 0.6


def test_a_field_is_drawn_the_same_whatever_else_is() -> None:
    both, one = (sweep.draws({n: RANGES[n] for n in names}, 5, 0) for names in (RANGES, ["tau"]))
    assert [setting["tau"] for setting in both] == [setting["tau"] for setting in one]


def test_what_flags_say() -> None:
    assert sweep.parse_grid(["actor-learning-rate=1e-4,3e-4", "target_return=-5"]) == {
        "actor_learning_rate": [1e-4, 3e-4],
        "target_return": [-5.0],
    }
    assert sweep.parse_ranges(["tau=log:1e-4:1e-1", "discount=uniform:0.9:0.99"]) == RANGES


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"grid": ["tua=0.1"]}, "--grid tua=0.1.*'tua' does not exist; did you mean 'tau'"),
        ({"grid": ["batch_size=8"]}, "'batch_size' does not exist; known: actor_learning_rate"),
        ({"grid": ["tau"]}, "--grid 'tau': must be NAME="),
        ({"grid": ["tau="]}, "tau='': must be a finite number"),
        ({"grid": ["tau=0.1,,0.2"]}, "tau='': must be a finite number"),
        ({"grid": ["tau=0.1,high"]}, "tau='high': must be a finite number"),
        ({"grid": ["tau=nan"]}, "tau='nan': must be a finite number"),
        ({"grid": ["tau=0.1", "tau=0.2"]}, "tau is given twice"),
        ({"grid": ["tau=0.1,0.1000000001"]}, "two values are the same"),
        ({"grid": ["tau=0.1"], "draw": ["tau=log:1:2"]}, "--draw: is for --random"),
        ({"grid": ["tau=0.1"], "random": 2}, "either --grid, or --random"),
        ({}, "either --grid, or --random"),
        ({"random": 2}, "--draw says what"),
        ({"random": 0, "draw": ["tau=log:1:2"]}, "--random 0 .*at least 1"),
        ({"random": 2, "draw": ["tau=log:1:2"], "draw_seed": -1}, "--draw-seed -1"),
        ({"random": 2, "draw": ["tau=normal:0:1"]}, "tau='normal:0:1': must be uniform"),
        ({"random": 2, "draw": ["tau=log:0.1"]}, "tau='log:0.1': must be uniform"),
        ({"random": 2, "draw": ["tau=log:0:0.1"]}, "LOW must be above 0 and below HIGH"),
        ({"random": 2, "draw": ["tau=uniform:0.1:0.1"]}, "LOW must be below HIGH"),
    ],
)
def test_what_cannot_be_swept_is_refused(given: dict[str, Any], message: str) -> None:
    args = {"grid": None, "random": None, "draw": None, "draw_seed": 0, **given}
    with pytest.raises(ConfigError, match=message):
        sweep.settings_of(argparse.Namespace(**args))


# --- members -----------------------------------------------------------------------------------


def test_every_setting_has_a_member_for_each_seed() -> None:
    members = sweep.members_of(sweep.grid({"tau": [0.1, 0.2]}), config_of(seeds=(3, 8)))
    assert [(m.name, m.seed, m.values) for m in members] == [
        ("setting-01-seed-3", 3, {"tau": 0.1}),
        ("setting-01-seed-8", 8, {"tau": 0.1}),
        ("setting-02-seed-3", 3, {"tau": 0.2}),
        ("setting-02-seed-8", 8, {"tau": 0.2}),
    ]


@pytest.mark.parametrize(
    ("fields", "setting", "message"),
    [
        ({}, {"tau": 2.0}, "tau=2.0: must be at most 1"),
        ({}, {"actor_learning_rate": 0.0}, "actor_learning_rate=0.0: must be greater than 0"),
        ({"tune_alpha": False}, {"target_entropy": -1.0}, "target_entropy: .*tune_alpha=False"),
        ({}, {"target_return": 10.0}, "target_return: .*return_conditioning=none"),
        ({"agent": "td3"}, {"alpha": 0.1}, "alpha: has no effect with agent=td3"),
        (
            {"agent": "ppo", "prefill_env_steps": 0},
            {"tau": 0.1},
            "tau: has no effect with agent=ppo",
        ),
        (
            {"agent": "sacformer", "target_return": "auto"},
            {"target_return": 10.0},
            "target_return: cannot be swept with target_return='auto'",
        ),
    ],
)
def test_a_value_that_cannot_be_is_refused(
    fields: dict[str, Any], setting: dict[str, float], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        sweep.members_of([setting], config_of(**fields))


def test_what_makes_a_sweep_another_one() -> None:
    settings, config = sweep.grid({"tau": [0.1, 0.2]}), config_of()
    members = sweep.members_of(settings, config)
    there = RunConfigFile(config, {}, members)
    longer = config.replace(total_env_steps=800, run_dir="elsewhere")
    assert sweep.difference(there, longer, members) is None
    other = sweep.members_of(sweep.grid({"tau": [0.1, 0.3]}), config)
    assert "{'tau': 0.2} there" in str(sweep.difference(there, config, other))
    assert "2 members there, 1 here" in str(sweep.difference(there, config, members[:1]))
    wider = config.replace(batch_size=8)
    assert sweep.difference(there, wider, members) == "batch_size=4 there, 8 here"


# --- tables ------------------------------------------------------------------------------------


def test_a_members_row() -> None:
    member = sweep.members_of([{"tau": 0.1}], config_of(seed=4))[0]
    evaluations = [{"kind": "eval", "return_mean": value} for value in (9.0, 1.0, 2.0, 6.0)]
    training = [{"kind": "train", "skipped_updates": count} for count in (1, 0, 2)]
    found = sweep_results.member_row(member, [*evaluations, *training])
    assert found == {
        "setting": "setting-01", "member": "setting-01-seed-4", "seed": 4, "tau": 0.1,
        "score": 3.0, "best_return": 9.0, "final_return": 6.0, "skipped_updates": 3,
    }  # fmt: skip
    assert math.isnan(sweep_results.member_row(member, [])["score"])
    broken = [*evaluations[:1], {"kind": "eval", "return_mean": None}]
    assert math.isnan(sweep_results.member_row(member, broken)["score"])
    assert sweep_results.member_row(member, broken)["best_return"] == 9.0


def test_settings_are_means_over_seeds_with_the_best_first() -> None:
    rows = [row("setting-01", seed, seed + 1.0, 0.1) for seed in (0, 1)]
    rows += [row("setting-02", seed, math.nan if seed else 90.0, 0.2) for seed in (0, 1)]
    rows += [row("setting-03", seed, 5.0 + 4 * seed, 0.3) for seed in (0, 1)]
    table = sweep_results.setting_rows(rows, ["tau"])
    assert [each["setting"] for each in table] == ["setting-03", "setting-01", "setting-02"]
    assert table[0] == {
        "setting": "setting-03", "tau": 0.3, "seeds": 2, "score": 7.0, "score_std": 2.0,
        "best_return": 8.0, "final_return": 6.0, "skipped_updates": 2,
    }  # fmt: skip


def test_the_picture_is_a_png_even_with_holes(tmp_path: Path) -> None:
    rows = [row("setting-01", 0, math.nan, 1e-4), row("setting-02", 0, 3.0, 1e-2)]
    path = tmp_path / "sweep.png"
    sweep_results.picture(rows, sweep_results.setting_rows(rows, ["tau"]), ["tau"], path)
    assert path.read_bytes().startswith(b"\x89PNG")


# --- the command -------------------------------------------------------------------------------


def test_a_folder_is_needed(capsys: pytest.CaptureFixture[str]) -> None:
    assert sweep.main(["--grid", "tau=0.1", "--env", "Hopper"]) == EXIT_BAD_INPUT
    assert "error: run_dir=''" in capsys.readouterr().err


def test_a_stopped_sweep_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stopped = RunResult(tmp_path, 200, [], interrupted=True)
    monkeypatch.setattr(sweep, "train", lambda *_, **__: stopped)
    assert sweep.main(flags(tmp_path, "--grid", "tau=0.1")) == EXIT_INTERRUPTED
    assert not (tmp_path / "sweep.csv").exists()


def read(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_a_sweep(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Trained, gone on with for longer, and asked for anew when all is done."""
    path = tmp_path / "sweep"
    asked = ["--grid", "tau=0.005,0.5", "--seeds", "2"]
    assert sweep.main(flags(path, *asked, total_env_steps=300)) == 0
    first = load_policy(path / "best-setting", member="0")
    assert sweep.main(flags(path, *asked)) == 0
    assert "resuming at" in capsys.readouterr().out

    rows, table = read(path / "sweep.csv"), read(path / "sweep_settings.csv")
    assert [r["member"] for r in rows] == [
        f"setting-0{place}-seed-{seed}" for place in (1, 2) for seed in (0, 1)
    ]
    assert {r["tau"] for r in rows} == {"0.005", "0.5"}
    assert len({r["score"] for r in rows}) == 4
    assert [r["setting"] for r in table] == [
        r["setting"] for r in sorted(table, key=lambda r: -float(r["score"]))
    ]
    assert (path / "sweep.png").read_bytes().startswith(b"\x89PNG")

    best = RunFolder(path / "best-setting")
    members = best.read_config().members
    assert [m.name for m in members] == [f"{table[0]['setting']}-seed-{seed}" for seed in (0, 1)]
    assert {m.values["tau"] for m in members} == {float(table[0]["tau"])}
    assert best.latest_step() == 400
    assert load_policy(best.path, member="0").config.learning.tau == float(table[0]["tau"])
    # What was the best before is kept.
    before = load_policy(path / "best-setting-before-1", member="0")
    actions = [policy.predict(np.ones(11))[0] for policy in (before, first)]
    assert np.array_equal(*actions)

    assert sweep.main(flags(path, *asked)) == 0
    assert "has done its 400 env steps already" in capsys.readouterr().out
    assert not (path / "best-setting-before-2").exists()

    assert sweep.main(flags(path, "--grid", "tau=0.005,0.4", "--seeds", "2")) == EXIT_BAD_INPUT
    refused = capsys.readouterr().err
    assert "holds another run already (setting-02-seed-0 with {'tau': 0.5} there" in refused

"""The benchmark's frame, with tiny parts, and the arithmetic of its memory."""

import json
import os
import subprocess
import sys
from pathlib import Path

import benchmark
import jax
import jax.numpy as jnp
import pytest
from bench import checkpointing, members, scaling
from bench.clock import Clock

from sacformer_jax import Config
from sacformer_jax.buffer import TrajectoryBuffer

TINY = {
    "env": "Hopper", "num_envs": 2, "max_episode_steps": 50, "prefill_env_steps": 200,
    "chunk_env_steps": 20, "actor_width": 8, "actor_heads": 1, "actor_layers": 1,
    "critic_width": 8, "batch_size": 4, "buffer_capacity": 20_000,
}  # fmt: skip


def small(clock):
    return {"small.case.ms": 0.12345, "small.case.steps_per_s": 23456.7, "small.version": "1.2"}


def failing(clock):
    raise ValueError("no such | thing")


def test_table_is_grouped_by_part(capsys):
    assert benchmark.main([], {"small": small}) == 0
    printed = capsys.readouterr().out
    heading = printed.index("## small")
    for line in ("| case.ms | 0.123 |", "| case.steps_per_s | 23,457 |", "| version | 1.2 |"):
        assert printed.index(line) > heading
    assert "## machine" in printed
    assert "| gemm_ms | " in printed


def test_a_failing_part_is_told_and_the_others_go_on(tmp_path, capsys):
    path = tmp_path / "new" / "results.json"
    parts = {"broken": failing, "small": small}
    assert benchmark.main(["--json", str(path)], parts) == 1
    results = json.loads(path.read_text())
    assert results["broken.error"] == "ValueError: no such | thing"
    assert results["small.case.ms"] == 0.12345
    assert r"| error | ValueError: no such \| thing |" in capsys.readouterr().out


def test_json_is_written_after_each_part(tmp_path):
    path = tmp_path / "results.json"

    def interrupted(clock):
        assert json.loads(path.read_text())["small.case.ms"] == 0.12345
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        benchmark.main(["--json", str(path)], {"small": small, "last": interrupted})
    results = json.loads(path.read_text())
    assert results["small.version"] == "1.2"
    assert results["gemm_ms"] > 0
    assert results["seconds.small"] >= 0
    assert results["machine.cores"] >= 1
    assert {"machine.env.XLA_FLAGS", "machine.load_average_at_start"} <= set(results)
    assert list(tmp_path.iterdir()) == [path]


def test_only_the_parts_asked_for_are_measured(tmp_path):
    path = tmp_path / "results.json"
    parts = {"broken": failing, "small": small}
    assert benchmark.main(["--part", "small", "--json", str(path)], parts) == 0
    assert not any(key.startswith("broken") for key in json.loads(path.read_text()))


def test_an_unknown_part_is_refused(capsys):
    with pytest.raises(SystemExit, match="2"):
        benchmark.main(["--part", "nothing"])
    assert "nothing" in capsys.readouterr().err


def test_bytes_are_counted_from_shapes():
    tree = {"a": jnp.zeros((3, 5)), "b": jax.ShapeDtypeStruct((7,), bool)}
    assert scaling.num_bytes(tree) == 3 * 5 * 4 + 7
    assert scaling.transition_bytes(obs_size=17, action_size=6) == 4 * (17 + 6 + 1) + 1 + 1


def test_bytes_of_a_small_replay():
    state = jax.eval_shape(TrajectoryBuffer(2, 50, 3, 1, 4, 20).init)
    # Beside a transition: time step, return so far, bad physics; once: head, size, two running.
    beside, once = 4 + 4 + 1, 4 + 4 + 2 * 4
    expected = 2 * 50 * (scaling.transition_bytes(3, 1) + beside) + once
    assert scaling.num_bytes(state) == expected


@pytest.mark.slow
def test_seeds_are_trained_in_one_program():
    config = Config.from_preset("cpu", **TINY)
    results = scaling.by_seeds(Clock(), config, sizes=(1, 2))
    assert results["scaling.seeds.1.over_one"] == 1
    over_one = results["scaling.seeds.2.ms"] / results["scaling.seeds.1.ms"]
    assert results["scaling.seeds.2.over_one"] == over_one > 0
    # All but what the members have in common, three numbers, is there twice.
    one, two = (results[f"scaling.seeds.{size}.state_bytes"] for size in (1, 2))
    assert two == 2 * one - 3 * 4
    assert results["scaling.seeds.2.temp_bytes"] > 0


@pytest.mark.parametrize("case", members.CASES)
def test_cases_of_members_are_split_over_two_cores(case, monkeypatch):
    monkeypatch.setattr(members, "usable_cores", lambda: 2)
    config = Config.from_preset(**members.CASES[case])
    assert f"_{len(config.all_seeds)}" == case[case.rindex("_") :]
    assert members.cores(members.CASES[case]) == 2


def test_members_train_on_one_device_and_on_cores_of_their_own(monkeypatch):
    tiny = {**TINY, "engine": "native", "preset": "cpu", "seeds": 2}
    monkeypatch.setattr(members, "CASES", {"tiny_2": tiny})
    monkeypatch.setattr(members, "ROUNDS", 2)
    results = members.measure(Clock())
    for way in ("one_device", "core_each"):
        assert results[f"members.tiny_2.{way}.steps_per_s"] > 0
        rate = results[f"members.tiny_2.{way}.updates_per_env_step"]
        assert rate == Config.from_preset(**tiny).replay.updates_per_env_step
    assert results["members.tiny_2.core_each_over_fastest"] > 0
    assert results["members.tiny_2.fastest_peer"] == "one_device"


@pytest.mark.slow
def test_checkpoints_are_timed_beside_training(tmp_path):
    """The frame alone: how long a tiny one takes says nothing."""
    results = checkpointing.measure_in(tmp_path / "run", Config.from_preset("cpu", **TINY), turns=2)
    assert results["checkpoint.disk_bytes"] > 0.5 * results["checkpoint.state_bytes"] > 0
    for what in ("blocking_ms", "written_beside_training_s", "written_alone_s", "restore_s"):
        assert results[f"checkpoint.{what}"] > 0
    assert results["checkpoint.extra_lowest_ms"] <= results["checkpoint.extra_highest_ms"]
    share = results["checkpoint.extra_ms"] / 1e3 / 300
    assert results["checkpoint.share_of_5_minutes"] == pytest.approx(share)


def test_peak_memory_grows_with_what_is_held():
    """In a process of its own: the peak of this one is high already."""
    program = (
        "from bench.scaling import peak_resident_bytes\n"
        "before = peak_resident_bytes()\n"
        "held = bytearray(b'x') * (before + 50_000_000)\n"
        "assert peak_resident_bytes() >= before + len(held) // 2\n"
    )
    experiments = str(Path(scaling.__file__).parents[1])
    environment = {**os.environ, "PYTHONPATH": experiments}
    subprocess.run([sys.executable, "-c", program], check=True, env=environment)

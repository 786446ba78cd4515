"""Whole runs: what they write, that resuming equals never having stopped, and their policies."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import io
import json
import re
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from run_states import state_digest

import sacformer_jax.logging as metric_logging
from sacformer_jax import (
    CheckpointError,
    Config,
    ConfigError,
    Policy,
    RunResult,
    agents,
    evaluate,
    load_policy,
    loop,
    resume,
    runner,
    train,
)
from sacformer_jax.callbacks import Callback, RunStart
from sacformer_jax.checkpoint import CheckpointWriter, Restored, RunFolder
from sacformer_jax.cores import xla_threads
from sacformer_jax.digests import digest
from sacformer_jax.logging import MetricLog, read_records
from sacformer_jax.stored import read_metadata
from sacformer_jax.train import hyperparameters, policy_state
from sacformer_jax.types import Context

TOTAL, STOP = 600, 400
TINY = {
    "env": "Hopper", "num_envs": 2, "max_episode_steps": 50, "prefill_env_steps": 200,
    "chunk_env_steps": 100, "total_env_steps": TOTAL, "eval_every": 200, "eval_episodes": 2,
    "checkpoint_every": 200, "actor_width": 8, "actor_heads": 1, "actor_layers": 1,
    "critic_width": 8, "batch_size": 4, "buffer_capacity": 2000, "normalize_obs": True,
    "updates_per_env_step": 1.0, "context_length": 6, "return_conditioning": "commanded",
    "actor_dropout": 0.0, "tune_alpha": True, "alpha": 0.2,
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Outcome:
    """A run and what it printed."""

    result: RunResult
    printed: str


@pytest.fixture(scope="module")
def straight(tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    """A run from start to end, quiet; not to be changed."""
    path = tmp_path_factory.mktemp("runs") / "straight"
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        result = train(Config.from_preset("cpu", **TINY, run_dir=str(path)), quiet=True)
    return Outcome(result, printed.getvalue())


def _killed(straight: Outcome, path: Path) -> Path:
    """A copy of the run without its last checkpoint, as if killed before it was written."""
    shutil.copytree(straight.result.path, path)
    shutil.rmtree(path / "checkpoints" / str(TOTAL))
    return path


@pytest.fixture(scope="module")
def resumed(straight: Outcome, tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    """The same run killed after its checkpoint at ``STOP`` (but before the next) and resumed.

    What it had written since then is still there, the last line only in part.
    """
    path = _killed(straight, tmp_path_factory.mktemp("runs") / "resumed")
    (path / "learning_curve.png").unlink()
    metrics = path / "metrics.jsonl"
    metrics.write_bytes(metrics.read_bytes() + b'{"kind": "eval", "env_steps": 800}\n{"kind": "tr')
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        result = resume(path)
    return Outcome(result, printed.getvalue())


@pytest.fixture(scope="module")
def policy(straight: Outcome) -> Policy:
    return load_policy(straight.result.path)


def _contents(path: Path) -> dict[str, bytes]:
    """Every file under a folder."""
    files = (file for file in path.rglob("*") if file.is_file())
    return {str(file.relative_to(path)): file.read_bytes() for file in files}


# --- resuming ----------------------------------------------------------------------------------


def test_resuming_equals_never_having_stopped(straight: Outcome, resumed: Outcome) -> None:
    assert f"resuming at  {STOP} env steps" in resumed.printed
    assert resumed.result.env_steps == straight.result.env_steps == TOTAL
    paths = straight.result.path, resumed.result.path
    assert state_digest(paths[0]) == state_digest(paths[1])
    assert (paths[0] / "metrics.jsonl").read_bytes() == (paths[1] / "metrics.jsonl").read_bytes()
    best = [load_policy(path, "best").state for path in paths]
    assert digest(best[0]) == digest(best[1])
    assert [p.name for p in (paths[0] / "best").iterdir()] == [
        p.name for p in (paths[1] / "best").iterdir()
    ]


@pytest.mark.slow
def test_resuming_keeps_the_cache_and_the_table_of_episodes(tmp_path: Path) -> None:
    """With the authors' settings the train state holds both."""
    settings = {**TINY, "total_env_steps": 400, "checkpoint_every": 100}
    settings |= {"return_conditioning": "hindsight", "tune_alpha": False, "actor_dropout": 0.1}
    config = Config.from_preset("authors", **settings, run_dir=str(tmp_path / "straight"))
    paths = [train(config, quiet=True).path, tmp_path / "killed"]
    shutil.copytree(*paths)
    shutil.rmtree(paths[1] / "checkpoints" / "400")
    resume(paths[1], quiet=True)
    assert state_digest(paths[0]) == state_digest(paths[1])
    assert (paths[0] / "metrics.jsonl").read_bytes() == (paths[1] / "metrics.jsonl").read_bytes()
    policy = load_policy(paths[0], "latest")
    assert {x.shape for x in jax.tree.leaves(policy.agent.init_cache(1))} == {(1, 1, 100, 8)}
    observations, rewards = _observations(9), np.arange(9, dtype=np.float32)
    assert np.isfinite(_predictions(policy, observations, rewards)).all()


@pytest.mark.slow
def test_a_prefill_without_a_long_enough_episode_is_refused(tmp_path: Path) -> None:
    settings = {**TINY, "window": "scattered", "context_length": 45, "prefill_env_steps": 100}
    config = Config.from_preset("cpu", **settings, run_dir=str(tmp_path / "run"))
    with pytest.raises(ConfigError, match=r"prefill_env_steps=100: no episode of at least .*=45"):
        train(config, quiet=True)
    # Nothing was saved that would be in the way of another try.
    changed = config.replace(context_length=6, total_env_steps=300)
    assert train(changed, quiet=True).env_steps == 300


def test_a_run_killed_before_its_first_checkpoint_starts_from_the_beginning(
    straight: Outcome, tmp_path: Path
) -> None:
    path = tmp_path / "run"
    path.mkdir()
    shutil.copy(straight.result.path / "config.json", path)
    # What it had written by then is of no use.
    (path / "metrics.jsonl").write_text('{"kind": "eval", "env_steps": 200}\n{"kind": "tr')
    shutil.copytree(straight.result.path / "best", path / "best")
    assert resume(path, quiet=True).evaluations == straight.result.evaluations
    assert state_digest(path) == state_digest(straight.result.path)
    assert (path / "metrics.jsonl").read_bytes() == (
        straight.result.path / "metrics.jsonl"
    ).read_bytes()


@pytest.mark.slow
def test_checkpoints_without_the_replay_are_small_and_collect_it_anew(
    straight: Outcome, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = {**TINY, "checkpoint_replay": False, "total_env_steps": 400}
    path = train(Config.from_preset("cpu", **settings, run_dir=str(tmp_path / "run"))).path
    parts = []
    for run in (straight.result.path, path):
        metadata = json.loads((run / "checkpoints" / "400" / "metadata" / "metadata").read_text())
        parts.append({name.split(".")[1] for name in metadata["items"]["state"]})
    assert parts[0] - parts[1] == {"buffer", "env", "context"}
    before = load_policy(path, "latest").state
    with pytest.raises(ConfigError, match=r"=600: .* done 400, .* takes 200 to fill"):
        resume(path, total_env_steps=600)

    collecting = "no replay was saved: collecting one under the policy"
    starts: list[int] = []

    class Refusing(Callback):
        def on_start(self, run: RunStart) -> None:
            starts.append(run.env_steps)
            raise ValueError("not today")

    capsys.readouterr()
    with pytest.raises(ValueError, match="not today"):
        resume(path, total_env_steps=800, callbacks=[Refusing()])
    assert starts == [600]
    assert collecting not in capsys.readouterr().out  # nothing is computed before
    result = resume(path, total_env_steps=800)
    assert collecting in capsys.readouterr().out
    # 200 steps to fill the replay again, without an update; then as ever.
    counts = [(r["env_steps"], r["updates"]) for r in read_records(path / "metrics.jsonl", "train")]
    assert counts == [(300, 100), (400, 200), (700, 300), (800, 400)]
    assert result.env_steps == 800
    assert digest(load_policy(path, "latest").state) != digest(before)
    config = json.loads((path / "config.json").read_text())
    config["config"]["run"]["checkpoint_replay"] = True
    (path / "config.json").write_text(json.dumps(config))
    with pytest.raises(CheckpointError, match=r"checkpoint_replay=False, config.json says"):
        resume(path, total_env_steps=1000)


def test_the_result_of_a_resumed_run_covers_all_of_it(straight: Outcome, resumed: Outcome) -> None:
    assert resumed.result.evaluations == straight.result.evaluations
    assert not resumed.result.interrupted
    assert (resumed.result.path / "learning_curve.png").is_file()


def test_a_run_whose_metrics_are_lost_goes_on(
    straight: Outcome, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = _killed(straight, tmp_path / "run")
    (path / "metrics.jsonl").unlink()
    result = resume(path)
    assert "has lost its records after byte 0" in " ".join(capsys.readouterr().out.split())
    assert state_digest(path) == state_digest(straight.result.path)
    later = [record for record in straight.result.evaluations if record["env_steps"] > STOP]
    assert result.evaluations == later
    assert len((path / "eval.csv").read_text().splitlines()) == 1 + len(later)


def test_resuming_on_other_cores_or_devices_says_that_it_is_not_exact(
    straight: Outcome, resumed: Outcome, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    restore = RunFolder.restore

    def on_others(*arguments: Any) -> Restored:
        restored = restore(*arguments)
        assert restored.devices == {"members": 1, "data": 1}
        return dataclasses.replace(restored, devices={"members": 4, "data": 1})

    monkeypatch.setattr(RunFolder, "restore", on_others)
    here = xla_threads()
    monkeypatch.setattr(runner, "xla_threads", lambda: here + 1)
    monkeypatch.setattr(runner, "_train_on", lambda *_: resumed.result)
    resume(_killed(straight, tmp_path / "run"))
    note = f"note: saved with {here} CPU threads, continued with {here + 1}"
    said = " ".join(capsys.readouterr().out.split())
    assert note in said
    assert "note: saved with 4 devices for the members, continued with 1: right" in said
    assert "for the data" not in said
    assert "note: saved with" not in resumed.printed


def test_a_finished_run_is_not_resumed(straight: Outcome) -> None:
    before = _contents(straight.result.path)
    for total in (None, TOTAL, STOP):
        with pytest.raises(ConfigError, match=r"total_env_steps=\d+: .* 600 already"):
            resume(straight.result.path, total)
    assert _contents(straight.result.path) == before


def test_training_into_a_run_refuses_and_leaves_it_alone(straight: Outcome) -> None:
    path = straight.result.path
    before = _contents(path)
    with pytest.raises(CheckpointError, match="holds a run already") as refused:
        train(Config.from_preset("cpu", **{**TINY, "seed": 1}, run_dir=str(path)), quiet=True)
    assert f"sacformer resume {path}" in str(refused.value)
    assert _contents(path) == before


# --- what a run writes -------------------------------------------------------------------------


def test_quiet_prints_nothing(straight: Outcome) -> None:
    assert straight.printed == ""


def test_the_result(straight: Outcome) -> None:
    result = straight.result
    assert not result.interrupted
    assert result.env_steps == TOTAL
    assert result.evaluations == read_records(result.path / "metrics.jsonl", "eval")


def test_metrics_come_when_they_should(straight: Outcome) -> None:
    records = read_records(straight.result.path / "metrics.jsonl")
    # Prefill is 200 steps; then one update per environment step, in chunks of 100.
    assert [(r["kind"], r["env_steps"], r["updates"]) for r in records] == [
        ("eval", 200, 0),
        ("train", 300, 100),
        ("train", 400, 200),
        ("eval", 400, 200),
        ("train", 500, 300),
        ("train", 600, 400),
        ("eval", 600, 400),
    ]


TRAIN_FIELDS = {
    "episodes", "episode_return_mean", "episode_return_max", "episode_length_mean", "bad_physics",
    "skipped_updates", "critic_loss", "actor_loss", "q_mean", "entropy", "alpha",
    "actor_grad_norm", "critic_grad_norm",
}  # fmt: skip
PPO_FIELDS = {"approx_kl", "clip_fraction", "explained_variance", "learning_rate"}
EVAL_FIELDS = {
    "episodes", "return_mean", "return_std", "return_min", "return_max", "length_mean",
    "bad_physics",
}  # fmt: skip
TIMING_FIELDS = {
    "chunk_seconds", "steps_per_second", "ms_per_update", "wall_seconds",
}  # fmt: skip


def test_the_schema_is_documented() -> None:
    text = metric_logging.__doc__ or ""
    train_text, rest = text.split('``kind = "train"``')[1].split('``kind = "pretrain"``')
    eval_text, rest = rest.split('``kind = "eval"``')[1].split("``timings.jsonl``")
    timing_text = rest.split("``train.csv``")[0]
    assert set(re.findall(r"``(\w+)``", train_text)) - {"null"} == TRAIN_FIELDS | PPO_FIELDS
    assert set(re.findall(r"``(\w+)``", eval_text)) == EVAL_FIELDS
    assert set(re.findall(r"``(\w+)``", timing_text)) - {"env_steps", "updates"} == TIMING_FIELDS


def test_metrics_obey_their_schema(straight: Outcome) -> None:
    path = straight.result.path / "metrics.jsonl"
    assert path.read_bytes().endswith(b"\n")
    for record in read_records(path):
        assert list(record)[:3] == ["kind", "env_steps", "updates"]
        expected = TRAIN_FIELDS if record["kind"] == "train" else EVAL_FIELDS
        assert set(record) - {"kind", "env_steps", "updates"} == expected
        for name in ("env_steps", "updates", "episodes"):
            assert type(record[name]) is int
        # Hopper falls long before two chunks are over, so no mean is missing here.
        assert all(isinstance(record[name], int | float) for name in expected)


def test_metrics_make_sense(straight: Outcome) -> None:
    for record in read_records(straight.result.path / "metrics.jsonl", "train"):
        assert record["episodes"] >= 1
        assert 1 <= record["episode_length_mean"] <= 50
        assert record["episode_return_max"] >= record["episode_return_mean"]
        assert record["bad_physics"] == 0
        assert record["critic_loss"] > 0
        assert 0 < record["alpha"] < 0.2  # tuned down from its first value
        assert record["actor_grad_norm"] > 0
        assert record["critic_grad_norm"] > 0
    for record in straight.result.evaluations:
        assert (record["episodes"], record["bad_physics"]) == (2, 0)
        assert record["return_min"] <= record["return_mean"] <= record["return_max"]
        # Of two values, the standard deviation is half their distance.
        spread = (record["return_max"] - record["return_min"]) / 2
        assert record["return_std"] == pytest.approx(spread, rel=1e-3, abs=1e-4)
        assert 1 <= record["length_mean"] <= 50


def test_timings_obey_their_schema(straight: Outcome) -> None:
    records = read_records(straight.result.path / "timings.jsonl")
    assert [record["env_steps"] for record in records] == [300, 400, 500, 600]
    assert [record["updates"] for record in records] == [100, 200, 300, 400]
    for record in records:
        assert set(record) == TIMING_FIELDS | {"env_steps", "updates"}
        assert all(record[name] > 0 for name in TIMING_FIELDS)
        speed = record["steps_per_second"]
        assert record["chunk_seconds"] * speed == pytest.approx(100)
        assert record["ms_per_update"] * speed == pytest.approx(1000)


def test_checkpoints_come_when_they_should(straight: Outcome) -> None:
    path = straight.result.path
    assert {p.name for p in (path / "checkpoints").iterdir()} == {"400", "600"}
    best = max(straight.result.evaluations, key=lambda record: record["return_mean"])
    assert [p.name for p in (path / "best").iterdir()] == [str(best["env_steps"])]


def test_an_evaluation_that_physics_cut_off_is_not_the_best(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scripted = iter([(10.0, 1), (-100.0, 0), (50.0, 2)])  # at 200, 400 and 600 steps

    def summarize(_: Any) -> dict[str, Any]:
        return_mean, bad_physics = next(scripted)
        record = dict.fromkeys(EVAL_FIELDS, 2.0)
        return {**record, "episodes": 2, "return_mean": return_mean, "bad_physics": bad_physics}

    monkeypatch.setattr(loop, "summarize", summarize)
    path = tmp_path / "run"
    train(Config.from_preset("cpu", **TINY, run_dir=str(path)), quiet=True)
    assert [p.name for p in (path / "best").iterdir()] == ["400"]


def test_what_cannot_be_written_once_ends_no_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    returns = iter([10.0, 20.0, 30.0])  # at 200, 400 and 600 steps
    best_saves, saves = [], []

    def summarize(_: Any) -> dict[str, Any]:
        return dict.fromkeys(EVAL_FIELDS, 0) | {"episodes": 2, "return_mean": next(returns)}

    def save_best(*arguments: Any) -> None:
        best_saves.append(arguments)
        if len(best_saves) == 2:
            raise CheckpointError("best policy 400 could not be saved")
        save_best_as_it_is(*arguments)

    def save(writer: CheckpointWriter, *arguments: Any) -> None:
        saves.append(arguments)
        if len(saves) == 2:
            raise CheckpointError("checkpoint 600 could not be saved")
        save_as_it_is(writer, *arguments)

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    save_best_as_it_is, save_as_it_is = loop.save_best, CheckpointWriter.save
    monkeypatch.setattr(loop, "summarize", summarize)
    monkeypatch.setattr(loop, "save_best", save_best)
    monkeypatch.setattr(CheckpointWriter, "save", save)
    monkeypatch.setattr(runner, "draw_records", full)
    path = tmp_path / "run"
    result = train(Config.from_preset("cpu", **TINY, run_dir=str(path)))
    assert result.env_steps == 600
    said = capsys.readouterr().out
    assert "best policy 400 could not be saved; training goes on" in said
    assert "checkpoint 600 could not be saved; trying once more" in said
    assert "cannot be written (No space left on device); the run is saved" in said
    # No checkpoint refers to the policy that is not there.
    best = {
        step: read_metadata(path / "checkpoints" / str(step))["progress"]["best"][0]["env_steps"]
        for step in RunFolder(path).steps()
    }
    assert best == {400: 200, 600: 600}
    assert {p.name for p in (path / "best").iterdir()} == {"200", "600"}


def test_a_full_disk_is_told_though_closing_fails_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    close = MetricLog.close

    def close_and_fail(log: MetricLog) -> None:
        close(log)
        full()

    monkeypatch.setattr(MetricLog, "write", full)
    monkeypatch.setattr(MetricLog, "close", close_and_fail)
    config = Config.from_preset("cpu", **TINY, run_dir=str(tmp_path / "run"))
    with pytest.raises(CheckpointError, match=r"No space left on device\): .*make room"):
        train(config, quiet=True)


def test_learning_curve_is_a_png(straight: Outcome) -> None:
    content = (straight.result.path / "learning_curve.png").read_bytes()
    assert content.startswith(b"\x89PNG\r\n\x1a\n")
    assert content.endswith(b"IEND\xaeB`\x82")
    width, height = (int.from_bytes(content[at : at + 4], "big") for at in (16, 20))
    assert width > height > 300


def test_tensorboard_events_are_written(straight: Outcome) -> None:
    content = b"".join(_contents(straight.result.path / "tensorboard").values())
    for tag in (b"eval/return_mean", b"train/critic_loss", b"timing/steps_per_second"):
        assert tag in content


def test_config_json_tells_where_values_come_from(straight: Outcome) -> None:
    contents = json.loads((straight.result.path / "config.json").read_text())
    config = Config.from_dict(contents["config"])
    assert {name: config.flat()[name] for name in TINY} == TINY
    given = {name for name, source in contents["sources"].items() if source == "given"}
    assert given >= {"env", "actor_width", "run_dir"}
    assert "tau" not in given
    assert contents["env_spec"]["obs_size"] == 11


# --- the policy --------------------------------------------------------------------------------


def _observations(count: int) -> np.ndarray:
    return np.random.default_rng(5).normal(size=(count, 11)).astype(np.float32)


def _predictions(policy: Policy, observations: np.ndarray, rewards: np.ndarray) -> np.ndarray:
    """Actions of an episode; ``rewards[i]`` is what step ``i`` gave."""
    state, actions = None, []
    for obs, reward in zip(observations, [0.0, *rewards[:-1]], strict=True):
        action, state = policy.predict(obs, state, reward=reward)
        actions.append(action)
    return np.stack(actions)


def test_predict_is_within_bounds_and_repeats(policy: Policy) -> None:
    observations, rewards = 10 * _observations(9), np.linspace(-5, 5, 9)
    actions = _predictions(policy, observations, rewards)
    assert actions.shape == (9, 3)
    assert actions.dtype == np.float32
    assert (actions >= np.array(policy.spec.action_low)).all()
    assert (actions <= np.array(policy.spec.action_high)).all()
    assert len(np.unique(actions, axis=0)) == 9
    np.testing.assert_array_equal(_predictions(policy, observations, rewards), actions)


def test_predict_ignores_the_reward_only_where_an_episode_starts(policy: Policy) -> None:
    first, second = _observations(2)
    action, state = policy.predict(first)
    np.testing.assert_array_equal(policy.predict(first, reward=1e6)[0], action)
    started, _ = policy.predict(first, state, episode_start=True, reward=1e6)
    np.testing.assert_array_equal(started, action)
    after_one, _ = policy.predict(second, state, reward=1.0)
    assert not np.array_equal(policy.predict(second, state, reward=1e3)[0], after_one)


def _context_by_hand(
    observations: np.ndarray, actions: np.ndarray, rewards: np.ndarray, length: int
) -> Context:
    """The context at the last observation; step ``i`` was ``actions[i]``, giving ``rewards[i]``."""
    steps = len(observations)
    seen = min(steps, length)
    obs = np.zeros((1, length, 11), np.float32)
    return_so_far = np.zeros((1, length), np.float32)
    time_step = np.zeros((1, length), np.int32)
    mask = np.zeros((1, length), bool)
    action = np.zeros((1, length, 3), np.float32)
    for place, step in enumerate(range(steps - seen, steps), start=length - seen):
        obs[0, place] = observations[step]
        return_so_far[0, place] = rewards[:step].sum()
        time_step[0, place] = step
        mask[0, place] = True
        if step < steps - 1:  # the newest is still to come
            action[0, place] = actions[step]
    arrays = (jnp.asarray(x) for x in (obs, action, return_so_far, time_step, mask))
    return Context(*arrays, cache={})


@pytest.mark.parametrize("tokens", ["gs", "joint"])
def test_predict_equals_act_on_a_context_built_by_hand(policy: Policy, tokens: str) -> None:
    if tokens != "gs":
        config = policy.config.replace(tokens=tokens, head_init_scale=1.0)
        agent = agents.make(config, policy.spec)
        learner = agent.init(jax.random.key(0))
        state = policy_state(learner, hyperparameters(config, 3))
        policy = Policy(config, policy.spec, agent, state)
    agent, key = policy.agent, jax.random.key(0)
    act = jax.jit(lambda state, context: agent.act(state, context, key, explore=False).action)
    for steps in (1, 3, 6, 8):  # K is 6
        observations, rewards = _observations(steps), np.arange(1, steps + 1, dtype=np.float32)
        actions = _predictions(policy, observations, rewards)
        context = _context_by_hand(observations, actions, rewards, 6)
        expected = act(policy.state, context)[0]
        np.testing.assert_allclose(actions[-1], expected, rtol=1e-4, atol=1e-6)
        forgotten = act(policy.state, context.replace(action=jnp.zeros_like(context.action)))[0]
        assert np.allclose(forgotten, expected, atol=1e-6) == (tokens == "gs" or steps == 1)


def test_the_latest_policy_acts_too(straight: Outcome, policy: Policy) -> None:
    latest = load_policy(straight.result.path, "latest")
    observation = _observations(1)[0]
    best_is_latest = digest(latest.state) == digest(policy.state)
    same = np.array_equal(latest.predict(observation)[0], policy.predict(observation)[0])
    assert same == best_is_latest


def test_a_policy_loads_without_the_replay(straight: Outcome, tmp_path: Path) -> None:
    path = tmp_path / "run"
    shutil.copytree(straight.result.path, path)
    removed = [*(path / "checkpoints").glob("*/state")]
    assert len(removed) == 2
    for folder in removed:
        shutil.rmtree(folder)
    for which in ("best", "latest"):
        state = load_policy(path, which).state
        assert digest(state) == digest(load_policy(straight.result.path, which).state)


def test_evaluate_on_our_own_environment(straight: Outcome) -> None:
    record: dict[str, Any] = evaluate(straight.result.path, episodes=3, seed=4)
    assert list(record) == ["env", "episodes", "return_mean", "return_std", "length_mean"]
    assert record["env"] == "Hopper"
    assert record["episodes"] == 3
    assert 1 <= record["length_mean"] <= 50
    with pytest.raises(ConfigError, match="episodes=0"):
        evaluate(straight.result.path, episodes=0)

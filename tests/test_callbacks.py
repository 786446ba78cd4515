"""Callbacks: what they are told, that they change nothing, and that stopping loses nothing."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from sacformer_jax import (
    Callback,
    Config,
    ConfigError,
    Event,
    Policy,
    RunResult,
    RunStart,
    StopAtReturn,
    StopWithoutProgress,
    load_policy,
    resume,
    runner,
    train,
)
from sacformer_jax.callbacks import Callbacks
from sacformer_jax.digests import digest
from sacformer_jax.logging import read_records
from sacformer_jax.population import Population, make_population
from sacformer_jax.restoring import Restored
from sacformer_jax.run_folder import RunFolder
from sacformer_jax.stored import Progress

TOTAL = 600
TINY = {
    "agent": "sac", "env": "Hopper", "num_envs": 2, "max_episode_steps": 50,
    "prefill_env_steps": 200, "chunk_env_steps": 100, "total_env_steps": TOTAL, "eval_every": 200,
    "eval_episodes": 2, "checkpoint_every": 400, "actor_width": 8, "actor_layers": 1,
    "critic_width": 8, "batch_size": 4, "buffer_capacity": 2000, "seeds": 2,
}  # fmt: skip


def _config(path: Path) -> Config:
    return Config.from_preset("cpu", **TINY, run_dir=str(path))


class Recorder(Callback):
    """Notes everything it is told."""

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.starts: list[RunStart] = []
        self.chunks: list[Event] = []
        self.evaluations: list[Event] = []
        self.policies: dict[int, tuple[Policy, ...]] = {}
        self.results: list[RunResult | None] = []

    def on_start(self, run: RunStart) -> None:
        self.calls.append("start")
        self.starts.append(run)

    def on_chunk(self, event: Event) -> None:
        self.calls.append("chunk")
        self.chunks.append(event)

    def on_eval(self, event: Event) -> None:
        self.calls.append("eval")
        self.evaluations.append(event)
        self.policies[event.env_steps] = tuple(event.policy(name) for name in event.members)

    def on_end(self, result: RunResult | None) -> None:
        self.calls.append("end")
        self.results.append(result)


class At(Callback):
    """Does something at the end of the chunk that ends at so many steps."""

    def __init__(self, env_steps: int, do: Any):
        self.env_steps, self.do = env_steps, do

    def on_chunk(self, event: Event) -> bool | None:
        return self.do() if event.env_steps == self.env_steps else None


@dataclasses.dataclass(frozen=True)
class Watched:
    """A run to its end, and what a callback saw of it."""

    result: RunResult
    seen: Recorder


@pytest.fixture(scope="module")
def watched(tmp_path_factory: pytest.TempPathFactory) -> Watched:
    """Not to be changed."""
    path, seen = tmp_path_factory.mktemp("runs") / "watched", Recorder()
    return Watched(train(_config(path), quiet=True, callbacks=[Callback(), seen]), seen)


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> Watched:
    """The same run stopped after its second chunk; not to be changed."""
    path, seen = tmp_path_factory.mktemp("runs") / "stopped", Recorder()
    callbacks = [At(400, lambda: False), seen]
    return Watched(train(_config(path), quiet=True, callbacks=callbacks), seen)


def _lines(path: Path, kind: str) -> dict[int, dict[str, Any]]:
    return {record["env_steps"]: record for record in read_records(path / "metrics.jsonl", kind)}


def test_they_are_called_in_order(watched: Watched) -> None:
    seen = watched.seen
    assert seen.calls == [
        *("start", "eval"),  # where learning starts from, after prefill
        *("chunk", "chunk", "eval", "chunk", "chunk", "eval"),
        "end",
    ]
    (start,) = seen.starts
    assert start.path == watched.result.path
    assert (start.env_steps, start.resumed) == (200, False)
    assert (start.spec.name, start.config.agent) == ("Hopper", "sac")
    assert [member.name for member in start.members] == ["seed-0", "seed-1"]
    assert start.sources["total_env_steps"] == "given"
    assert seen.results == [watched.result]


def test_they_are_told_what_is_written(watched: Watched) -> None:
    path = watched.result.path
    timings = {record["env_steps"]: record for record in read_records(path / "timings.jsonl")}
    for kind, events in (("train", watched.seen.chunks), ("eval", watched.seen.evaluations)):
        for name in ("seed-0", "seed-1"):
            lines = _lines(path / name, kind)
            assert {event.env_steps: event.records[name] for event in events} == lines
    assert {event.env_steps: event.timings for event in watched.seen.chunks} == timings
    event = watched.seen.evaluations[-1]
    mean = sum(record["return_mean"] for record in event.records.values()) / 2
    assert event.mean("return_mean") == pytest.approx(mean)


def test_the_policy_is_that_of_the_moment(watched: Watched) -> None:
    policies = watched.seen.policies
    for index, name in enumerate(("seed-0", "seed-1")):
        latest = load_policy(watched.result.path, "latest", name)
        assert digest(policies[TOTAL][index].state) == digest(latest.state)
        best_steps = RunFolder(watched.result.path).member_path(name) / "best"
        for step in (int(path.name) for path in best_steps.iterdir()):
            best = load_policy(watched.result.path, "best", name)
            newest = step == max(int(path.name) for path in best_steps.iterdir())
            assert (digest(policies[step][index].state) == digest(best.state)) == newest
        assert policies[TOTAL][index].config.seed == index
    digests = {digest(policy.state) for own in policies.values() for policy in own}
    assert len(digests) == 2 * len(policies)  # none was overwritten by a later one


def test_a_policy_asked_for_too_late_is_refused(watched: Watched) -> None:
    with pytest.raises(RuntimeError, match="before the callback returns"):
        watched.seen.evaluations[0].policy("seed-0")


def test_one_of_several_members_must_be_named(watched: Watched) -> None:
    event = watched.seen.evaluations[0]
    with pytest.raises(ConfigError, match=r"seed-0, seed-1, take event\.records"):
        _ = event.record
    with pytest.raises(ConfigError, match=r"no number; there are .*return_mean"):
        event.mean("reward")


def test_false_stops_the_run_and_it_goes_on_as_if_nothing_had_been(
    watched: Watched, stopped: Watched, tmp_path: Path
) -> None:
    result = stopped.result
    assert (result.env_steps, result.stopped, result.interrupted) == (400, True, False)
    # The chunk's evaluation was still made, and every callback saw all of it.
    assert stopped.seen.calls == ["start", "eval", "chunk", "chunk", "eval", "end"]
    path, seen = tmp_path / "stopped", Recorder()
    shutil.copytree(result.path, path)
    result = resume(path, quiet=True, callbacks=[seen])
    assert (result.env_steps, result.stopped, result.interrupted) == (TOTAL, False, False)
    assert seen.calls == ["start", "chunk", "chunk", "eval", "end"]
    assert (seen.starts[0].env_steps, seen.starts[0].resumed) == (400, True)
    for name in ("seed-0", "seed-1"):
        ends = [load_policy(run, "latest", name).state for run in (path, watched.result.path)]
        assert digest(ends[0]) == digest(ends[1])
        metrics = [(run / name / "metrics.jsonl") for run in (path, watched.result.path)]
        assert metrics[0].read_bytes() == metrics[1].read_bytes()


@pytest.mark.parametrize(
    ("answer", "stops"),
    [
        (False, True), (np.float64(1) > 2, True), (jnp.array(1) > 2, True), (True, False),
        (np.True_, False), (None, False), (0, False), ("", False),
    ],
)  # fmt: skip
def test_only_false_stops(answer: Any, stops: bool) -> None:
    no_population: Any = None
    state: Any = SimpleNamespace(counters=SimpleNamespace(env_steps=0))
    callbacks = Callbacks([At(0, lambda: answer)], no_population, Path())
    callbacks.chunk(state, {}, {})
    assert callbacks.stop is stops
    callbacks.raise_error()


def test_an_error_ends_the_run_after_it_was_saved(tmp_path: Path) -> None:
    def fail() -> None:
        # Not to be taken for one of the run's own files.
        raise OSError(28, "no space for the callback's file")

    seen = Recorder()
    with pytest.raises(OSError, match="the callback's file"):
        train(_config(tmp_path / "run"), quiet=True, callbacks=[At(400, fail), seen])
    assert seen.calls == ["start", "eval", "chunk", "chunk", "eval", "end"]
    assert seen.results == [None]
    assert RunFolder(tmp_path / "run").latest_step() == 400


def test_an_error_at_the_start_comes_before_anything_is_computed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Failing(Callback):
        def on_start(self, run: RunStart) -> None:
            raise ValueError(f"not in {run.path.name}")

    def begun(*_: Any) -> None:
        pytest.fail("something is computed")

    def made(*arguments: Any) -> Population:
        return dataclasses.replace(make_population(*arguments), prefill=begun, refill=begun)

    monkeypatch.setattr(runner, "make_population", made)
    seen = Recorder()
    with pytest.raises(ValueError, match="not in run"):
        train(_config(tmp_path / "run"), quiet=True, callbacks=[Failing(), seen])
    assert seen.calls == ["start", "end"]
    # Nor is a replay that was not saved filled again.
    path, config = tmp_path / "run", _config(tmp_path / "run").replace(checkpoint_replay=False)
    folder = RunFolder(path)
    folder.create(config, {}, seen.starts[0].spec, seen.starts[0].members)
    progress = Progress(env_steps=400, best=(None, None), metrics_bytes=(0, 0))
    restored = Restored(seen, progress, 1, {}, ())  # type: ignore[arg-type]
    monkeypatch.setattr(RunFolder, "latest_step", lambda folder: 400)
    monkeypatch.setattr(RunFolder, "restore", lambda *_: restored)
    with pytest.raises(ValueError, match="not in run"):
        resume(path, total_env_steps=1_000, quiet=True, callbacks=[Failing(), seen])
    assert seen.calls == 2 * ["start", "end"]
    assert (seen.starts[1].resumed, seen.starts[1].env_steps) == (True, 600)


# --- the ready-made ones -------------------------------------------------------------------------


def _evaluated(*returns: float) -> Event:
    records = {f"seed-{i}": {"return_mean": value} for i, value in enumerate(returns)}
    return Event(Path("run"), 100, records, {}, lambda member: pytest.fail("no policy is needed"))


def test_stop_at_a_return_of_the_mean_over_members() -> None:
    callback = StopAtReturn(10.0)
    assert callback.on_eval(_evaluated(5.0, 14.0)) is True
    assert callback.on_eval(_evaluated(5.0, 15.0)) is False


def test_stop_without_progress() -> None:
    callback = StopWithoutProgress(evaluations=2, min_progress=1.0)
    answers = [callback.on_eval(_evaluated(value)) for value in (0.0, 1.0, 1.5, 2.0, 2.5)]
    # 1.0 is not more than one above 0.0; 1.5 is; then two without.
    assert answers == [True, True, True, True, False]


@pytest.mark.parametrize(
    ("values", "message"),
    [((0,), "evaluations=0: must be at least 1"), ((1, -0.5), "min_progress=-0.5")],
)
def test_senseless_patience_is_refused(values: tuple[Any, ...], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        StopWithoutProgress(*values)

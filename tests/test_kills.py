"""Kills of runs: that a resumed run equals one that was not killed, and that a difference shows."""

from __future__ import annotations

import json
import os
import random
from collections.abc import Iterator
from pathlib import Path

import bench.kills
import faults
import pytest
from bench import watched
from bench.kills import SETTINGS, Kill, Runs, differences, kill_runs, planned

SHORT = {**SETTINGS, "total_env_steps": 3600}


# --- two kills ---------------------------------------------------------------------------------


def test_a_run_killed_twice_equals_one_that_was_not(tmp_path: Path) -> None:
    runs, kills = Runs(tmp_path, SHORT), list[Kill]()
    runs.finish("reference")
    plan = ["chunk", "checkpoint"]
    names = list(kill_runs(runs, plan, random.Random(1), kills.append))
    assert [kill.aimed for kill in kills] == plan
    assert [kill.number for kill in kills] == [1, 2]
    # A moment drawn for one phase may fall into the next, but not both do so.
    assert any(kill.phase == kill.aimed for kill in kills)
    reference = runs.left("reference")
    assert {"train state", "metrics.jsonl", "best policy"} == set(reference)
    for name in names:
        assert differences(reference, runs.left(name)) == []
    # A line too many, as if a resumed run had not cut its metrics back, is seen.
    metrics = tmp_path / names[0] / "metrics.jsonl"
    metrics.write_bytes(metrics.read_bytes() + metrics.read_bytes().splitlines(keepends=True)[-1])
    assert differences(reference, runs.left(names[0])) == ["metrics.jsonl"]


def test_what_only_one_run_has_is_a_difference() -> None:
    assert differences({"a": "1", "b": "2"}, {"a": "1"}) == ["b"]
    assert differences({"a": "1"}, {"a": "1", "b": "2"}) == ["b"]
    assert differences({"a": "1", "b": "2"}, {"b": "2", "a": "1"}) == []


def test_every_phase_is_aimed_at() -> None:
    plan = planned(12, random.Random(0))
    counts = sorted(plan.count(phase) for phase in watched.PHASES)
    assert counts == [2, 2, 2, 3, 3]
    assert plan == planned(12, random.Random(0)) != planned(12, random.Random(1))


# --- phases, of a process that does nothing ----------------------------------------------------


class Watching:
    """A watched process, and the run folder that its phases are read from."""

    def __init__(self, folder: Path):
        self.run = folder / "run"
        self.run.mkdir()
        self.metrics = self.run / "metrics.jsonl"
        self.process: watched.Process | None = None

    def start(self) -> None:
        log = self.run.parent / "log"
        self.process = watched.Process(self.run, SHORT, ["--version"], dict(os.environ), log)

    def record(self, kind: str, env_steps: int) -> str:
        """Appends a line of metrics; the phase after it."""
        with self.metrics.open("a") as lines:
            lines.write(json.dumps({"kind": kind, "env_steps": env_steps}) + "\n")
        return self.phase()

    def checkpoint(self, name: str, folder: str = "checkpoints") -> str:
        (self.run / folder / name).mkdir(parents=True)
        return self.phase()

    def phase(self) -> str:
        assert self.process is not None
        return self.process.phase()


@pytest.fixture
def watching(tmp_path: Path) -> Iterator[Watching]:
    watching = Watching(tmp_path)
    yield watching
    if watching.process:
        watching.process.close()


def test_phases_of_a_new_run(watching: Watching) -> None:
    watching.start()
    assert watching.phase() == "compile"
    assert watching.record("eval", 400) == "chunk"  # where learning starts from
    assert watching.record("train", 800) == "evaluation"
    assert watching.record("eval", 800) == "chunk"
    assert watching.checkpoint("800.tmp", "best") == "best"
    (watching.run / "best" / "800.tmp").rename(watching.run / "best" / "800")
    assert watching.phase() == "chunk"
    assert watching.record("train", 1200) == "checkpoint"
    assert watching.checkpoint("1200.tmp") == "checkpoint"
    (watching.run / "checkpoints" / "1200.tmp").rename(watching.run / "checkpoints" / "1200")
    assert watching.phase() == "chunk"
    assert watching.record("train", 3600) == "evaluation"  # whenever it ends
    assert watching.record("eval", 3600) == "checkpoint"
    assert watching.checkpoint("3600") == "end"
    assert watching.process is not None
    assert watching.process.begun["evaluation"] == 2
    assert [phase for phase, _ in watching.process.durations[:3]] == [
        "compile", "chunk", "evaluation",
    ]  # fmt: skip
    assert watched.newest_checkpoint(watching.run) == 3600


def test_phases_of_a_resumed_run(watching: Watching) -> None:
    """Its metrics are longer than where it goes on; of a killed one something is left over."""
    watching.start()
    for kind, env_steps in (("eval", 400), ("train", 800), ("eval", 800), ("train", 1200)):
        watching.record(kind, env_steps)
    watching.checkpoint("1200")
    watching.checkpoint("2400.tmp")
    kept = watching.metrics.read_bytes()
    watching.record("train", 1600)
    watching.start()
    assert watching.phase() == "compile"
    watching.metrics.write_bytes(kept)
    assert watching.phase() == "compile"
    assert watching.record("train", 1600) == "evaluation"
    assert watching.record("eval", 1600) == "chunk"
    (watching.run / "checkpoints" / "2400.tmp").rmdir()
    assert watching.record("train", 2400) == "evaluation"
    assert watching.record("eval", 2400) == "checkpoint"
    assert watching.checkpoint("2400.tmp") == "checkpoint"


def test_an_unfinished_line_is_no_record(watching: Watching) -> None:
    watching.start()
    watching.record("train", 1200)
    with watching.metrics.open("a") as lines:
        lines.write('{"kind": "ev')
    assert watched.last_record(watching.run) == {"kind": "train", "env_steps": 1200}


def test_of_several_seeds_the_first_is_watched(watching: Watching) -> None:
    watching.start()
    for name in ("seed-1", "seed-0"):
        (watching.run / name).mkdir()
    watching.metrics = watching.run / "seed-0" / "metrics.jsonl"
    assert watching.record("train", 800) == "evaluation"
    assert [path.name for path in watched.members(watching.run)] == ["seed-0", "seed-1"]
    assert watching.checkpoint("800.tmp", "seed-1/best") == "best"


# --- the command -------------------------------------------------------------------------------


class FakeRuns:
    """Runs that leave what is said here."""

    def __init__(self, left: dict[str, dict[str, str]]):
        self.left = left.__getitem__

    def finish(self, name: str) -> None:
        assert name == "again"


@pytest.mark.parametrize(("digest", "good"), [("1", True), ("2", False)])
def test_a_difference_is_told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], digest: str, good: bool
) -> None:
    def killing(runs, plan, moments, told):
        assert len(plan) == 2
        told(Kill(1, "killed-1", "chunk", "checkpoint", 2800, 2400))
        told(Kill(2, "killed-1", "compile", "compile", 0, 0))
        yield "killed-1"

    monkeypatch.setattr(bench.kills, "kill_runs", killing)
    runs = FakeRuns({"again": {"train state": "1"}, "killed-1": {"train state": digest}})
    found = bench.kills.check_kills(runs, 2, random.Random(0), {"train state": "1"})
    assert found["good"] == good
    assert found["tally"] == {"compile": 1, "checkpoint": 1}
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split() == ["1", "killed-1", "chunk", "checkpoint", "2,800", "2,400"]
    assert lines[2].split() == ["2", "killed-1", "compile", "compile", "0", "the", "start"]
    assert lines[3] == "1 in compile, 1 in checkpoint"
    assert lines[4] == "again: equal, bit for bit"
    assert lines[5] == "killed-1: " + ("equal, bit for bit" if good else "not equal: train state")


def test_a_run_that_fails_is_told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def killing(runs, plan, moments, told):
        told(Kill(1, "killed-1", "chunk", "chunk", 800, 0))
        yield from ()
        raise RuntimeError("killed-1: status 2: error: damaged")

    monkeypatch.setattr(bench.kills, "kill_runs", killing)
    found = bench.kills.check_kills(FakeRuns({"again": {}}), 5, random.Random(0), {})
    assert not found["good"]
    assert "killed-1: not equal: killed-1: status 2: error: damaged" in capsys.readouterr().out


@pytest.mark.parametrize("good", [(True, True), (True, False), (False, True)])
def test_the_exit_code_and_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, good: tuple[bool, bool]
) -> None:
    def kills(runs, kills, *_):
        return {"n": kills, "good": good[0]}

    def others(runs, names, _):
        return {"names": names, "good": good[1]}

    monkeypatch.setattr(Runs, "finish", lambda runs, name: None)
    monkeypatch.setattr(Runs, "left", lambda runs, name: {})
    monkeypatch.setattr(faults, "check_kills", kills)
    monkeypatch.setattr(faults, "check_faults", others)
    path = tmp_path / "results.json"
    code = faults.main(["--kills", "7", "--seeds", "2", "--seed", "3", "--json", str(path)])
    results = json.loads(path.read_text())
    assert code == (good != (True, True))
    assert results["good"] == (good == (True, True))
    assert (results["n"], results["settings"]["seeds"], results["seed"]) == (7, 2, 3)
    assert results["names"] == list(faults.FAULTS)
    faults.main(["--only", "full-disk", "--json", str(path)])
    results = json.loads(path.read_text())
    assert results["names"] == ["full-disk"]
    assert "n" not in results
    faults.main(["--kills", "1", "--only", "--json", str(path)])
    assert "names" not in json.loads(path.read_text())


@pytest.mark.parametrize(("resumed", "wrong"), [
    ({"train state": "1"}, []), ({"train state": "2"}, ["train state differs"]),
])  # fmt: skip
def test_what_a_fault_left_is_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, resumed: dict[str, str], wrong: list[str]
) -> None:
    def fault(runs, name):
        (tmp_path / f"{name}.log").write_text("error: no space\nand so on\n")
        return "what was done", []

    runs = Runs(tmp_path, SHORT)
    monkeypatch.setattr(runs, "finish", lambda name: None)
    monkeypatch.setattr(runs, "left", lambda name: resumed)
    monkeypatch.setitem(faults.HURTS, "full-disk", fault)
    monkeypatch.setitem(faults.FAULTS, "full-disk", fault)
    outcome = faults.hurt(runs, "full-disk", {"train state": "1"})
    assert outcome == faults.Outcome("full-disk", "what was done", ["error: no space"], wrong)
    with (tmp_path / "full-disk.log").open("a") as log:
        log.write("Traceback (most recent call last):\n")
    monkeypatch.setitem(faults.FAULTS, "full-disk", lambda runs, name: ("", []))
    assert "it printed tracebacks" in faults.hurt(runs, "full-disk", resumed).wrong


def test_runs_are_not_mixed_with_older_ones(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "reference").mkdir()
    with pytest.raises(SystemExit, match="2"):
        faults.main(["--keep", str(tmp_path)])
    assert "holds runs already" in capsys.readouterr().err

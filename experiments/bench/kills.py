"""Runs killed at random moments and resumed, and whether they equal one that was not killed."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import io
import json
import random
import statistics
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from bench.watched import PHASES, Process, last_record, members, newest_checkpoint
from sacformer_jax import load_policy
from sacformer_jax.cli import main
from sacformer_jax.digests import digest

SETTINGS: dict[str, int | float | str] = {
    "env": "Hopper", "num_envs": 2, "max_episode_steps": 200, "prefill_env_steps": 400,
    "chunk_env_steps": 400, "total_env_steps": 6000, "eval_every": 800, "eval_episodes": 16,
    "checkpoint_every": 1200, "actor_width": 8, "actor_heads": 1, "actor_layers": 1,
    "critic_width": 8, "batch_size": 8, "buffer_capacity": 20_000, "updates_per_env_step": 1.0,
}  # fmt: skip
"""A small run; some checkpoints fall together with an evaluation, some do not."""


@dataclasses.dataclass(frozen=True)
class Kill:
    """A run killed by SIGKILL.

    Attributes:
      number: which of all kills, from 1.
      run: its name.
      aimed: the phase waited for.
      phase: the phase in which it was when it had died, by what it left.
      env_steps: of its last record.
      resumed_at: environment steps of its newest whole checkpoint; 0: it starts from the beginning.
    """

    number: int
    run: str
    aimed: str
    phase: str
    env_steps: int
    resumed_at: int


class Runs:
    """Runs with the same settings, side by side in a folder.

    Args:
      folder: where they lie, with their logs and a compilation cache that they share.
      settings: fields of the configuration.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any] = SETTINGS):
        self.folder, self.settings = folder.absolute(), dict(settings)
        self.folder.mkdir(parents=True, exist_ok=True)
        self.durations: dict[str, list[float]] = {phase: [] for phase in (*PHASES, "end")}
        self._environment = {
            "JAX_ENABLE_COMPILATION_CACHE": "true",
            "JAX_COMPILATION_CACHE_DIR": str(self.folder / "compiled"),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.1",
            "PYTHONUNBUFFERED": "1",
        }

    def start(
        self, name: str, place: Path | None = None, again: bool = False, **others: Any
    ) -> Process:
        """Trains the run, or resumes it where its folder holds one already.

        Args:
          name: of the run, and of its log.
          place: its folder; default: by its name.
          again: train it even where it can be resumed.
          others: settings of a new run that are other ones than usual.
        """
        run = place or self.folder / name
        flags = [
            part
            for key, value in {**self.settings, **others}.items()
            for part in (f"--{key.replace('_', '-')}", str(value))
        ]
        begun = (run / "config.json").is_file() and not again
        arguments = ["resume", str(run)] if begun else ["train", "--run-dir", str(run), *flags]
        log = self.folder / f"{name}.log"
        return Process(run, self.settings, arguments, self._environment, log)

    def finish(self, name: str) -> None:
        """Trains or resumes the run to its end.

        Raises:
          RuntimeError: it failed.
        """
        process = self.start(name)
        try:
            self.ended_well(process)
        finally:
            process.close()

    def ended_well(self, process: Process) -> None:
        """Waits for the end of a run, and keeps how long its phases took.

        Raises:
          RuntimeError: it failed.
        """
        code = process.wait()
        self.keep_durations(process)
        if code:
            lines = process.printed.strip().splitlines() or ["nothing printed"]
            raise RuntimeError(f"{process.run}: status {code}: {lines[-1]} (see {process.log})")

    def keep_durations(self, process: Process) -> None:
        """Takes over how long the phases of a process took."""
        for phase, seconds in process.durations:
            self.durations[phase].append(seconds)
        process.durations.clear()

    def usual_seconds(self, phase: str) -> float:
        """How long a phase takes: median; of compiling the least, with the programs in the cache.

        Nothing seen of it yet: a second.
        """
        seen = self.durations[phase] or [1.0]
        return min(seen) if phase == "compile" else statistics.median(seen)

    def left(self, name: str) -> dict[str, str]:
        """What a run left, by what it is: digests of all that two equal runs have in common.

        Raises:
          RuntimeError: its state cannot be read.
        """
        run = self.folder / name
        with (
            contextlib.redirect_stdout(io.StringIO()) as printed,
            contextlib.redirect_stderr(io.StringIO()) as said,
        ):
            try:
                code = main(["describe", str(run), "--json"])
            except Exception as error:
                raise RuntimeError(f"{run}: {error}") from error
        if code:
            lines = said.getvalue().strip().splitlines() or ["no output"]
            raise RuntimeError(f"{run}: {lines[-1]}")
        found = {"train state": json.dumps(json.loads(printed.getvalue())["digest"])}
        for folder in members(run):
            alone = folder == run
            at = "" if alone else f"{folder.name}/"
            metrics = (folder / "metrics.jsonl").read_bytes()
            found[f"{at}metrics.jsonl"] = hashlib.sha256(metrics).hexdigest()
            policy = load_policy(run, "best", None if alone else folder.name)
            steps = sorted(path.name for path in (folder / "best").iterdir())
            found[f"{at}best policy"] = f"{steps} {digest(policy.state)}"
        return found


def differences(left: Mapping[str, str], right: Mapping[str, str]) -> list[str]:
    """Names of what is not equal in two answers of :meth:`Runs.left`."""
    return [name for name in sorted({*left, *right}) if left.get(name) != right.get(name)]


def kill_runs(
    runs: Runs, plan: Sequence[str], moments: random.Random, told: Callable[[Kill], None]
) -> Iterator[str]:
    """Kills runs until as many kills as planned have happened; names of the runs, each at its end.

    Args:
      runs: holds a finished run already, from which it is known how long phases take.
      plan: the phase to wait for before each kill, once or a few times; the kill comes a random
        time of up to the phase's usual length later, and may so fall into the next one.
      moments: draws those times.
      told: called after each kill.
    """
    number, count = 0, 0
    while number < len(plan):
        count += 1
        name, over = f"killed-{count}", False
        while not over and number < len(plan):
            process = runs.start(name)
            try:
                over = not _reached(process, plan[number], moments, runs)
                if over:
                    runs.ended_well(process)
                    break
            finally:
                process.close()
            phase, number = process.phase(), number + 1
            runs.keep_durations(process)
            at, record = newest_checkpoint(process.run), last_record(process.run)
            steps = record["env_steps"] if record and phase != "compile" else at
            told(Kill(number, name, plan[number - 1], phase, steps, at))
            over = phase == "end"
        if not over:
            runs.finish(name)
        yield name


def _reached(process: Process, phase: str, moments: random.Random, runs: Runs) -> bool:
    """Waits for the phase, not always its first time, and longer; False if the run ended before."""
    times = 1 if phase == "compile" else moments.randint(1, 3)
    if not process.watch(lambda: process.begun[phase] >= times):
        return False
    until = time.monotonic() + moments.uniform(0.0, runs.usual_seconds(phase))
    return process.watch(lambda: time.monotonic() >= until)


def planned(kills: int, moments: random.Random) -> list[str]:
    """All phases equally often, within one, in random order."""
    plan = [PHASES[i % len(PHASES)] for i in range(kills)]
    moments.shuffle(plan)
    return plan


def check_kills(
    runs: Runs, kills: int, moments: random.Random, reference: Mapping[str, str]
) -> dict[str, Any]:
    """Kills runs so often, prints each kill and what they came to, and returns it all.

    Args:
      runs: holds a finished run already.
      kills: how many.
      moments: draws when.
      reference: what that run left.
    """
    # Once more, to know how long everything takes when all programs are compiled.
    runs.finish("again")
    wrong = {"again": differences(reference, runs.left("again"))}
    done: list[Kill] = []
    print(f"{'kill':>4}  {'run':<10} {'aimed at':<10} {'hit':<10} {'env steps':>9}  resumed at")

    def told(kill: Kill) -> None:
        done.append(kill)
        resumed = f"{kill.resumed_at:,}" if kill.resumed_at else "the start"
        print(
            f"{kill.number:>4}  {kill.run:<10} {kill.aimed:<10} {kill.phase:<10} "
            f"{kill.env_steps:>9,}  {resumed}",
            flush=True,
        )

    try:
        for name in kill_runs(runs, planned(kills, moments), moments, told):
            wrong[name] = differences(reference, runs.left(name))
    except RuntimeError as error:
        wrong[done[-1].run if done else "killed-1"] = [str(error)]
    tally = Counter(kill.phase for kill in done)
    print(", ".join(f"{tally[phase]} in {phase}" for phase in (*PHASES, "end") if tally[phase]))
    for name, what in wrong.items():
        print(f"{name}: {'not equal: ' + ', '.join(what) if what else 'equal, bit for bit'}")
    return {
        "kills": [dataclasses.asdict(kill) for kill in done],
        "tally": dict(tally),
        "differences": wrong,
        "good": not any(wrong.values()),
    }

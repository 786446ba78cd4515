"""What happens to a run when something goes wrong, beside one to which nothing happened.

python experiments/faults.py                          # every fault once, except kills
python experiments/faults.py --kills 20               # and kill -9 at 20 random moments
python experiments/faults.py --kills 20 --only        # kills alone
python experiments/faults.py --kills 20 --seeds 2     # of a run with two seeds
python experiments/faults.py --only full-disk --keep runs/faults

A run that was hurt and resumed must equal the other bit for bit: its train state, every line of
its metrics, its best policy.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

from bench.kills import SETTINGS, Runs, check_kills, differences
from bench.watched import Process, newest_checkpoint

from sacformer_jax import stored
from sacformer_jax.cli import EXIT_BAD_INPUT, EXIT_DIVERGED, EXIT_INTERRUPTED, EXIT_KILLED
from sacformer_jax.cores import usable_cores

REFERENCE = "reference"
"""Name of the run to which nothing happens."""

Fault = Callable[[Runs, str], tuple[str, list[str]]]
"""Lets a fault happen to the run of that name; what happened in words, and what was wrong."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What came of a fault.

    Attributes:
      fault: its name.
      happened: what was done and what the run did, in words.
      said: its errors and notes, also those of the resumed run.
      wrong: everything that is not as it must be; empty where all is well.
    """

    fault: str
    happened: str
    said: list[str]
    wrong: list[str]


@contextmanager
def _trained_to(runs: Runs, name: str, checkpoints: int) -> Iterator[Process]:
    """A run at work on a chunk, after so many of its checkpoints."""
    enough = checkpoints * int(runs.settings["checkpoint_every"])
    process = runs.start(name)

    def reached() -> bool:
        return process.phase() == "chunk" and newest_checkpoint(process.run) >= enough

    try:
        if not process.watch(reached):
            runs.ended_well(process)  # raises where it failed
            raise RuntimeError(f"{process.run}: too short to be stopped")
        yield process
    finally:
        process.close()


def _stopped(runs: Runs, name: str, checkpoints: int = 2) -> Path:
    """The newest checkpoint of a run that was stopped after at least so many."""
    with _trained_to(runs, name, checkpoints) as process:
        process.signal(signal.SIGTERM)
        process.wait()
    return process.run / "checkpoints" / str(newest_checkpoint(process.run))


def _ended(process: Process, code: int, *words: str) -> list[str]:
    """Lets a process end; what is wrong where it does otherwise or does not say these words."""
    try:
        got = process.wait()
    finally:
        process.close()
    wrong = [] if got == code else [f"exit code {got}, not {code}"]
    return wrong + [f"it did not say {word!r}" for word in words if word not in process.printed]


def _contents(folder: Path) -> dict[str, str]:
    """Digests of all files of a run but its lock."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != "lock")
    return {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


# --- signals -----------------------------------------------------------------------------------


def stopped(number: signal.Signals) -> Fault:
    """A fault: a signal; the chunk is finished, a checkpoint written, exit code 3."""

    def fault(runs: Runs, name: str) -> tuple[str, list[str]]:
        with _trained_to(runs, name, 1) as process:
            before = newest_checkpoint(process.run)
            process.signal(number)
            wrong = _ended(process, EXIT_INTERRUPTED, "continue with")
        saved = newest_checkpoint(process.run)
        if saved <= before:
            wrong.append(f"no checkpoint after that at {before}")
        return f"exit code {EXIT_INTERRUPTED}, checkpoint at {saved}", wrong

    return fault


def stopped_twice(number: signal.Signals, code: int) -> Fault:
    """A fault: a signal twice; it ends at once, and what was saved before is whole."""

    def fault(runs: Runs, name: str) -> tuple[str, list[str]]:
        with _trained_to(runs, name, 1) as process:
            before = newest_checkpoint(process.run)
            process.signal(number)
            # Two signals at once are one; the first is heard when the program is back in Python.
            if not process.watch(lambda: "once more" in process.printed):
                return f"exit code {process.wait()}", ["it ended before the second signal"]
            process.signal(number)
            start = time.monotonic()
            wrong = _ended(process, code)
            seconds = time.monotonic() - start
        if newest_checkpoint(process.run) < before:
            wrong.append(f"checkpoint {before} is gone")
        return f"exit code {code} after {1e3 * seconds:.0f} ms", wrong

    return fault


# --- folders that cannot be written ------------------------------------------------------------


def full_disk(runs: Runs, name: str) -> tuple[str, list[str]]:
    """No file may grow beyond half of a checkpoint's largest: writing fails as on a full disk."""
    with _trained_to(runs, name, 1) as process:
        before = newest_checkpoint(process.run)
        limit = _largest_file(process.run / "checkpoints" / str(before)).stat().st_size // 2
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (limit, limit))
        wrong = _ended(process, EXIT_BAD_INPUT, "error: ")
    if not (process.run / "checkpoints" / str(before)).is_dir():
        wrong.append(f"checkpoint {before} is gone")
    return f"no file over {limit:,} bytes: exit code {EXIT_BAD_INPUT}", wrong


def read_only(runs: Runs, name: str) -> tuple[str, list[str]]:
    """The folder of a run at work turns read-only; then the run is resumed while it still is."""
    with _trained_to(runs, name, 1) as process:
        process.signal(signal.SIGSTOP)
        before = newest_checkpoint(process.run)
        with _unwritable(process.run) as how:
            if not how:
                process.signal(signal.SIGCONT)
                return _below_a_file(runs, name)
            process.signal(signal.SIGCONT)
            wrong = _ended(
                process, EXIT_BAD_INPUT, "error: ", "Read-only" if "mount" in how else ""
            )
            kept = _contents(process.run)
            wrong += _ended(runs.start(name), EXIT_BAD_INPUT, "error: ", "cannot be written")
            if _contents(process.run) != kept:
                wrong.append("something changed")
    if newest_checkpoint(process.run) < before:
        wrong.append(f"checkpoint {before} is gone")
    code = EXIT_BAD_INPUT
    return f"{how}: exit code {code}; resumed there: exit code {code}, nothing changed", wrong


@contextmanager
def _unwritable(folder: Path) -> Iterator[str]:
    """Makes a folder read-only for a time; how, or nothing where that is not to be had."""
    if os.geteuid():
        folders = [folder, *(path for path in folder.rglob("*") if path.is_dir())]
        for path in folders:
            path.chmod(0o555)
        yield "chmod 555"
        for path in folders:
            path.chmod(0o755)
        return
    try:  # root may write whatever the permissions say
        subprocess.run(["mount", "--bind", folder, folder], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        yield ""
        return
    try:
        subprocess.run(["mount", "-o", "remount,ro,bind", folder], check=True)
        yield "read-only bind mount"
    finally:
        subprocess.run(["umount", folder], check=True)


def _below_a_file(runs: Runs, name: str) -> tuple[str, list[str]]:
    (runs.folder / "file").write_text("in the way")
    process = runs.start(name, runs.folder / "file" / "run")
    wrong = _ended(process, EXIT_BAD_INPUT, "cannot be written")
    return f"no mounts here; started below a file: exit code {EXIT_BAD_INPUT}", wrong


def two_runs(runs: Runs, name: str) -> tuple[str, list[str]]:
    """A run in whose folder another one trains, resumed and started anew: both are refused."""
    with _trained_to(runs, name, 1) as process:
        process.signal(signal.SIGSTOP)  # or it would be over before the others have started
        kept = _contents(process.run)
        holder = f"is being trained by process {process.pid}"
        wrong = _ended(runs.start(name), EXIT_BAD_INPUT, holder)
        wrong += _ended(runs.start(name, again=True), EXIT_BAD_INPUT, holder)
        if _contents(process.run) != kept:
            wrong.append("something changed")
        process.signal(signal.SIGCONT)
        wrong += _ended(process, 0)
    return f"two others refused, exit code {EXIT_BAD_INPUT}; the first ends well", wrong


# --- checkpoints -------------------------------------------------------------------------------


def _largest_file(folder: Path) -> Path:
    files = (path for path in folder.rglob("*") if path.is_file())
    return max(files, key=lambda path: path.stat().st_size)


def _flip(file: Path) -> None:
    contents = bytearray(file.read_bytes())
    contents[len(contents) // 2] ^= 1
    file.write_bytes(contents)


def _cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def damaged(harm: Callable[[Path], None]) -> Fault:
    """A fault: the largest file of the newest checkpoint of a stopped run is harmed."""

    def fault(runs: Runs, name: str) -> tuple[str, list[str]]:
        newest = _stopped(runs, name)
        harm(_largest_file(newest))
        wrong = _ended(runs.start(name), 0, f"checkpoint {newest} is damaged", "moved to")
        return f"the largest file of the newest checkpoint, {newest.name}", wrong

    return fault


def unfit(change: Callable[[Path], Path], *words: str) -> Fault:
    """A fault: a file is made another one, for a time, which is no damage: resuming is refused.

    Args:
      change: makes the file of the run with this newest checkpoint another one; which it is.
      words: said then.
    """

    def fault(runs: Runs, name: str) -> tuple[str, list[str]]:
        newest = _stopped(runs, name)
        run = newest.parent.parent
        was = _contents(run)
        path = change(newest)
        changed = _contents(run)
        (other,) = (Path(file) for file in was if was[file] != changed[file])
        wrong = _ended(runs.start(name), EXIT_BAD_INPUT, *words)
        if _contents(run) != changed:
            wrong.append("something changed")
        path.replace(other)
        return f"exit code {EXIT_BAD_INPUT}, nothing changed; put back", wrong

    return fault


def _another_config(newest: Path) -> Path:
    path = newest.parent.parent / "config.json"
    kept = path.rename(newest.parent.parent.with_suffix(".kept"))
    contents = json.loads(kept.read_text())
    contents["config"]["sac"]["tau"] = 0.25
    path.write_text(json.dumps(contents))
    return kept


def _another_version(newest: Path) -> Path:
    path = newest / "metadata" / "metadata"
    kept = path.rename(newest.parent.parent.with_suffix(".kept"))
    contents = json.loads(kept.read_text())
    del contents["digest"]
    path.write_text(json.dumps(stored.sealed({**contents, "format": 99, "version": "9.8.7"})))
    return kept


# --- runs that cannot go on --------------------------------------------------------------------


def diverged(runs: Runs, name: str) -> tuple[str, list[str]]:
    """A critic's learning rate of 1e25: updates that are not finite, more than may be skipped."""
    process = runs.start(name, critic_learning_rate=1e25, max_skipped_updates=150)
    wrong = _ended(process, EXIT_DIVERGED, "fault.json", "max_skipped_updates=150")
    fault = json.loads((process.run / "fault.json").read_text())
    if fault["learner_values_not_finite"]:
        wrong.append("an update that was not finite got into the learner")
    if not newest_checkpoint(process.run):
        wrong.append("no checkpoint")
    return (
        f"exit code {EXIT_DIVERGED} at {fault['env_steps']:,} env steps, {fault['skipped_updates']}"
        f" of {fault['updates']} updates skipped, not finite first: "
        f"{fault['first_tensor_not_finite']}"
    ), wrong


def no_memory(runs: Runs, name: str) -> tuple[str, list[str]]:
    """A replay of 2,000,000,000 steps: refused before anything is written or allocated."""
    process, start = runs.start(name, buffer_capacity=2_000_000_000), time.monotonic()
    wrong = _ended(process, EXIT_BAD_INPUT, "buffer_capacity=2000000000", "GiB", "use at most")
    if process.run.exists():
        wrong.append("something was written")
    seconds = time.monotonic() - start
    return f"exit code {EXIT_BAD_INPUT} after {seconds:.1f} s, imports included", wrong


HURTS: dict[str, Fault] = {
    "sigterm": stopped(signal.SIGTERM),
    "sigterm-twice": stopped_twice(signal.SIGTERM, -signal.SIGTERM),
    "sigint": stopped(signal.SIGINT),
    "sigint-twice": stopped_twice(signal.SIGINT, EXIT_KILLED),
    "full-disk": full_disk,
    "read-only": read_only,
    "two-runs": two_runs,
    "bit-flipped": damaged(_flip),
    "file-truncated": damaged(_cut),
    "file-missing": damaged(Path.unlink),
    "other-config": unfit(_another_config, "tau=0.005", "tau=0.25", "put config.json back"),
    "other-version": unfit(_another_version, "format 99", "use sacformer-jax 9.8.7"),
}
"""After these the run is resumed and has to equal the reference."""
ENDS: dict[str, Fault] = {"diverged": diverged, "no-memory": no_memory}
"""After these there is nothing to resume."""
FAULTS = {**HURTS, **ENDS}


def hurt(runs: Runs, fault: str, reference: dict[str, str]) -> Outcome:
    """Lets a fault happen to a run of its own, resumes it, and compares it with the reference."""
    happened, wrong = "", list[str]()
    try:
        happened, wrong = FAULTS[fault](runs, fault)
        if fault in HURTS:
            if newest_checkpoint(runs.folder / fault) < runs.settings["total_env_steps"]:
                runs.finish(fault)
            wrong += [f"{what} differs" for what in differences(reference, runs.left(fault))]
    except (RuntimeError, OSError) as error:
        wrong.append(str(error))
    printed = (runs.folder / f"{fault}.log").read_text(errors="replace")
    if "Traceback" in printed:
        wrong.append("it printed tracebacks")
    said = [line for line in printed.splitlines() if line.startswith(("error: ", "note: "))]
    return Outcome(fault, happened, said, wrong)


# --- the command line --------------------------------------------------------------------------


def check_faults(runs: Runs, faults: Sequence[str], reference: dict[str, str]) -> dict[str, Any]:
    """Lets faults happen, prints what came of each, and returns it all."""
    outcomes = []
    for fault in faults:
        outcome = hurt(runs, fault, reference)
        outcomes.append(outcome)
        good = "; resumed, equal" if fault in HURTS else ""
        verdict = f": WRONG: {'; '.join(outcome.wrong)}" if outcome.wrong else good
        print(f"{fault:<15} {outcome.happened}{verdict}", flush=True)
        for line in outcome.said:
            print(f"{'':<15} > {line[:200]}")
    return {
        "faults": [dataclasses.asdict(outcome) for outcome in outcomes],
        "good": not any(outcome.wrong for outcome in outcomes),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Does what is asked for; 1 if anything is not as it must be."""
    parser = argparse.ArgumentParser(description="Hurts runs and compares them with one unhurt.")
    parser.add_argument("--kills", type=int, default=0, help="kill -9 so often, too")
    parser.add_argument(
        "--only", nargs="*", choices=list(FAULTS), default=list(FAULTS), help="not all other faults"
    )
    parser.add_argument("--seed", type=int, default=0, help="draws the moments of the kills")
    parser.add_argument("--seeds", type=int, help="seeds trained side by side in each run")
    parser.add_argument("--keep", type=Path, help="folder for the runs; default: one thrown away")
    parser.add_argument("--json", type=Path, help="write the results there, too")
    args = parser.parse_args(arguments)
    settings = SETTINGS | ({"seeds": args.seeds} if args.seeds else {})
    with tempfile.TemporaryDirectory() as thrown_away:
        runs = Runs(args.keep or Path(thrown_away), settings)
        if (runs.folder / REFERENCE).exists():
            parser.error(f"--keep {args.keep}: holds runs already")
        start = time.monotonic()
        runs.finish(REFERENCE)
        results: dict[str, Any] = {
            "settings": settings,
            "seed": args.seed,
            "cores": usable_cores(),
            "versions": {name: version(name) for name in ("jax", "jaxlib", "orbax-checkpoint")},
            "seconds": time.monotonic() - start,
        }
        print(f"a run to which nothing happens takes {results['seconds']:.0f} s")
        reference, good = runs.left(REFERENCE), True
        if args.kills:
            results |= check_kills(runs, args.kills, random.Random(args.seed), reference)
            good = results["good"]
        if args.only:
            results |= check_faults(runs, args.only, reference)
            good = good and results["good"]
        results |= {"good": good, "seconds_in_all": time.monotonic() - start}
    if args.json:
        args.json.write_text(json.dumps(results, indent=2) + "\n")
    return 0 if results["good"] else 1


if __name__ == "__main__":
    sys.exit(main())

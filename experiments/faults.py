"""What happens to a run when something goes wrong, beside one to which nothing happened.

python experiments/faults.py                          # every fault once, except kills
python experiments/faults.py --kills 20               # kill -9 at 20 random moments
python experiments/faults.py --kills 20 --seeds 2     # of a run with two seeds
python experiments/faults.py --only full-disk --keep runs/faults

A run that was hurt and resumed must equal the other bit for bit: its train state, every line of
its metrics, its best policy.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import random
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from bench.kills import SETTINGS, Runs, check_kills, differences
from bench.watched import Process, newest_checkpoint

from sacformer_jax.cli import EXIT_INTERRUPTED

REFERENCE = "reference"
"""Name of the run to which nothing happens."""


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


# --- other faults ------------------------------------------------------------------------------


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


def stop_once(runs: Runs, name: str) -> tuple[str, list[str]]:
    """SIGTERM: the chunk is finished, a checkpoint written, exit code 3."""
    with _trained_to(runs, name, 1) as process:
        before = newest_checkpoint(process.run)
        process.signal(signal.SIGTERM)
        code = process.wait()
    saved = newest_checkpoint(process.run)
    wrong = [] if code == EXIT_INTERRUPTED else [f"exit code {code}, not {EXIT_INTERRUPTED}"]
    if saved <= before:
        wrong.append(f"no checkpoint after that at {before}")
    return f"exit code {code}, checkpoint at {saved}", wrong


def stop_twice(runs: Runs, name: str) -> tuple[str, list[str]]:
    """SIGTERM twice: it ends at once, and what was saved before is whole."""
    with _trained_to(runs, name, 1) as process:
        before = newest_checkpoint(process.run)
        process.signal(signal.SIGTERM)
        # Two signals at once are one; the first is heard when the program is back in Python.
        if not process.watch(lambda: "once more" in process.printed):
            return f"exit code {process.wait()}", ["it ended before the second signal"]
        process.signal(signal.SIGTERM)
        start = time.monotonic()
        code = process.wait()
        seconds = time.monotonic() - start
    wrong = [f"exit code {code}"] if code in (0, EXIT_INTERRUPTED) else []
    if newest_checkpoint(process.run) < before:
        wrong.append(f"checkpoint {before} is gone")
    return f"exit code {code} after {1e3 * seconds:.0f} ms", wrong


def full_disk(runs: Runs, name: str) -> tuple[str, list[str]]:
    """No file may grow beyond half of a checkpoint's largest: writing fails as on a full disk."""
    with _trained_to(runs, name, 1) as process:
        before = newest_checkpoint(process.run)
        limit = _largest_file(process.run / "checkpoints" / str(before)).stat().st_size // 2
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (limit, limit))
        code = process.wait()
    wrong = [] if code > 0 else [f"exit code {code}"]
    if "error: " not in process.printed:
        wrong.append("no message")
    if not (process.run / "checkpoints" / str(before)).is_dir():
        wrong.append(f"checkpoint {before} is gone")
    return f"no file over {limit:,} bytes, exit code {code}", wrong


def _largest_file(folder: Path) -> Path:
    files = (path for path in folder.rglob("*") if path.is_file())
    return max(files, key=lambda path: path.stat().st_size)


def _flip(file: Path) -> None:
    contents = bytearray(file.read_bytes())
    contents[len(contents) // 2] ^= 1
    file.write_bytes(contents)


def _cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def damaged(harm: Callable[[Path], None]) -> Callable[[Runs, str], tuple[str, list[str]]]:
    """A fault: the largest file of the newest checkpoint of a stopped run is harmed."""

    def fault(runs: Runs, name: str) -> tuple[str, list[str]]:
        with _trained_to(runs, name, 2) as process:
            process.signal(signal.SIGTERM)
            process.wait()
        newest = newest_checkpoint(process.run)
        file = _largest_file(process.run / "checkpoints" / str(newest))
        harm(file)
        return f"the largest file of the newest checkpoint, {newest}", []

    return fault


FAULTS: dict[str, Callable[[Runs, str], tuple[str, list[str]]]] = {
    "sigterm": stop_once,
    "sigterm-twice": stop_twice,
    "full-disk": full_disk,
    "bit-flipped": damaged(_flip),
    "file-truncated": damaged(_cut),
    "file-missing": damaged(Path.unlink),
}


def hurt(runs: Runs, fault: str, reference: dict[str, str]) -> Outcome:
    """Lets a fault happen to a run of its own, resumes it, and compares it with the reference."""
    happened, wrong = "", list[str]()
    try:
        happened, wrong = FAULTS[fault](runs, fault)
        runs.finish(fault)
        wrong += [f"{what} differs" for what in differences(reference, runs.left(fault))]
    except RuntimeError as error:
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
        verdict = "; ".join(outcome.wrong) or "resumed, equal"
        print(f"{fault:<15} {outcome.happened}: {verdict}", flush=True)
        for line in outcome.said:
            print(f"{'':<15} > {line[:200]}")
    return {
        "faults": [dataclasses.asdict(outcome) for outcome in outcomes],
        "good": not any(outcome.wrong for outcome in outcomes),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Does what is asked for; 1 if anything is not as it must be."""
    parser = argparse.ArgumentParser(description="Hurts runs and compares them with one unhurt.")
    parser.add_argument("--kills", type=int, default=0, help="kill -9 so often, no other fault")
    parser.add_argument("--only", nargs="+", choices=list(FAULTS), help="some of the other faults")
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
        results: dict[str, Any] = {"settings": settings, "seconds": time.monotonic() - start}
        print(f"a run to which nothing happens takes {results['seconds']:.0f} s")
        reference = runs.left(REFERENCE)
        if args.kills:
            results |= check_kills(runs, args.kills, random.Random(args.seed), reference)
        else:
            results |= check_faults(runs, args.only or list(FAULTS), reference)
    if args.json:
        args.json.write_text(json.dumps(results, indent=2) + "\n")
    return 0 if results["good"] else 1


if __name__ == "__main__":
    sys.exit(main())

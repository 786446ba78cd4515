"""A ``sacformer`` process at work on a run, seen from outside alone.

Which phase it is in follows from the growth of ``metrics.jsonl``, from its last line, and from the
folders of checkpoints.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

PHASES = ("compile", "chunk", "evaluation", "best", "checkpoint")
"""What is killed: everything before the first record (imports, restoring, compiling, prefill), a
training chunk, an evaluation, the writing of the best policy or of a checkpoint (also where the
next chunk runs beside it)."""

_POLL_SECONDS = 0.002
_LIMIT_SECONDS = 300.0
"""For one process: whichever takes longer hangs."""


class Process:
    """A ``sacformer`` command at work on a run.

    Attributes:
      run: the run's folder.
      log: the file that gets what it prints, appended.
      durations: phases that are over, with their seconds.
      begun: how often each phase has begun.

    Args:
      run: the run's folder.
      settings: the run's, with how often what happens.
      arguments: of the command.
      environment: variables beside those of this process.
      log: see above.
    """

    def __init__(
        self,
        run: Path,
        settings: Mapping[str, Any],
        arguments: Sequence[str],
        environment: Mapping[str, str],
        log: Path,
    ):
        self.run, self.log = run, log
        self.durations: list[tuple[str, float]] = []
        self._settings = settings
        self._trains, self._size = False, _size(_metrics(run))
        # A killed process leaves the folder it was writing; the next one may not remove it at once.
        self._leftover = _unfinished(run)
        self._started = self._since = time.monotonic()
        self._seen, self.begun = "compile", Counter({"compile": 1})
        self._log_start = _size(log)
        with log.open("ab") as output:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "sacformer_jax.cli", *arguments],
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**os.environ, **environment},
            )

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def ended(self) -> bool:
        return self._process.poll() is not None

    @property
    def printed(self) -> str:
        """What it printed so far."""
        return self.log.read_bytes()[self._log_start :].decode(errors="replace")

    def signal(self, number: int) -> None:
        """Sends a signal."""
        self._process.send_signal(number)

    def close(self) -> None:
        """Ends it by SIGKILL if it still runs."""
        self._process.kill()
        self._process.wait()

    def wait(self) -> int:
        """Lets it end; its exit code.

        Raises:
          RuntimeError: it hangs.
        """
        self.watch(lambda: False)
        return self._process.wait()

    def watch(self, until: Callable[[], bool]) -> bool:
        """Follows its phases; True when ``until()``, False when the process ended before.

        Raises:
          RuntimeError: it hangs.
        """
        while not self.ended:
            self.phase()
            if until():
                return True
            if time.monotonic() - self._started > _LIMIT_SECONDS:
                raise RuntimeError(f"{self.run}: no end after {_LIMIT_SECONDS:.0f} s: {self.log}")
            time.sleep(_POLL_SECONDS)
        return False

    def phase(self) -> str:
        """One of :data:`PHASES`, or ``"end"`` after the last checkpoint.

        It remembers what it saw; only calls in quick succession tell the phases apart.
        """
        now, seen = time.monotonic(), self._look()
        if seen != self._seen:
            self.durations.append((self._seen, now - self._since))
            self._seen, self._since = seen, now
            self.begun[seen] += 1
        return seen

    def _look(self) -> str:
        size = _size(_metrics(self.run))
        # A resumed run first cuts the file back: it has begun once the file grows.
        self._trains = self._trains or size > self._size
        self._size = size
        record = last_record(self.run)
        if not self._trains or record is None:
            return "compile"
        unfinished = _unfinished(self.run) - self._leftover
        if unfinished:
            return "checkpoint" if any(name == "checkpoints" for name, _ in unfinished) else "best"
        steps = record["env_steps"]
        at_end = steps >= self._settings["total_env_steps"]
        if record["kind"] == "train" and (at_end or self._due("eval_every", steps)):
            return "evaluation"
        if (at_end or self._due("checkpoint_every", steps)) and newest_checkpoint(self.run) < steps:
            return "checkpoint"
        return "end" if at_end else "chunk"

    def _due(self, every: str, steps: int) -> bool:
        """Whether a multiple of the setting lies in the chunk that ended at ``steps``."""
        before = steps - self._settings["chunk_env_steps"]
        return bool(steps // self._settings[every] > before // self._settings[every])


def members(run: Path) -> list[Path]:
    """Folders with the metrics and policies of a run: one of each seed, or the run's own."""
    return sorted(run.glob("seed-*"), key=lambda path: path.name) or [run]


def newest_checkpoint(run: Path) -> int:
    """Environment steps of the newest whole checkpoint; 0 without any."""
    names = [path.name for path in _folders(run / "checkpoints")]
    return max((int(name) for name in names if name.isdigit()), default=0)


def last_record(run: Path) -> dict[str, Any] | None:
    """The last whole line of a run's metrics."""
    path = _metrics(run)
    whole = path.read_bytes().rpartition(b"\n")[0] if path.is_file() else b""
    return json.loads(whole.splitlines()[-1]) if whole else None


def _metrics(run: Path) -> Path:
    return members(run)[0] / "metrics.jsonl"


def _unfinished(run: Path) -> set[tuple[str, int]]:
    """Checkpoints and best policies that are being written: the folder's name, and its inode."""
    places = [run / "checkpoints", *(member / "best" for member in members(run))]
    found = set()
    for place in places:
        for folder in _folders(place):
            with contextlib.suppress(FileNotFoundError):  # finished this moment
                if not folder.name.isdigit():
                    found.add((place.name, folder.stat().st_ino))
    return found


def _folders(place: Path) -> list[Path]:
    return [path for path in place.iterdir() if path.is_dir()] if place.is_dir() else []


def _size(path: Path) -> int:
    return path.stat().st_size if path.is_file() else 0

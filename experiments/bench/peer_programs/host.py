"""The host's end: sets up the programs' environments, starts them, talks to them."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from bench.peer_programs.protocol import STRETCH

Answer = dict[str, Any]
Install = Callable[[Path, Sequence[str]], None]


class PeerError(Exception):
    """A peer could not be set up, or did not answer."""


def tell(what: str) -> None:
    """Progress, to standard error."""
    print(what, file=sys.stderr, flush=True)


def install(folder: Path, packages: Sequence[str]) -> None:
    """Makes a virtual environment with the packages.

    Raises:
      PeerError: with what pip had to say.
    """
    python = str(folder / "bin" / "python")
    for command in (
        [sys.executable, "-m", "venv", str(folder)],
        [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *packages],
    ):
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            raise PeerError(f"setting up {folder.name}: {_last_line(done.stderr or done.stdout)}")


def ensure_venv(venv: Path, packages: Sequence[str], install: Install = install) -> Path:
    """The Python of a virtual environment with the packages, made anew unless it is current.

    Args:
      venv: its folder; git is told to leave alone the folder that this lies in.
      packages: arguments of ``pip install``.
      install: makes it.

    Raises:
      PeerError: it cannot be made.
    """
    stamp, wanted = venv / "installed.txt", "\n".join(packages) + "\n"
    if not (stamp.is_file() and stamp.read_text() == wanted):
        tell(f"setting up {venv} …")
        shutil.rmtree(venv, ignore_errors=True)
        venv.parent.mkdir(parents=True, exist_ok=True)
        (venv.parent / ".gitignore").write_text("*\n")
        install(venv, packages)
        stamp.write_text(wanted)
    return venv / "bin" / "python"


class Program:
    """A program that has been started.

    Args:
      command: what to run.
      environment: variables that it gets besides those of this process.
      limit_seconds: it is stopped when an answer takes longer.
    """

    def __init__(
        self, command: Sequence[str], environment: Mapping[str, str], limit_seconds: float
    ):
        self._limit_seconds = limit_seconds
        self._errors = tempfile.TemporaryFile("w+")  # noqa: SIM115 (`stop` closes it)
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            env={**os.environ, **environment},
        )

    def answer(self) -> Answer:
        """Its next line that is an answer.

        Raises:
          PeerError: it ended or was too slow.
        """
        assert self._process.stdout is not None
        timer = threading.Timer(self._limit_seconds, self._process.kill)
        timer.start()
        try:
            for line in self._process.stdout:
                with contextlib.suppress(ValueError):
                    answer = json.loads(line)
                    if isinstance(answer, dict):
                        return answer
        finally:
            timer.cancel()
        raise PeerError(self._how_it_ended())

    def stretch(self) -> Answer:
        """Lets it train for a stretch.

        Raises:
          PeerError: as :meth:`answer` does.
        """
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # no answer will come, which says more
            self._process.stdin.write(json.dumps(STRETCH) + "\n")
            self._process.stdin.flush()
        return self.answer()

    def stop(self) -> None:
        """Ends it: kindly at first."""
        with contextlib.suppress(BrokenPipeError, subprocess.TimeoutExpired):
            self._process.communicate(timeout=10)
        self._process.kill()
        self._process.wait()
        self._errors.close()

    def _how_it_ended(self) -> str:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout=10)
        self._errors.seek(0)
        return f"status {self._process.poll()}: {_last_line(self._errors.read())}"


def _last_line(text: str) -> str:
    lines = text.strip().splitlines()
    return lines[-1].strip() if lines else "it said nothing"

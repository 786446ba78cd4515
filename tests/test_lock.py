"""The lock of a run folder: one process at a time, released however it ends."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import jax
import pytest

from sacformer_jax import CheckpointError
from sacformer_jax.lock import locked

_HOLD = """
import sys, time
from sacformer_jax.lock import locked
with locked(sys.argv[1]):
    print("held", flush=True)
    time.sleep(600)
"""


@contextmanager
def _held_elsewhere(path: Path) -> Iterator[subprocess.Popen[str]]:
    """A process that holds the lock until it is killed."""
    holder = subprocess.Popen(
        [sys.executable, "-c", _HOLD, str(path)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        yield holder
    finally:
        holder.kill()
        holder.wait()


def test_a_second_process_is_refused_until_the_first_is_killed(tmp_path: Path) -> None:
    run = tmp_path / "run"
    with _held_elsewhere(run) as holder:
        before = {path: path.read_bytes() for path in run.iterdir()}
        with pytest.raises(CheckpointError) as refused, locked(run):
            pytest.fail("it was let in")
        message = str(refused.value)
        assert f"is being trained by process {holder.pid} on {socket.gethostname()}: " in message
        assert str(run) in message
        assert "\n" not in message
        assert {path: path.read_bytes() for path in run.iterdir()} == before
        holder.send_signal(signal.SIGKILL)
        holder.wait()
        with locked(run):
            assert str(os.getpid()) in (run / "lock").read_text()


def test_the_lock_can_be_taken_again(tmp_path: Path) -> None:
    for _ in range(2):
        with locked(tmp_path / "new" / "run"):
            assert (tmp_path / "new" / "run" / "lock").is_file()


def test_an_error_releases_it(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="inside"), locked(tmp_path):
        raise RuntimeError("inside")
    with locked(tmp_path):
        pass


def test_one_process_does_not_take_it_twice(tmp_path: Path) -> None:
    with (
        locked(tmp_path),
        pytest.raises(CheckpointError, match=f"process {os.getpid()}"),
        locked(tmp_path),
    ):
        pytest.fail("it was let in")


@pytest.mark.parametrize("content", ["", "{", "[]", "7"])
def test_a_holder_without_a_name_is_another_process(tmp_path: Path, content: str) -> None:
    with locked(tmp_path):
        (tmp_path / "lock").write_text(content)
        with pytest.raises(CheckpointError, match="another process"), locked(tmp_path):
            pytest.fail("it was let in")


def test_only_the_first_of_several_processes_takes_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with locked(tmp_path):
        monkeypatch.setattr(jax, "process_index", lambda: 1)
        with locked(tmp_path):
            pass


def test_a_folder_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(CheckpointError, match="cannot be written"), locked(tmp_path / "file"):
        pytest.fail("it was let in")


def test_a_file_system_without_locks_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*arguments: object) -> None:
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr("sacformer_jax.lock.fcntl.flock", refuse)
    with pytest.warns(UserWarning, match="no locks"), locked(tmp_path):
        pass

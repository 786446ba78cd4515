"""What a person sees, where nobody looks any more: training does not depend on it."""

from __future__ import annotations

import errno
import io
import signal
import subprocess
import sys
import textwrap

import pytest

from sacformer_jax.console import Reporter
from sacformer_jax.signals import stop_on_signal


class Closed(io.StringIO):
    """A pipe that nobody reads, or a disk that is full."""

    error: OSError | None = None

    def write(self, text: str) -> int:
        if self.error is not None:
            raise self.error
        return super().write(text)


@pytest.mark.parametrize(
    ("error", "printed"),
    [
        (BrokenPipeError(errno.EPIPE, "Broken pipe"), ""),  # for good
        (OSError(errno.ENOSPC, "No space left on device"), "two\n"),
    ],
)
def test_what_cannot_be_printed_ends_nothing(error: OSError, printed: str) -> None:
    reporter, output = Reporter(), Closed()
    output.error = error
    reporter.console.file = output
    reporter.say("one")
    output.error = None
    reporter.say("two")
    assert output.getvalue() == printed


def test_a_reader_that_leaves_does_not_end_the_program() -> None:
    """As `sacformer train | head` does, or Ctrl-C where `tee` writes the log."""
    program = """
    import sys
    from sacformer_jax.console import Reporter

    reporter = Reporter()
    reporter.say("first")
    sys.stdin.readline()  # the reader has left
    for _ in range(3):
        reporter.say("x" * 100_000)
    print("went on", file=sys.stderr)
    """
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(program)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdin is not None
    assert process.stdout is not None
    assert process.stderr is not None
    assert process.stdout.readline() == "first\n"
    process.stdout.close()
    process.stdin.write("\n")
    process.stdin.close()
    assert process.stderr.read() == "went on\n"
    assert process.wait() == 0


def test_the_second_signal_acts_at_once_whatever_becomes_of_what_is_said() -> None:
    said: list[str] = []

    def fails(text: str) -> None:
        said.append(text)
        raise RuntimeError("reentrant call inside <_io.BufferedWriter name='<stdout>'>")

    before = signal.getsignal(signal.SIGTERM)
    with stop_on_signal(fails) as asked:
        signal.raise_signal(signal.SIGTERM)
        assert asked()
        assert [text.startswith("stopping after this chunk") for text in said] == [True]
        assert signal.getsignal(signal.SIGTERM) is before

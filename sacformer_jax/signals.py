"""Being asked to stop, by Ctrl-C or a scheduler."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any


@contextmanager
def stop_on_signal(say: Callable[[str], None]) -> Iterator[Callable[[], bool]]:
    """The first SIGINT or SIGTERM asks to stop after the chunk; the second acts at once."""
    asked: list[int] = []
    previous: dict[int, Any] = {}

    def restore() -> None:
        for number, handler in previous.items():
            signal.signal(number, handler)

    def ask(number: int, frame: Any) -> None:
        asked.append(number)
        restore()  # first of all: what cannot be said must not keep the second from acting
        with suppress(RuntimeError):  # it came amid a print of ours, which cannot be entered twice
            say("stopping after this chunk, then saving; once more to stop at once")

    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            previous[number] = signal.signal(number, ask)
    except ValueError:  # not the main thread: no signals to handle
        previous.clear()
    try:
        yield lambda: bool(asked)
    finally:
        restore()

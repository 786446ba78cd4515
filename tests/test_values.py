"""What is said of errors that libraries raise."""

from __future__ import annotations

import jax
import pytest

from sacformer_jax.config import ConfigError
from sacformer_jax.launch import Launch
from sacformer_jax.values import first_line


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ValueError("too long\nand so on"), "too long"),
        (FileNotFoundError(2, "gone", "there"), "[Errno 2] gone: 'there'"),
        (TimeoutError(), "TimeoutError"),
    ],
)
def test_an_errors_first_line_says_something(error: Exception, said: str) -> None:
    assert first_line(error) == said


def test_processes_that_are_not_found_are_told_of_whatever_jax_says(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError

    monkeypatch.setattr(jax.distributed, "initialize", fail)
    with pytest.raises(ConfigError, match=r"cannot be found \(RuntimeError\); outside SLURM"):
        Launch(distributed=True).join()

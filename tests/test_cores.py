"""Counting cores, where the system tells which a process may use and where it does not."""

from __future__ import annotations

import os

import pytest

from sacformer_jax.cores import usable_cores


def test_only_the_cores_given_to_this_process_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 3, 5}, raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    assert usable_cores() == 3


@pytest.mark.parametrize(("there_are", "expected"), [(8, 8), (None, 1)])
def test_a_system_that_does_not_tell(
    monkeypatch: pytest.MonkeyPatch, there_are: int | None, expected: int
) -> None:
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: there_are)
    assert usable_cores() == expected

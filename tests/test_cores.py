"""Counting cores, where the system tells which a process may use and where it does not."""

from __future__ import annotations

import os

import pytest

from sacformer_jax.cores import usable_cores, xla_threads


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


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({}, 5),
        ({"NPROC": "3"}, 3),
        ({"PJRT_NPROC": "2", "NPROC": "3"}, 2),
        ({"PJRT_NPROC": "all", "NPROC": "3"}, 3),
        ({"PJRT_NPROC": ""}, 5),
    ],
    ids=str,
)
def test_threads_of_xla(
    monkeypatch: pytest.MonkeyPatch, environment: dict[str, str], expected: int
) -> None:
    for name in ("PJRT_NPROC", "NPROC"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr("sacformer_jax.cores.usable_cores", lambda: 5)
    assert xla_threads() == expected

"""Where a run is started: the threads it gets."""

from __future__ import annotations

import os

import pytest

from sacformer_jax import Config
from sacformer_jax.launch import choose_xla_threads


@pytest.mark.parametrize(
    ("fields", "environment", "expected"),
    [
        ({"agent": "ppo"}, {}, "1"),
        ({"agent": "ppo", "critic_width": 256}, {}, None),
        ({"agent": "sac"}, {}, None),
        ({"agent": "ppo"}, {"PJRT_NPROC": "3"}, "3"),
        ({"agent": "ppo"}, {"NPROC": "2"}, None),
    ],
)
def test_narrow_ppo_has_one_thread_of_xla_unless_the_environment_says_otherwise(
    monkeypatch: pytest.MonkeyPatch,
    fields: dict[str, object],
    environment: dict[str, str],
    expected: str | None,
) -> None:
    monkeypatch.setattr(os, "environ", dict(environment))
    choose_xla_threads(Config.from_preset("paper", **fields))
    assert os.environ.get("PJRT_NPROC") == expected

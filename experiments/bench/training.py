"""Part `train`: environment steps per second while training, everything included."""

from __future__ import annotations

import sys
from typing import Any

import jax

from bench.clock import Clock
from sacformer_jax import Config, make_program

REPETITIONS = 3
"""Chunks timed of each, after one that is not."""
ON_WINDOW = {"preset": "paper", "acting_context": "window"}
CASES: dict[str, dict[str, Any]] = {
    "sacformer_paper_window": {**ON_WINDOW, "prefill_env_steps": 1_000, "chunk_env_steps": 50},
    "sacformer_paper": {"preset": "paper", "prefill_env_steps": 1_000, "chunk_env_steps": 50},
    "sacformer_cpu": {"preset": "cpu", "chunk_env_steps": 1_000},
    # An update for each step of all environments.
    "sacformer_64_envs": {
        **ON_WINDOW,
        "num_envs": 64,
        "updates_per_env_step": 1 / 64,
        "prefill_env_steps": 64_000,
        "chunk_env_steps": 64 * 50,
    },
    "sac_paper": {
        "preset": "paper",
        "agent": "sac",
        "prefill_env_steps": 1_000,
        "chunk_env_steps": 500,
    },
    "sac_cpu": {"preset": "cpu", "agent": "sac", "chunk_env_steps": 1_000},
    "sacformer_best": {"preset": "best", "chunk_env_steps": 400},
    "sac_best": {"preset": "best", "agent": "sac", "chunk_env_steps": 400},
}
"""What differs from the preset: no more prefill than an episode for each environment, where
hindsight needs one, and chunks of one to five seconds on two cores."""


def chunk_milliseconds(clock: Clock, config: Config) -> float:
    """Median time of a chunk after prefill and a first chunk, in milliseconds an env step."""
    program = make_program(config)
    state, _ = program.prefill(program.init(jax.random.key(config.seed)))

    def one_chunk() -> Any:
        nonlocal state
        state, metrics = program.train_chunk(state)
        return metrics

    return clock.milliseconds(one_chunk, config.env_steps_per_chunk, REPETITIONS)


def measure(clock: Clock) -> dict[str, float]:
    """All cases on HalfCheetah, engine native, by flat keys ``train.CASE.WHAT``.

    ``steps_per_s`` is environment steps per second, ``ms_per_step`` and ``gemm_units_per_step`` the
    same as time; ``num_envs`` and ``updates_per_env_step`` say what is done for them.
    """
    results: dict[str, float] = {}
    for case, fields in CASES.items():
        print(f"training {case} …", file=sys.stderr, flush=True)
        config = Config.from_preset(env="HalfCheetah", engine="native", **fields)
        milliseconds = chunk_milliseconds(clock, config)
        results |= {
            f"train.{case}.steps_per_s": 1e3 / milliseconds,
            f"train.{case}.ms_per_step": milliseconds,
            f"train.{case}.gemm_units_per_step": milliseconds / clock.gemm_ms,
            f"train.{case}.num_envs": config.task.num_envs,
            f"train.{case}.updates_per_env_step": config.replay.updates_per_env_step,
        }
    return results

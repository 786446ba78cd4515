"""Part `members`: several seeds on one device of the CPU, and on a core each.

The second is what ``sacformer train`` chooses (``launch.choose_cpu_devices``). Each case is
measured in a process of its own with a device for each core, of which the first program uses one.
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from typing import Any

import jax

from bench.child import answer_of
from bench.clock import Clock
from sacformer_jax import Config, Devices, make_population, seed_members
from sacformer_jax.launch import Launch, choose_cpu_devices, choose_xla_threads
from sacformer_jax.population import ONE_DEVICE
from sacformer_jax.types import TrainState

ROUNDS = 7
LIMIT_SECONDS = 600.0
CASES: dict[str, dict[str, Any]] = {
    "sacformer_cpu_2": {"env": "HalfCheetah", "preset": "cpu", "seeds": 2},
    "sacformer_cpu_4": {"env": "HalfCheetah", "preset": "cpu", "seeds": 4},
    "sacformer_best_4": {"env": "Hopper", "preset": "best", "seeds": 4},
    "sac_best_4": {"env": "Hopper", "preset": "best", "agent": "sac", "seeds": 4},
    "td3_cpu_4": {"env": "Hopper", "preset": "cpu", "agent": "td3", "seeds": 4},
    "ppo_cpu_4": {
        "env": "HalfCheetah",
        "preset": "cpu",
        "agent": "ppo",
        "seeds": 4,
        "chunk_env_steps": 32_768,
    },
}
"""By name; the last part is the number of seeds."""
CHUNK_ENV_STEPS = 400
"""Of a round, where a case does not say: one to ten seconds."""


def chunk_seconds(
    config: Config, choices: dict[str, Devices], rounds: int
) -> dict[str, list[float]]:
    """Seconds of a chunk of all members in each round, the choices taking turns; a chunk before the
    first round is not counted.
    """
    members = seed_members(config.all_seeds)
    populations = {name: make_population(config, members, each) for name, each in choices.items()}
    seconds: dict[str, list[float]] = {name: [] for name in choices}
    states: dict[str, TrainState] = {}
    for name, population in populations.items():
        state = population.init()
        if config.prefill_vector_steps:
            state, _ = population.prefill(state)
        states[name], _ = jax.block_until_ready(population.train_chunk(state))
    for _ in range(rounds):
        for name, population in populations.items():
            start = time.perf_counter()
            states[name], _ = jax.block_until_ready(population.train_chunk(states[name]))
            seconds[name].append(time.perf_counter() - start)
    return seconds


def told(config: Config, seconds: dict[str, list[float]]) -> dict[str, float]:
    """Env steps per second of each seed, and how many times as fast cores of their own are: the
    median of the rounds, the lowest and the highest.
    """
    times = [one / each for one, each in zip(seconds["one"], seconds["each"], strict=True)]
    steps = config.env_steps_per_chunk
    return {
        "one_device.steps_per_s": steps / statistics.median(seconds["one"]),
        "core_each.steps_per_s": steps / statistics.median(seconds["each"]),
        "times": statistics.median(times),
        "times_lowest": min(times),
        "times_highest": max(times),
    }


def measure(clock: Clock) -> dict[str, float]:
    """All cases by flat keys ``members.CASE.WHAT``; see :func:`told`.

    Raises:
      RuntimeError: one failed.
      subprocess.TimeoutExpired: one took longer than ``LIMIT_SECONDS``.
    """
    results: dict[str, float] = {}
    for case in CASES:
        print(f"members of {case} …", file=sys.stderr, flush=True)
        answer = answer_of("bench.members", case, limit_seconds=LIMIT_SECONDS)
        results |= {f"members.{case}.{what}": float(value) for what, value in answer.items()}
    return results


def config_of(case: str) -> Config:
    """One of ``CASES``, on engine native."""
    return Config.from_preset(
        **{"engine": "native", "chunk_env_steps": CHUNK_ENV_STEPS, **CASES[case]}
    )


def main(case: str) -> None:
    """The process of a case."""
    config = config_of(case)
    num_members = len(config.all_seeds)
    choose_xla_threads(config)
    choose_cpu_devices(config, Launch(), num_members)
    choices = {"one": ONE_DEVICE, "each": Devices.for_members(num_members)}
    found = told(config, chunk_seconds(config, choices, ROUNDS))
    print(json.dumps({"devices": choices["each"].members, **found}))


if __name__ == "__main__":
    main(sys.argv[1])

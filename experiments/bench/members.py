"""Part `members`: several seeds on one device of the CPU, and on a core each.

What ``sacformer train`` does with ``--seed-devices 1``, and with as many as there are cores for;
without the flag it takes what is faster (``launch.choose_cpu_devices``). Each is a process of its
own, since it decides on XLA's threads, too; they train in turns (peer_programs/protocol.py).
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from functools import partial
from typing import Any

from bench.clock import Clock
from bench.peer_programs.host import Program
from bench.peer_programs.ours import train_by_chunks
from bench.peer_programs.protocol import Conversation
from bench.peers import ENVIRONMENT, LIMIT_SECONDS, compare
from sacformer_jax import Config, Devices, make_population, seed_members
from sacformer_jax.cores import usable_cores
from sacformer_jax.launch import Launch

ROUNDS = 7
CHUNK_ENV_STEPS = 400
"""Of a round, where a case does not say: one to ten seconds."""
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


def start(fields: Mapping[str, Any], seed_devices: int) -> Program:
    """Starts the training of a configuration, its seeds split over so many devices."""
    asked = {"fields": dict(fields), "seed_devices": seed_devices}
    command = [sys.executable, "-m", "bench.members", json.dumps(asked)]
    return Program(command, ENVIRONMENT, LIMIT_SECONDS)


def cores(fields: Mapping[str, Any]) -> int:
    """Over as many cores the seeds of a configuration can be split."""
    num_members = len(Config.from_preset(**fields).all_seeds)
    return Devices.for_members(num_members, available=usable_cores()).members


def measure(clock: Clock) -> dict[str, float | str]:
    """All cases by flat keys ``members.CASE.WHAT``.

    ``one_device.steps_per_s`` and ``core_each.steps_per_s`` are env steps per second of each seed,
    and ``core_each_over_fastest`` says how many times as fast cores of their own are; all as of
    :func:`bench.peers.compare`.
    """
    del clock  # ratios of programs that take turns
    results: dict[str, float | str] = {}
    for name, fields in CASES.items():
        case = {"engine": "native", "chunk_env_steps": CHUNK_ENV_STEPS, **fields}
        results |= compare(
            {"one_device": partial(start, case, 1), "core_each": partial(start, case, cores(case))},
            f"members.{name}",
            ROUNDS,
            ours="core_each",
        )
    return results


def main() -> None:
    """One of the processes: trains by stretches of one chunk."""
    asked = json.loads(sys.argv[1])
    config = Config.from_preset(**asked["fields"])
    members = seed_members(config.all_seeds)
    devices = Launch(seed_devices=asked["seed_devices"]).start(config, len(members))
    population = make_population(config, members, devices)
    train_by_chunks(Conversation(), population, population.init())


if __name__ == "__main__":
    main()

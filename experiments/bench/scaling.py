"""Part `scaling`: how cost grows with sizes, and what memory it takes.

Updates are those of preset `paper` with one size changed at a time, from a full replay; chunks are
those of preset `cpu`. HalfCheetah, engine native.
"""

from __future__ import annotations

import dataclasses
import json
import resource
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax

from bench.child import answer_of
from bench.clock import Clock
from bench.update import UPDATES, full_buffer, updater
from sacformer_jax import Config, make_population, make_program, seed_members
from sacformer_jax.digests import num_bytes
from sacformer_jax.train import hyperparameters
from sacformer_jax.types import TrainState

SIZES: dict[str, tuple[str, tuple[int, ...]]] = {
    "batch": ("batch_size", (32, 64, 128, 256, 512)),
    "context": ("context_length", (1, 2, 6, 10, 20)),
    "width": ("actor_width", (64, 128, 256)),
    "capacity": ("buffer_capacity", (10_000, 100_000, 1_000_000)),
}
"""Of an update: name in the keys, field and values."""
ENVS = (1, 8, 64)
SEEDS = (1, 2, 4, 8)
REPETITIONS = 3
"""Of updates."""
CHUNK_REPETITIONS = 9
"""Of chunks, which are short."""
ITERATIONS = 25
"""Of one chunk: in each, all environments step once and one update is made."""
TRAINING = {"preset": "paper", "prefill_env_steps": 1_000, "chunk_env_steps": 10}
"""Whose memory is told: the paper's settings, for no longer than shows it."""
LIMIT_SECONDS = 200.0

Run = Callable[[], Any]


def config_of(**fields: Any) -> Config:
    return Config.from_preset(env="HalfCheetah", engine="native", **fields)


def updates(config: Config) -> Run:
    """Runs ``UPDATES`` updates with their sampling, from a full replay."""
    program, key = make_program(config), jax.random.key(0)
    # Only what updates read is made: compiling all of `init` would take longer than they do.
    state: TrainState = dataclasses.replace(
        jax.eval_shape(program.init, key),
        learner=jax.jit(program.agent.init)(key),
        hyper=hyperparameters(config, program.env.spec.action_size),
        buffer=program.buffer.init(),
    )
    return updater(program, dataclasses.replace(state, buffer=full_buffer(program, state)))


@dataclasses.dataclass(frozen=True)
class Training:
    """A population that trains.

    Attributes:
      run: runs a chunk of all members.
      state_bytes: of the state of all members.
      temp_bytes: what the compiled chunk takes besides, as XLA counts it.
    """

    run: Run
    state_bytes: int
    temp_bytes: int


def chunk_config(num_envs: int) -> Config:
    """Preset `cpu`, with ``ITERATIONS`` of a step of all environments and an update in a chunk."""
    return config_of(
        preset="cpu",
        num_envs=num_envs,
        updates_per_env_step=1 / num_envs,
        prefill_env_steps=100 * num_envs,
        chunk_env_steps=ITERATIONS * num_envs,
    )


def training_of(config: Config, num_seeds: int = 1) -> Training:
    """So many seeds, trained as ``sacformer train --seeds`` does, after their prefill."""
    population = make_population(config, seed_members(range(num_seeds)))
    state, _ = population.prefill(population.init())
    train_chunk = population.train_chunk.lower(state).compile()
    analysis: Any = train_chunk.memory_analysis()

    def again() -> Any:
        nonlocal state
        state, metrics = train_chunk(state)
        return metrics

    return Training(again, num_bytes(state), analysis.temp_size_in_bytes)


def in_turns(clock: Clock, runs: Mapping[str, Run], per: int, repetitions: int) -> dict[str, float]:
    """Median times of all, in milliseconds and in GEMM units, by ``NAME.ms`` and so on.

    They take turns, so that the noise of a shared machine hits all sizes alike.
    """
    results: dict[str, float] = {}
    for name, milliseconds in clock.side_by_side(runs, per, repetitions).items():
        results[f"{name}.ms"] = milliseconds
        results[f"{name}.gemm_units"] = milliseconds / clock.gemm_ms
    return results


def by_seeds(clock: Clock, config: Config, sizes: Sequence[int] = SEEDS) -> dict[str, float]:
    """Iterations of so many seeds in one program, 1 among them; keys as in :func:`measure`."""
    found = {f"scaling.seeds.{size}": training_of(config, size) for size in sizes}
    runs = {name: each.run for name, each in found.items()}
    results = in_turns(clock, runs, ITERATIONS, CHUNK_REPETITIONS)
    for name, each in found.items():
        results[f"{name}.state_bytes"] = float(each.state_bytes)
        results[f"{name}.temp_bytes"] = float(each.temp_bytes)
    for size in sizes:
        ratio = results[f"scaling.seeds.{size}.ms"] / results["scaling.seeds.1.ms"]
        results[f"scaling.seeds.{size}.over_one"] = ratio
    return results


def transition_bytes(obs_size: int, action_size: int) -> int:
    """The least a step takes: float32 observation, action, reward; terminated, truncated."""
    return 4 * (obs_size + action_size + 1) + 2


def memory() -> dict[str, float]:
    """Bytes at the paper's settings, told by a process of its own that trains; see :func:`main`.

    ``buffer_over_steps`` is the replay over capacity times :func:`transition_bytes`. Of the chunk,
    ``temp`` comes beside its arguments, and ``aliased`` is what of them it overwrites in place.
    ``peak_resident_STAGE`` is the most that the process held up to then.

    Raises:
      RuntimeError: it failed.
      subprocess.TimeoutExpired: it took longer than ``LIMIT_SECONDS``.
    """
    answer: dict[str, float] = answer_of("bench.scaling", limit_seconds=LIMIT_SECONDS)
    return {f"scaling.memory.{what}": float(value) for what, value in answer.items()}


def peak_resident_bytes() -> int:
    """The most memory this process ever held.

    On Linux ``getrusage`` counts what the parent held when it started this process, too, so
    ``VmHWM`` is read there.
    """
    status = Path("/proc/self/status")
    if status.is_file():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return 1024 * int(line.split()[1])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def measure(clock: Clock) -> dict[str, float]:
    """All by flat keys ``scaling.WHAT.SIZE.ms`` and ``.gemm_units``, and ``scaling.memory.*``.

    Times are those of an update for ``batch``, ``context`` (K), ``width`` (of the actor) and
    ``capacity`` (of the replay; ``scaling.capacity.growth`` is the largest over the smallest), and
    those of an iteration, a step of all environments and an update, for ``envs`` and ``seeds``
    (all of them together). Of ``seeds`` also ``.over_one``, the time over that of one seed,
    ``.state_bytes``, replays included, and ``.temp_bytes`` of the compiled chunk.
    """
    results: dict[str, float] = {}
    made: dict[Config, Run] = {}  # every row has the paper's own size
    for what, (field, sizes) in SIZES.items():
        print(f"updates by {field} …", file=sys.stderr, flush=True)
        runs: dict[str, Run] = {}
        for size in sizes:
            # Updates are the same however it acts, and K = 1 leaves but the window.
            config = config_of(preset="paper", acting_context="window", **{field: size})
            made[config] = made.get(config) or updates(config)
            runs[f"scaling.{what}.{size}"] = made[config]
        results |= in_turns(clock, runs, UPDATES, REPETITIONS)
    made.clear()  # their replays
    smallest, *_, largest = (f"scaling.capacity.{size}.ms" for size in SIZES["capacity"][1])
    results["scaling.capacity.growth"] = results[largest] / results[smallest]
    print("chunks by environments and by seeds …", file=sys.stderr, flush=True)
    runs = {f"scaling.envs.{size}": training_of(chunk_config(size)).run for size in ENVS}
    results |= in_turns(clock, runs, ITERATIONS, CHUNK_REPETITIONS)
    results |= by_seeds(clock, chunk_config(1))
    print("memory …", file=sys.stderr, flush=True)
    return results | memory()


def main() -> None:
    """The process whose memory is told: trains for a few steps."""
    found: dict[str, float] = {"peak_resident_imported_bytes": peak_resident_bytes()}
    config = config_of(**TRAINING)
    program = make_program(config)
    state, _ = jax.block_until_ready(program.prefill(program.init(jax.random.key(0))))
    found["peak_resident_prefilled_bytes"] = peak_resident_bytes()
    train_chunk = program.train_chunk.lower(state).compile()
    found["peak_resident_compiled_bytes"] = peak_resident_bytes()
    for _ in range(2):
        state, _ = jax.block_until_ready(train_chunk(state))
    found["peak_resident_trained_bytes"] = peak_resident_bytes()
    analysis: Any = train_chunk.memory_analysis()
    found["chunk_argument_bytes"] = analysis.argument_size_in_bytes
    found["chunk_aliased_bytes"] = analysis.alias_size_in_bytes
    found["chunk_temp_bytes"] = analysis.temp_size_in_bytes
    spec, buffer = program.env.spec, num_bytes(state.buffer)
    steps = config.replay.buffer_capacity * transition_bytes(spec.obs_size, spec.action_size)
    print(json.dumps({"buffer_bytes": buffer, "buffer_over_steps": buffer / steps, **found}))


if __name__ == "__main__":
    main()

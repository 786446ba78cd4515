"""Part `checkpoint`: what an asynchronous checkpoint costs training.

The paper's settings on HalfCheetah with a replay of 1,000,000 steps, full of random numbers, which
cannot be compressed. Spans of chunks with a checkpoint at their start, long enough that it is on
disk before their end, take turns with spans of as many chunks without.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax

from bench.clock import Clock
from bench.update import full_buffer
from sacformer_jax import Config, Population, make_population, policy_of, seed_members
from sacformer_jax.checkpoint import CheckpointWriter, Progress, RunFolder
from sacformer_jax.digests import num_bytes
from sacformer_jax.runner import sources_of
from sacformer_jax.types import TrainState

INTERVAL_SECONDS = 300.0
"""Between checkpoints, of which the cost is told as a share."""
TURNS = 8
COVER = 2.0
"""Length of a span over the time a checkpoint takes while training goes on."""
SETTINGS: dict[str, Any] = {"preset": "paper", "chunk_env_steps": 5}
"""Short chunks, so that spans need not be longer than it takes."""


@dataclass(frozen=True)
class Turn:
    """Seconds of a span without a checkpoint and of one with it, and of parts of the latter.

    Attributes:
      without: chunks alone.
      blocking: of :meth:`CheckpointWriter.save`.
      whole: ``save``, chunks, and ``wait``, which has only to tidy up by then.
      written: from the end of ``save`` to the end of the first chunk after which it was on disk.
    """

    without: float
    blocking: float
    whole: float
    written: float

    @property
    def extra(self) -> float:
        """What the checkpoint cost in all."""
        return self.whole - self.without


class Trainer:
    """A population that trains, and saves itself in a folder.

    Args:
      population: of a replay that has no more to be filled.
      state: its state, which is donated.
      folder: of a run that was created.
      writer: writes there.
    """

    def __init__(
        self,
        population: Population,
        state: TrainState,
        folder: RunFolder,
        writer: CheckpointWriter,
    ):
        self._state, self._folder, self._writer = state, folder, writer
        self._train_chunk = population.train_chunk.lower(state).compile()
        self._saved = 0

    def train(self, num_chunks: int) -> None:
        """Trains so many chunks."""
        for _ in range(num_chunks):
            self._state, _ = jax.block_until_ready(self._train_chunk(self._state))

    def save(self) -> int:
        """Starts a checkpoint, under the number of it."""
        self._saved += 1
        num_members = len(self._state.key)
        progress = Progress(self._saved, (None,) * num_members, (0,) * num_members)
        self._writer.save(self._state, policy_of(self._state), progress)
        return self._saved

    def save_alone(self) -> None:
        """Saves a checkpoint, with nothing beside it."""
        self.save()
        self._writer.wait()

    def num_chunks(self) -> int:
        """Chunks that take ``COVER`` times what a checkpoint takes beside them."""
        step, num = self.save(), 0
        while step not in self._folder.steps():
            self.train(1)
            num += 1
        self._writer.wait()
        return max(2, round(COVER * num))

    def turn(self, num_chunks: int, saving_first: bool) -> Turn | None:
        """Both spans, of so many chunks; None if they were too few for the checkpoint."""
        if saving_first:
            return self._saving_span(num_chunks, lambda: seconds(self.train, num_chunks))
        without = seconds(self.train, num_chunks)
        return self._saving_span(num_chunks, lambda: without)

    def _saving_span(self, num_chunks: int, without: Callable[[], float]) -> Turn | None:
        start, written = time.perf_counter(), None
        step = self.save()
        saved = time.perf_counter()
        for _ in range(num_chunks):
            self.train(1)
            if written is None and step in self._folder.steps():
                written = time.perf_counter() - saved
        self._writer.wait()
        whole = time.perf_counter() - start
        return Turn(without(), saved - start, whole, written) if written is not None else None


def seconds(do: Callable[..., object], *arguments: Any) -> float:
    """How long ``do(*arguments)`` takes."""
    start = time.perf_counter()
    do(*arguments)
    return time.perf_counter() - start


def size_on_disk(path: Path) -> int:
    """Bytes of all files below a folder."""
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())


def measure_in(run: Path, config: Config, turns: int = TURNS) -> dict[str, float]:
    """See :func:`measure`; checkpoints are written to the folder ``run``."""
    members = seed_members(config.all_seeds)
    population = make_population(config, members)
    folder = RunFolder(run)
    folder.create(config, sources_of(config), population.program.env.spec, members)
    state = population.init()
    state = replace(state, buffer=full_buffer(population.program, state))
    state_bytes = num_bytes(state)
    with CheckpointWriter(folder, config, population.block_axes) as writer:
        trainer = Trainer(population, state, folder, writer)
        del state
        num_chunks = trainer.num_chunks()  # the first save also warms up
        num_chunks = max(num_chunks, trainer.num_chunks())
        found: list[Turn] = []
        while len(found) < turns:
            print(f"checkpoint {len(found) + 1} of {turns} …", file=sys.stderr, flush=True)
            turn = trainer.turn(num_chunks, saving_first=len(found) % 2 == 0)
            if turn is None:
                num_chunks, found = 2 * num_chunks, []
            else:
                found.append(turn)
        alone = statistics.median(seconds(trainer.save_alone) for _ in range(3))
    newest = folder.checkpoints_path / str(folder.latest_step())
    abstract = population.abstract()
    restoring = seconds(
        folder.restore, abstract, population.block_axes, population.shardings, False
    )
    extras = sorted(turn.extra for turn in found)
    extra = statistics.median(extras)
    return {
        "checkpoint.state_bytes": float(state_bytes),
        "checkpoint.disk_bytes": float(size_on_disk(newest)),
        "checkpoint.blocking_ms": 1e3 * statistics.median(t.blocking for t in found),
        "checkpoint.slowdown_ms": 1e3 * statistics.median(t.extra - t.blocking for t in found),
        "checkpoint.extra_ms": 1e3 * extra,
        "checkpoint.extra_lowest_ms": 1e3 * extras[0],
        "checkpoint.extra_highest_ms": 1e3 * extras[-1],
        "checkpoint.share_of_5_minutes": extra / INTERVAL_SECONDS,
        "checkpoint.span_s": statistics.median(turn.without for turn in found),
        "checkpoint.span_chunks": float(num_chunks),
        "checkpoint.written_beside_training_s": statistics.median(turn.written for turn in found),
        "checkpoint.written_alone_s": alone,
        "checkpoint.restore_s": restoring,
    }


def measure(clock: Clock) -> dict[str, float]:
    """By flat keys ``checkpoint.WHAT``.

    ``blocking_ms`` is what ``CheckpointWriter.save`` takes, ``slowdown_ms`` how much longer the
    chunks beside the writing take, ``extra_ms`` both together: medians over the turns, of ``extra``
    also the lowest and the highest; ``share_of_5_minutes`` is ``extra`` over the interval at which
    checkpoints are meant to be. ``written_…_s`` is how long it takes until one is on disk, beside
    training (to the end of a chunk) and with nothing beside it (``save`` included), ``restore_s``
    to read and verify one that the system has in memory still. Files lie in the system's folder for
    temporary ones.
    """
    del clock  # seconds of a disk, too
    config = Config.from_preset(env="HalfCheetah", engine="native", **SETTINGS)
    with tempfile.TemporaryDirectory() as folder:
        return measure_in(Path(folder) / "run", config)

"""The host loop: chunks, evaluations, checkpoints, signals, faults."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import jax
import numpy as np

from sacformer_jax.callbacks import Callbacks
from sacformer_jax.checkpoint import (
    BestSoFar,
    CheckpointError,
    CheckpointWriter,
    Progress,
    RunFolder,
    kept_best,
    prune_best,
    save_best,
)
from sacformer_jax.console import Reporter
from sacformer_jax.evaluate import Evaluation
from sacformer_jax.fault_report import report_fault
from sacformer_jax.logging import MetricLog, Record, TimingLog, rank
from sacformer_jax.population import Population, member_counters, member_metrics
from sacformer_jax.processes import any_process, gathered, is_first
from sacformer_jax.signals import stop_on_signal
from sacformer_jax.train import policy_of
from sacformer_jax.types import PolicyState, TrainState


class DivergedError(Exception):
    """Too many updates were skipped because a tensor was not finite; the message says which."""


def summarize(evaluation: Evaluation) -> Record:
    """An evaluation of one member as the values of an ``"eval"`` record."""
    returns, lengths = np.asarray(evaluation.returns), np.asarray(evaluation.lengths)
    return {
        "episodes": int(returns.size),
        "return_mean": float(returns.mean()),
        "return_std": float(returns.std()),
        "return_min": float(returns.min()),
        "return_max": float(returns.max()),
        "length_mean": float(lengths.mean()),
        "bad_physics": int(np.sum(evaluation.bad)),
    }


class Loop:
    """Runs chunks until the end, with everything that happens between them.

    Every process runs it, on the same numbers; the first writes all but its share of checkpoints.

    Args:
      population: what is trained.
      folder: of the run.
      reporter: what a person sees.
      callbacks: what users' code sees; it may ask to stop.
      resumed: of the checkpoint gone on from; None at the start.
    """

    def __init__(
        self,
        population: Population,
        folder: RunFolder,
        reporter: Reporter,
        callbacks: Callbacks,
        resumed: Progress | None,
    ):
        self.population, self.folder, self.reporter = population, folder, reporter
        self.callbacks = callbacks
        self.config, self.names = population.config, [m.name for m in population.members]
        self.best: list[BestSoFar | None] = (
            list(resumed.best) if resumed else [None] * len(self.names)
        )
        self.failed: set[str] = set()
        self._resumed = resumed
        self._logs: list[MetricLog] = []
        self._timings: TimingLog | None = None
        self.started = time.perf_counter()

    def run(self, state: TrainState) -> int:
        """Trains until the end, or until asked to stop; returns the environment steps done.

        Raises:
          Exception: of a callback; the state was saved.
          DivergedError: no member is left that learns; the state was saved.
          CheckpointError: the folder cannot be written (any more); what was saved is intact.
        """
        with self.reporter.timed("compiling train_chunk"):
            train_chunk = self.population.train_chunk.lower(state).compile()
        try:
            with ExitStack() as stack:
                self._open_logs(stack)
                writer = stack.enter_context(
                    CheckpointWriter(
                        self.folder,
                        self.config,
                        self.population.stored(self.population.block_axes),
                        dataclasses.asdict(self.population.devices),
                    )
                )
                env_steps = self._chunks(state, train_chunk, writer)
        except OSError as error:  # also of files that are closed
            raise CheckpointError(
                f"run {str(self.folder.path)!r} cannot be written ({error.strerror}): what "
                f"was saved is intact; make room, then 'sacformer resume {self.folder.path}'"
            ) from error
        self.callbacks.raise_error()
        return env_steps

    def _open_logs(self, stack: ExitStack) -> None:
        if not is_first():
            return
        resumed, folder = self._resumed, self.folder
        purge_after = resumed.env_steps if resumed else None
        kept = kept_best(folder)
        for index, name in enumerate(self.names):
            path = folder.member_path(name)
            path.mkdir(exist_ok=True)
            # Later ones belong to what is computed again now.
            prune_best(folder, name, kept[index])
            keep_bytes = resumed.metrics_bytes[index] if resumed else 0
            settings = self.population.members[index].config(self.config).flat()
            log = MetricLog(
                folder.metrics_path(name), path / "tensorboard", keep_bytes, purge_after, settings
            )
            self._logs.append(log)
            stack.callback(log.close)
            if log.lost_bytes:
                self.reporter.say(
                    f"note: {folder.metrics_path(name)} has lost its records after byte "
                    f"{log.num_bytes}; training goes on where it was"
                )
        # A folder of its own: TensorBoard follows one file of a folder at a time.
        tensorboard = folder.path / "tensorboard" / "timings"
        self._timings = TimingLog(folder.timings_path, tensorboard, purge_after)
        stack.callback(self._timings.close)

    def _chunks(
        self,
        state: TrainState,
        train_chunk: Callable[[TrainState], Any],
        writer: CheckpointWriter,
    ) -> int:
        run, reporter = self.config.run, self.reporter
        total, env_steps = run.total_env_steps, int(state.counters.env_steps)
        reporter.start_training(env_steps, total)
        self.started = time.perf_counter()
        state = self._pretrained(state)
        with stop_on_signal(reporter.say) as stop_asked:
            if self._resumed is None:
                self._evaluate(state)  # where learning starts from
                if self.population.pretrain_chunk is not None:
                    self._try_to_save(writer, state)  # what took long is not to be done again
            while env_steps < total and not any_process(stop_asked() or self.callbacks.stop):
                before, chunk_start = env_steps, time.perf_counter()
                state, metrics = jax.block_until_ready(train_chunk(state))
                env_steps = int(state.counters.env_steps)
                self._log_chunk(state, metrics, time.perf_counter() - chunk_start)
                if _crossed(run.eval_every, before, env_steps) or env_steps >= total:
                    self._evaluate(state)
                if _crossed(run.checkpoint_every, before, env_steps) and env_steps < total:
                    self._try_to_save(writer, state)
                if len(self.failed) == len(self.names):
                    break
            self._save_for_good(writer, state)
        if len(self.failed) == len(self.names):
            raise DivergedError(
                f"run {str(self.folder.path)!r} stopped at {env_steps:,} env steps: in every "
                f"member more than max_skipped_updates={run.max_skipped_updates} updates were not "
                "finite; see fault.json there"
            )
        return env_steps

    def _pretrained(self, state: TrainState) -> TrainState:
        """After the updates on the dataset, where there are any to make; unsaved until its end."""
        pretrain_chunk, config = self.population.pretrain_chunk, self.config
        if pretrain_chunk is None or self._resumed is not None:
            return state
        wanted = config.offline.pretrain_updates
        with self.reporter.timed(f"pretraining: {wanted:,} updates on the dataset"):
            for _ in range(-(-wanted // config.updates_per_pretrain_chunk)):
                state, metrics = jax.block_until_ready(pretrain_chunk(state))
                gathered_metrics, counters = gathered((metrics, state.counters))
                env_steps, numbers = int(counters.env_steps), []
                for index in range(len(self.names)):
                    own = member_metrics(gathered_metrics, index)
                    updates = int(member_counters(counters, index).updates)
                    numbers.append(own)
                    if is_first():
                        self._logs[index].write("pretrain", env_steps, updates, own)
        losses = [float(own["actor_loss"]) for own in numbers]
        self.reporter.say(f"pretraining: actor loss {np.mean(losses):.2f} at its end")
        return state

    def _log_chunk(self, state: TrainState, metrics: dict[str, Any], seconds: float) -> None:
        metrics, counters = gathered((metrics, state.counters))
        env_steps, limit = int(counters.env_steps), self.config.run.max_skipped_updates
        records: dict[str, Record] = {}
        for index, name in enumerate(self.names):
            own, numbers = member_counters(counters, index), member_metrics(metrics, index)
            if is_first():
                records[name] = self._logs[index].write(
                    "train", env_steps, int(own.updates), numbers
                )
            if int(own.skipped_updates) > limit and name not in self.failed:
                self.failed.add(name)
                path = self.folder.member_path(name) / "fault.json"
                self.reporter.say(report_fault(self.population, index, state, path))
        num_updates = self.config.steps_and_updates[1] * self.config.iterations_per_chunk
        timings: Record = {}
        if self._timings:
            timings = self._timings.write(
                env_steps,
                int(np.max(counters.updates)),
                {
                    "chunk_seconds": seconds,
                    "steps_per_second": len(self.names) * self.config.env_steps_per_chunk / seconds,
                    "ms_per_update": 1e3 * seconds / (len(self.names) * num_updates),
                    "wall_seconds": time.perf_counter() - self.started,
                },
            )
        self.reporter.chunk_done(env_steps)
        self.callbacks.chunk(state, records, timings)

    def _evaluate(self, state: TrainState) -> None:
        policies, env_steps = policy_of(state), int(state.counters.env_steps)
        result = self.population.evaluate(policies, np.int32(env_steps))
        result, counters = gathered((result, state.counters))
        records: dict[str, Record] = {}
        improved: dict[int, BestSoFar] = {}
        for index, name in enumerate(self.names):
            record = summarize(jax.tree.map(lambda values, i=index: values[i], result))
            updates = int(member_counters(counters, index).updates)
            if is_first():
                record = self._logs[index].write("eval", env_steps, updates, record)
            records[name] = record
            best = self.best[index]
            if best is None or rank(record) > rank(dataclasses.asdict(best)):
                improved[index] = BestSoFar(env_steps, record["return_mean"], record["bad_physics"])
        self.reporter.evaluated(env_steps, list(records.values()))
        if improved:
            self._save_best(improved, gathered(policies))
        self.callbacks.evaluation(state, records)

    def _save_best(self, improved: dict[int, BestSoFar], policies: PolicyState) -> None:
        """Writes the policies of those members, ``policies`` being everybody's.

        One that cannot be written is not the best: no checkpoint is to refer to a policy that is
        not there, and the next that is better is tried again.
        """
        for index, best in improved.items():
            failed = False
            if is_first():
                policy = jax.tree.map(lambda leaf, i=index: leaf[i], policies)
                try:
                    save_best(self.folder, self.names[index], policy, best)
                except CheckpointError as error:
                    failed = True
                    self.reporter.say(f"{error}; training goes on")
            if not any_process(failed):
                self.best[index] = best

    @contextmanager
    def _said(self, what_follows: str) -> Iterator[None]:
        """A checkpoint that fails inside is reported, and nothing more."""
        try:
            yield
        except CheckpointError as error:
            self.reporter.say(f"{error}; {what_follows}")

    def _try_to_save(self, writer: CheckpointWriter, state: TrainState) -> None:
        """Saves; the next time is tried again where the last or this one fails."""
        with self._said("training goes on"):
            writer.wait()
        with self._said("training goes on"):
            self._save(writer, state)

    def _save_for_good(self, writer: CheckpointWriter, state: TrainState) -> None:
        """Saves, and waits until it is on disk; what fails is tried once more."""
        with self._said("the last one is still to come"):
            writer.wait()
        try:
            self._save(writer, state)
            writer.wait()
        except CheckpointError as error:
            self.reporter.say(f"{error}; trying once more")
            self._save(writer, state)
            writer.wait()

    def _save(self, writer: CheckpointWriter, state: TrainState) -> None:
        progress = Progress(
            env_steps=int(state.counters.env_steps),
            best=tuple(self.best),
            metrics_bytes=tuple(log.num_bytes for log in self._logs),
        )
        writer.save(self.population.stored(state), policy_of(state), progress)


def _crossed(every: int, before: int, now: int) -> bool:
    """Whether a multiple of ``every`` lies in ``(before, now]``."""
    return now // every > before // every

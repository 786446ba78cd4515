"""The host loop: chunks, evaluations, checkpoints, signals, faults."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import jax
import numpy as np

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
from sacformer_jax.logging import MetricLog, Record, TimingLog
from sacformer_jax.population import Population, member_counters, member_metrics
from sacformer_jax.processes import any_process, gathered, is_first
from sacformer_jax.train import policy_of
from sacformer_jax.types import Counters, TrainState


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
    }


@contextmanager
def stop_on_signal(say: Callable[[str], None]) -> Iterator[Callable[[], bool]]:
    """The first SIGINT or SIGTERM asks to stop after the chunk; the second acts at once."""
    asked: list[int] = []
    previous: dict[int, Any] = {}

    def restore() -> None:
        for number, handler in previous.items():
            signal.signal(number, handler)

    def ask(number: int, frame: Any) -> None:
        asked.append(number)
        say("stopping after this chunk, then saving; once more to stop at once")
        restore()

    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            previous[number] = signal.signal(number, ask)
    except ValueError:  # not the main thread: no signals to handle
        previous.clear()
    try:
        yield lambda: bool(asked)
    finally:
        restore()


class Loop:
    """Runs chunks until the end, with everything that happens between them.

    Every process runs it, on the same numbers; the first writes all but its share of checkpoints.

    Args:
      population: what is trained.
      folder: of the run.
      reporter: what a person sees.
      resumed: of the checkpoint gone on from; None at the start.
    """

    def __init__(
        self,
        population: Population,
        folder: RunFolder,
        reporter: Reporter,
        resumed: Progress | None,
    ):
        self.population, self.folder, self.reporter = population, folder, reporter
        self.config, self.names = population.config, [m.name for m in population.members]
        self.best: list[BestSoFar | None] = (
            list(resumed.best) if resumed else [None] * len(self.names)
        )
        self.failed: set[str] = set()
        self._resumed = resumed
        self._logs: list[MetricLog] = []
        self._timings: TimingLog | None = None
        self.started = time.perf_counter()

    def run(self, state: TrainState) -> tuple[int, bool]:
        """Trains to the end; returns the environment steps done and whether it was interrupted.

        Raises:
          DivergedError: no member is left that learns; the state was saved.
          CheckpointError: the folder cannot be written (any more); what was saved is intact.
        """
        with self.reporter.timed("compiling train_chunk"):
            train_chunk = self.population.train_chunk.lower(state).compile()
        with ExitStack() as stack:
            try:
                self._open_logs(stack)
                writer = stack.enter_context(
                    CheckpointWriter(
                        self.folder,
                        self.config,
                        self.population.stored(self.population.block_axes),
                    )
                )
                return self._chunks(state, train_chunk, writer)
            except OSError as error:
                raise CheckpointError(
                    f"run {str(self.folder.path)!r} cannot be written ({error.strerror}): what "
                    f"was saved is intact; make room, then 'sacformer resume {self.folder.path}'"
                ) from error

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
            log = MetricLog(
                folder.metrics_path(name), path / "tensorboard", keep_bytes, purge_after
            )
            self._logs.append(log)
            stack.callback(log.close)
        # A folder of its own: TensorBoard follows one file of a folder at a time.
        tensorboard = folder.path / "tensorboard" / "timings"
        self._timings = TimingLog(folder.timings_path, tensorboard, purge_after)
        stack.callback(self._timings.close)

    def _chunks(
        self,
        state: TrainState,
        train_chunk: Callable[[TrainState], Any],
        writer: CheckpointWriter,
    ) -> tuple[int, bool]:
        run, reporter = self.config.run, self.reporter
        total, env_steps = run.total_env_steps, int(state.counters.env_steps)
        reporter.start_training(env_steps, total)
        self.started = time.perf_counter()
        with stop_on_signal(reporter.say) as stop_asked:
            if self._resumed is None:
                self._evaluate(state)  # where learning starts from
            while env_steps < total and not any_process(stop_asked()):
                before, chunk_start = env_steps, time.perf_counter()
                state, metrics = jax.block_until_ready(train_chunk(state))
                env_steps = int(state.counters.env_steps)
                self._log_chunk(state, metrics, time.perf_counter() - chunk_start)
                if _crossed(run.eval_every, before, env_steps) or env_steps >= total:
                    self._evaluate(state)
                if _crossed(run.checkpoint_every, before, env_steps) and env_steps < total:
                    try:
                        self._save(writer, state)
                    except CheckpointError as error:
                        reporter.say(f"{error}; training goes on")
                if len(self.failed) == len(self.names):
                    break
        self._save(writer, state)
        writer.wait()
        if len(self.failed) == len(self.names):
            raise DivergedError(
                f"run {str(self.folder.path)!r} stopped at {env_steps:,} env steps: in every "
                f"member more than max_skipped_updates={run.max_skipped_updates} updates were not "
                "finite; see fault.json there"
            )
        return env_steps, env_steps < total

    def _log_chunk(self, state: TrainState, metrics: dict[str, Any], seconds: float) -> None:
        metrics, counters = gathered((metrics, state.counters))
        env_steps = int(counters.env_steps)
        for index, name in enumerate(self.names):
            own, numbers = member_counters(counters, index), member_metrics(metrics, index)
            if is_first():
                self._logs[index].write("train", env_steps, int(own.updates), numbers)
            limit = self.config.run.max_skipped_updates
            if int(own.skipped_updates) > limit and name not in self.failed:
                self.failed.add(name)
                self._report_fault(index, own, state)
        num_updates = self.config.steps_and_updates[1] * self.config.iterations_per_chunk
        if self._timings:
            self._timings.write(
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

    def _report_fault(self, index: int, counters: Counters, state: TrainState) -> None:
        """Says and writes down what is known of a member that no longer learns."""
        name = self.names[index]
        tensor = self.population.program.agent.checked[int(counters.first_fault)]
        learner, hyper = gathered((state.learner, state.hyper))
        bad = {
            jax.tree_util.keystr(path): int(np.sum(~np.isfinite(leaf[index])))
            for path, leaf in jax.tree_util.tree_flatten_with_path(learner)[0]
            if not np.all(np.isfinite(leaf[index]))
        }
        largest = {
            jax.tree_util.keystr(path): float(np.max(np.abs(leaf[index])))
            for path, leaf in jax.tree_util.tree_flatten_with_path(learner.critic_params)[0]
        }
        facts = {
            "member": name,
            "env_steps": int(counters.env_steps),
            "updates": int(counters.updates),
            "skipped_updates": int(counters.skipped_updates),
            "bad_physics": int(counters.bad_physics),
            "first_tensor_not_finite": tensor,
            "learner_values_not_finite": bad,
            "largest_critic_parameters": largest,
            "hyperparameters": {
                field: float(values[index]) for field, values in vars(hyper).items()
            },
        }
        path = self.folder.member_path(name) / "fault.json"
        if is_first():
            path.write_text(json.dumps(facts, indent=2) + "\n")
        self.reporter.say(
            f"{name}: {counters.skipped_updates} updates were not finite, {tensor} first; it "
            f"learns no more. Written to {path}"
        )

    def _evaluate(self, state: TrainState) -> None:
        policies, env_steps = policy_of(state), int(state.counters.env_steps)
        result = self.population.evaluate(policies, np.int32(env_steps))
        result, counters = gathered((result, state.counters))
        records, improved = [], []
        for index in range(len(self.names)):
            record = summarize(jax.tree.map(lambda values, i=index: values[i], result))
            updates = int(member_counters(counters, index).updates)
            if is_first():
                record = self._logs[index].write("eval", env_steps, updates, record)
            records.append(record)
            best = self.best[index]
            if best is None or record["return_mean"] > best.return_mean:
                self.best[index] = BestSoFar(env_steps, record["return_mean"])
                improved.append(index)
        self.reporter.evaluated(env_steps, records)
        if not improved:
            return
        policies = gathered(policies)
        for index in improved:
            best = self.best[index]
            if is_first() and best is not None:
                policy = jax.tree.map(lambda leaf, i=index: leaf[i], policies)
                save_best(self.folder, self.names[index], policy, best)

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

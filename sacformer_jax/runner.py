"""The host loop: chunks, evaluations, checkpoints, signals."""

from __future__ import annotations

import dataclasses
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sacformer_jax.checkpoint import Progress, RunFolder
from sacformer_jax.config import Config, ConfigError
from sacformer_jax.console import Reporter
from sacformer_jax.cores import usable_cores
from sacformer_jax.envs import VectorEnv
from sacformer_jax.evaluate import Evaluation, make_evaluator
from sacformer_jax.logging import MetricLog, Record, read_records
from sacformer_jax.plots import learning_curve
from sacformer_jax.presets import resolve
from sacformer_jax.train import Program, make_program, policy_of
from sacformer_jax.types import TrainState

_EVALUATION_STREAM = 2**31
"""Folded into the seed's key: beyond the small numbers by which training splits it."""


@dataclasses.dataclass(frozen=True)
class RunResult:
    """What a run left.

    Attributes:
      path: the run's folder.
      env_steps: environment steps done.
      evaluations: the ``"eval"`` records of ``metrics.jsonl``.
      interrupted: stopped by Ctrl-C (or SIGTERM) before its end.
    """

    path: Path
    env_steps: int
    evaluations: list[Record]
    interrupted: bool


def new_run_path(config: Config) -> Path:
    """The configured folder, or a new one under ``runs/``."""
    if config.run.run_dir:
        return Path(config.run.run_dir)
    name = f"{config.task.env.replace(':', '-')}-{config.agent}-{config.preset}-s{config.seed}"
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    path, count = Path("runs") / f"{name}-{stamp}", 1
    while path.exists():
        count += 1
        path = Path("runs") / f"{name}-{stamp}-{count}"
    return path


def train(config: Config, sources: dict[str, str] | None = None, quiet: bool = False) -> RunResult:
    """Trains from the start in a new run folder.

    Args:
      config: what to train.
      sources: where each value comes from, for the record; default: found from the preset.
      quiet: print nothing.

    Raises:
      ConfigError: a setting cannot work; nothing was written, but for ``config.json`` where prefill
        turns out too short (the folder may be used again).
      CheckpointError: the folder holds a run already or cannot be written.
    """
    program = make_program(config)
    folder = RunFolder(new_run_path(config))
    folder.create(config, sources or sources_of(config), program.env.spec)
    with Reporter(quiet) as reporter:
        state = program.init(jax.random.key(config.seed))
        reporter.facts(program, state, folder.path)
        with reporter.timed("compiling and running prefill"):
            state, _ = jax.block_until_ready(program.prefill(state))
        if not program.buffer.can_sample(state.buffer):
            raise ConfigError(
                f"prefill_env_steps={config.run.prefill_env_steps}: no episode of at least "
                f"context_length={config.context.context_length} steps finished in it; use more, "
                "or a smaller context_length"
            )
        return _Loop(program, folder, reporter, None).run(state)


def resume(path: str | Path, total_env_steps: int | None = None, quiet: bool = False) -> RunResult:
    """Continues a run from its newest checkpoint, bit for bit as if it had never stopped.

    Args:
      path: the run's folder.
      total_env_steps: train up to here instead of the configured total.
      quiet: print nothing.

    Raises:
      CheckpointError: there is nothing to resume, or it is damaged.
      ConfigError: ``total_env_steps`` has been reached already.
    """
    folder = RunFolder(path).opened()
    config = folder.read_config().config
    if total_env_steps is not None:
        config = config.replace(total_env_steps=total_env_steps).validated()
    latest = folder.latest_step()
    if latest is not None and latest >= config.run.total_env_steps:
        raise ConfigError(
            f"total_env_steps={config.run.total_env_steps}: run {str(folder.path)!r} has done "
            f"{latest} already; give more with --total-env-steps"
        )
    program = make_program(config)
    with Reporter(quiet) as reporter:
        restored = folder.restore(jax.eval_shape(program.init, jax.random.key(config.seed)))
        reporter.facts(program, restored.state, folder.path)
        reporter.say(f"resuming at  {restored.progress.env_steps:,} env steps")
        if restored.host_threads != usable_cores():
            reporter.say(
                f"note: saved with {restored.host_threads} CPU threads, continued with "
                f"{usable_cores()}: right, but not bit for bit the same"
            )
        return _Loop(program, folder, reporter, restored.progress).run(restored.state)


def sources_of(config: Config) -> dict[str, str]:
    """Where each value of a configuration comes from: its preset, the defaults, or the user."""
    flat = config.flat()
    chosen = {"agent": config.agent, "env": config.task.env}
    base = resolve(config.preset, chosen)
    given = {name for name, value in base.config.flat().items() if flat[name] != value}
    given.add("preset")
    return {name: "given" if name in given else base.sources[name] for name in flat}


def summarize(evaluation: Evaluation) -> Record:
    """An evaluation as the values of an ``"eval"`` record."""
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
def _stop_on_signal(reporter: Reporter) -> Iterator[Callable[[], bool]]:
    """The first SIGINT or SIGTERM asks to stop after the chunk; the second acts at once."""
    asked: list[int] = []
    previous: dict[int, Any] = {}

    def restore() -> None:
        for number, handler in previous.items():
            signal.signal(number, handler)

    def ask(number: int, frame: Any) -> None:
        asked.append(number)
        reporter.say("stopping after this chunk, then saving; once more to stop at once")
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


class _Loop:
    """Runs chunks until the end, with everything that happens between them."""

    def __init__(
        self, program: Program, folder: RunFolder, reporter: Reporter, resumed: Progress | None
    ):
        self.program, self.folder, self.reporter = program, folder, reporter
        self.config = config = program.config
        self.best_return = resumed.best_return if resumed else None
        self.evaluator = make_evaluator(
            VectorEnv(program.env.env, config.run.eval_episodes, config.task.max_episode_steps),
            program.agent,
            config.context.context_length,
        )
        self.log = MetricLog(
            folder.metrics_path,
            folder.timings_path,
            folder.path / "tensorboard",
            keep_bytes=resumed.metrics_bytes if resumed else 0,
            purge_after=resumed.env_steps if resumed else None,
        )
        self.started = time.perf_counter()

    def run(self, state: TrainState) -> RunResult:
        config, reporter = self.config, self.reporter
        total = config.run.total_env_steps
        with reporter.timed("compiling train_chunk"):
            train_chunk = self.program.train_chunk.lower(state).compile()
        env_steps = int(state.counters.env_steps)
        reporter.start_training(env_steps, total)
        self.started = time.perf_counter()
        try:
            with _stop_on_signal(reporter) as stop_asked:
                if self.best_return is None:
                    self._evaluate(state)  # where learning starts from
                while env_steps < total and not stop_asked():
                    before = env_steps
                    chunk_start = time.perf_counter()
                    state, metrics = jax.block_until_ready(train_chunk(state))
                    env_steps = int(state.counters.env_steps)
                    self._log_chunk(state, metrics, time.perf_counter() - chunk_start)
                    if _crossed(config.run.eval_every, before, env_steps) or env_steps >= total:
                        self._evaluate(state)
                    if _crossed(config.run.checkpoint_every, before, env_steps):
                        self._save(state)
                interrupted = env_steps < total
            self._save(state)
        finally:
            self.log.close()
        return self._finish(env_steps, interrupted)

    def _log_chunk(self, state: TrainState, metrics: dict[str, Any], seconds: float) -> None:
        env_steps, updates = int(state.counters.env_steps), int(state.counters.updates)
        self.log.write("train", env_steps, updates, metrics)
        num_updates = self.config.steps_and_updates[1] * self.config.iterations_per_chunk
        self.log.write_timing(
            env_steps,
            updates,
            {
                "chunk_seconds": seconds,
                "steps_per_second": self.config.env_steps_per_chunk / seconds,
                "ms_per_update": 1e3 * seconds / num_updates,
                "wall_seconds": time.perf_counter() - self.started,
            },
        )
        self.reporter.chunk_done(env_steps)

    def _evaluate(self, state: TrainState) -> None:
        env_steps = int(state.counters.env_steps)
        key = jax.random.fold_in(jax.random.key(self.config.seed), _EVALUATION_STREAM)
        result = self.evaluator(policy_of(state), jax.random.fold_in(key, env_steps))
        updates = int(state.counters.updates)
        record = self.log.write("eval", env_steps, updates, summarize(result))
        self.reporter.evaluated(record)
        if self.best_return is None or record["return_mean"] > self.best_return:
            self.best_return = record["return_mean"]
            self.folder.save_best(policy_of(state), env_steps, record["return_mean"])

    def _save(self, state: TrainState) -> None:
        env_steps = int(state.counters.env_steps)
        progress = Progress(env_steps, self.log.metrics_bytes, self.best_return)
        self.folder.save(state, policy_of(state), progress)

    def _finish(self, env_steps: int, interrupted: bool) -> RunResult:
        path, say = self.folder.path, self.reporter.say
        records = read_records(self.folder.metrics_path)
        evaluations = [record for record in records if record["kind"] == "eval"]
        picture = path / "learning_curve.png"
        task = self.config.task.env
        learning_curve(records, picture, f"{self.config.agent} on {task}, seed {self.config.seed}")
        self.reporter.table(evaluations)
        say(f"training time  {time.perf_counter() - self.started:.0f} s, evaluations included")
        say(f"checkpoint     {path / 'checkpoints' / str(env_steps)}")
        say(f"learning curve {picture}")
        if interrupted:
            say(f"stopped at {env_steps:,} env steps; continue with: sacformer resume {path}")
        return RunResult(path, env_steps, evaluations, interrupted)


def _crossed(every: int, before: int, now: int) -> bool:
    """Whether a multiple of ``every`` lies in ``(before, now]``."""
    return now // every > before // every

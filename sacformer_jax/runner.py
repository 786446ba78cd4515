"""Training and resuming runs: checks before anything is written, then the host loop."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path

import jax
import numpy as np

from sacformer_jax.callbacks import Callback, Callbacks
from sacformer_jax.checkpoint import Progress, RunFolder
from sacformer_jax.config import Config, ConfigError
from sacformer_jax.console import Reporter
from sacformer_jax.cores import xla_threads
from sacformer_jax.datasets import described, read_episodes
from sacformer_jax.digests import num_bytes
from sacformer_jax.lock import locked
from sacformer_jax.logging import read_records, write_csv
from sacformer_jax.loop import Loop
from sacformer_jax.members import Member, seed_members
from sacformer_jax.memory import available_bytes, check_fits
from sacformer_jax.offline import Episode, check_episodes, with_dataset
from sacformer_jax.pictures import RunRecords, draw_records
from sacformer_jax.population import Devices, Population, make_population
from sacformer_jax.presets import resolve
from sacformer_jax.processes import all_here, gathered, is_first
from sacformer_jax.render import VideoEvery, check_drawable
from sacformer_jax.results import RunResult
from sacformer_jax.types import TrainState


def new_run_path(config: Config) -> Path:
    """The configured folder, or a new one under ``runs/``."""
    if config.run.run_dir:
        return Path(config.run.run_dir)
    if jax.process_count() > 1:
        raise ConfigError("run_dir='': several processes need one folder that they all see")
    name = f"{config.task.env.replace(':', '-')}-{config.agent}-{config.preset}-s{config.seed}"
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    path, count = Path("runs") / f"{name}-{stamp}", 1
    while path.exists():
        count += 1
        path = Path("runs") / f"{name}-{stamp}-{count}"
    return path


def train(
    config: Config,
    sources: dict[str, str] | None = None,
    quiet: bool = False,
    members: Sequence[Member] | None = None,
    devices: Devices | None = None,
    callbacks: Sequence[Callback] = (),
) -> RunResult:
    """Trains from the start in a new run folder.

    Args:
      config: what to train.
      sources: where each value comes from, for the record; default: found from the preset.
      quiet: print nothing.
      members: what to train side by side; default: one for each of ``config.all_seeds``.
      devices: how they lie on devices; default: the members over as many as divide them.
      callbacks: what is called between chunks; see :mod:`sacformer_jax.callbacks`.

    Raises:
      ConfigError: a setting cannot work; nothing was written, but for ``config.json`` where prefill
        turns out too short or a callback refuses (the folder may be used again).
      CheckpointError: the folder holds a run already or cannot be written.
      DivergedError: too many updates were not finite.
      Exception: what a callback raised; the run was saved, if it had begun.
    """
    members = seed_members(config.all_seeds) if members is None else members
    population = make_population(config, members, devices or Devices.for_members(len(members)))
    check_memory(population)
    episodes = dataset_of(population)
    if config.run.video_every and is_first():
        check_drawable(population.program.env.env)
    folder = RunFolder(new_run_path(config))
    sources = sources or sources_of(config)

    def begin() -> RunResult:
        if is_first():
            folder.create(config, sources, population.program.env.spec, population.members)
        all_here()
        return _start(population, folder, quiet, callbacks, episodes)

    return _alone_in(folder, begin)


def resume(
    path: str | Path,
    total_env_steps: int | None = None,
    quiet: bool = False,
    devices: Devices | None = None,
    callbacks: Sequence[Callback] = (),
) -> RunResult:
    """Continues a run from its newest good checkpoint, bit for bit as if it had never stopped.

    A run that was stopped before its first checkpoint starts from the beginning.

    Args:
      path: the run's folder.
      total_env_steps: train up to here instead of the configured total.
      quiet: print nothing.
      devices: how the members lie on devices, as in :func:`train`; it may be another way than that
        of before (right, but no longer bit for bit the same).
      callbacks: as in :func:`train`; those of before are not remembered.

    Raises:
      CheckpointError: there is nothing to resume, or every checkpoint is damaged.
      ConfigError: ``total_env_steps`` has been reached already, or is before a replay that was not
        saved is filled again.
      DivergedError: too many updates were not finite.
      Exception: what a callback raised; the run was saved.
    """
    folder = RunFolder(path).opened()
    run = folder.read_config()
    config, num_members = run.config, len(run.members)
    if total_env_steps is not None:
        config = config.replace(total_env_steps=total_env_steps).validated()
    latest = folder.latest_step()
    if latest is not None and latest >= config.run.total_env_steps:
        raise ConfigError(
            f"total_env_steps={config.run.total_env_steps}: run {str(folder.path)!r} has done "
            f"{latest} already; give more with --total-env-steps"
        )
    again = 0 if config.run.checkpoint_replay else config.env_steps_of_prefill
    if latest is not None and latest + again >= config.run.total_env_steps:
        raise ConfigError(
            f"total_env_steps={config.run.total_env_steps}: run {str(folder.path)!r} has done "
            f"{latest}, and its replay, which was not saved, takes {again} to fill again; give "
            "more with --total-env-steps"
        )
    population = make_population(config, run.members, devices or Devices.for_members(num_members))
    check_memory(population)

    def go_on() -> RunResult:
        if folder.latest_step() is None:
            return _start(population, folder, quiet, callbacks, dataset_of(population))
        with Reporter(quiet or not is_first()) as reporter:
            restored = folder.restore(
                population.stored(population.abstract()),
                population.stored(population.block_axes),
                population.stored(population.shardings),
            )
            for damaged in restored.moved_aside:
                reporter.say(f"note: {damaged}")
            progress = restored.progress
            reporter.facts(population, folder.path)
            reporter.say(f"resuming at  {progress.env_steps:,} env steps")
            now = _split_over(xla_threads(), dataclasses.asdict(population.devices))
            for what, before in _split_over(restored.host_threads, restored.devices).items():
                if before != now[what]:
                    reporter.say(
                        f"note: saved with {before} {what}, continued with {now[what]}: right, but "
                        "not bit for bit the same"
                    )

            def restored_state() -> TrainState:
                if config.run.checkpoint_replay:
                    return restored.state
                with reporter.timed("no replay was saved: collecting one under the policy"):
                    state, _ = jax.block_until_ready(population.refill(restored.state))
                return state

            env_steps = progress.env_steps + again
            return _train_on(
                population, folder, reporter, callbacks, env_steps, progress, restored_state
            )

    return _alone_in(folder, go_on)


def _split_over(host_threads: int, devices: dict[str, int]) -> dict[str, int]:
    """Over how many of what sums are split, which decides about their last bits."""
    return {
        "CPU threads": host_threads,
        **{f"devices for the {axis}": number for axis, number in devices.items()},
    }


def dataset_of(population: Population) -> list[Episode]:
    """The episodes that the replay is to start with; empty where there is no dataset.

    Raises:
      ConfigError: it cannot be read, or does not fit the task; or there are several processes.
    """
    config = population.config
    if not config.offline.dataset:
        return []
    if jax.process_count() > 1:
        raise ConfigError(
            f"dataset={config.offline.dataset!r}: can be read by one process only; start it in "
            "one, and resume in several"
        )
    spec = population.program.env.spec
    episodes = read_episodes(config.offline.dataset, spec)
    check_episodes(episodes, spec, config)
    return episodes


def check_memory(population: Population) -> None:
    """Refuses a replay, if there is one, that does not fit in a device.

    Raises:
      ConfigError: with the arithmetic.
    """
    state, devices = population.abstract(), population.devices
    if state.buffer is None:
        return
    # Learner and counters lie on every data device, but next to the replay they are nothing.
    num_devices = devices.members * devices.data
    device, on_cpu = jax.local_devices()[0], jax.default_backend() == "cpu"
    sharing = min(num_devices, jax.local_device_count()) if on_cpu else 1
    check_fits(
        state_bytes=num_bytes(state) // num_devices,
        replay_bytes=num_bytes(state.buffer) // num_devices,
        config=population.config,
        members_per_device=len(population.members) // devices.members,
        available=available_bytes(device, sharing),
        copies=2 if on_cpu else 1,
        data_shards=devices.data,
    )


def _alone_in(folder: RunFolder, do: Callable[[], RunResult]) -> RunResult:
    """``do()`` while nobody else trains in the folder."""
    if not is_first():
        return do()
    with locked(folder.path):
        return do()


def _start(
    population: Population,
    folder: RunFolder,
    quiet: bool,
    callbacks: Sequence[Callback],
    episodes: Sequence[Episode],
) -> RunResult:
    """Trains from the start, the replay holding ``episodes``."""
    config, reporter = population.config, Reporter(quiet or not is_first())

    def started() -> TrainState:
        # Where it lies already; but now bound to it, as what is read from a checkpoint is: both
        # then compile to the same programs, and resuming finds them in the compilation cache.
        state = jax.device_put(population.init(), population.shardings)
        if episodes:
            state, dropped = with_dataset(population, state, episodes)
            reporter.say(described(config.offline.dataset, episodes, dropped))
        if population.num_drawable is not None:
            if config.prefill_vector_steps:
                with reporter.timed("compiling and running prefill"):
                    state, _ = jax.block_until_ready(population.prefill(state))
            drawable = gathered(population.num_drawable(state.buffer))
            if not np.all(drawable > 0):
                raise ConfigError(
                    f"prefill_env_steps={config.run.prefill_env_steps}: no episode of at least "
                    f"context_length={config.context.context_length} steps finished in it; use "
                    "more, or a smaller context_length"
                )
        return state

    prefilled = 0 if population.num_drawable is None else config.env_steps_of_prefill
    with reporter:
        reporter.facts(population, folder.path)
        return _train_on(population, folder, reporter, callbacks, prefilled, None, started)


def _train_on(
    population: Population,
    folder: RunFolder,
    reporter: Reporter,
    given: Sequence[Callback],
    env_steps: int,
    progress: Progress | None,
    state_of: Callable[[], TrainState],
) -> RunResult:
    """Trains from ``env_steps`` on; the state there is asked for once no callback refuses."""
    every, own = population.config.run.video_every, []
    if every:
        own.append(VideoEvery(every, say=reporter.say))
    callbacks, result = Callbacks([*given, *own], population, folder.path), None
    sources = folder.read_config().sources
    callbacks.start(env_steps, progress is not None, sources)
    try:
        callbacks.raise_error()
        loop = Loop(population, folder, reporter, callbacks, progress)
        result = _finished(population, folder, reporter, loop, loop.run(state_of()))
    finally:
        callbacks.end(result)
    return result


def _finished(
    population: Population, folder: RunFolder, reporter: Reporter, loop: Loop, env_steps: int
) -> RunResult:
    """Writes tables and pictures of what came of it, and says it."""
    all_here()
    records = {
        member.name: read_records(folder.metrics_path(member.name)) for member in population.members
    }
    evaluations = {
        name: [record for record in rows if record["kind"] == "eval"]
        for name, rows in records.items()
    }
    if is_first():
        try:
            for name, own in records.items():
                for kind in ("train", "eval"):
                    write_csv(own, kind, folder.member_path(name) / f"{kind}.csv")
            draw_records(RunRecords(folder, folder.read_config(), records), folder.path)
        except OSError as error:
            reporter.say(
                f"note: tables and pictures in {folder.path} cannot be written ({error.strerror}); "
                f"the run is saved; make room, then 'sacformer plot {folder.path}'"
            )
    over = env_steps >= population.config.run.total_env_steps
    reporter.closing(loop.started, folder, env_steps, not over, evaluations)
    several = len(records) > 1
    rows = [
        {"member": name, **record} if several else record
        for name, own in evaluations.items()
        for record in own
    ]
    stopped = loop.callbacks.stop and not over
    return RunResult(folder.path, env_steps, rows, not over and not stopped, stopped)


def sources_of(config: Config) -> dict[str, str]:
    """Where each value of a configuration comes from: its preset, the defaults, or the user."""
    flat = config.flat()
    given = {"agent": config.agent, "env": config.task.env}
    base = resolve(config.preset, given).config.flat()
    given |= {name: value for name, value in flat.items() if base[name] != value}

    def follows(name: str) -> bool:
        """Whether the preset itself comes to the value, given the others."""
        others = {other: value for other, value in given.items() if other != name}
        return resolve(config.preset, others).config.flat()[name] == flat[name]

    kept = {n: value for n, value in given.items() if n in ("agent", "env") or not follows(n)}
    return {**resolve(config.preset, kept).sources, "preset": "given"}

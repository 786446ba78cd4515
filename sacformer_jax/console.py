"""What a person sees while training: start-up facts, a progress bar, the closing table."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType

import jax
from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from sacformer_jax.digests import num_bytes
from sacformer_jax.logging import Record, rank
from sacformer_jax.population import Population
from sacformer_jax.run_folder import RunFolder


def _count(params: object) -> str:
    """Parameters of one member, of leaves that lead with the members."""
    return f"{sum(leaf.size // leaf.shape[0] for leaf in jax.tree.leaves(params)):,}"


class _Output(Console):
    """Prints as long as somebody reads: a run goes on when nobody does, or when a log is full."""

    def on_broken_pipe(self) -> None:
        """Prints nothing any more, where Rich would end the program."""
        self.quiet = True
        # What Python flushes at its end, too.
        with contextlib.suppress(OSError, ValueError), open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), self.file.fileno())

    def _check_buffer(self) -> None:
        try:
            super()._check_buffer()
        except OSError:
            del self._buffer[:]  # this line is lost, others may be printed again


class _Speed(ProgressColumn):
    """Environment steps per second since the program started."""

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text("– steps/s" if speed is None else f"{speed:.0f} steps/s")


class Reporter:
    """Prints to a terminal; where there is none, a line an evaluation instead of a bar.

    Args:
      quiet: print nothing.
    """

    def __init__(self, quiet: bool = False):
        self.console = _Output(quiet=quiet, highlight=False, soft_wrap=True, emoji=False)
        self._bar = Progress(
            TextColumn("{task.completed:,.0f}/{task.total:,.0f} env steps"),
            BarColumn(bar_width=30),
            _Speed(),
            TextColumn("eval return {task.fields[eval_return]}"),
            TextColumn("ETA"),
            TimeRemainingColumn(),
            console=self.console,
            disable=quiet or not self.console.is_terminal,
            speed_estimate_period=60.0,
        )
        self._started = time.perf_counter()

    def __enter__(self) -> Reporter:
        self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._bar.stop()

    def say(self, text: str) -> None:
        """Prints a line above the bar."""
        self.console.print(text, markup=False)

    @contextmanager
    def timed(self, what: str) -> Iterator[None]:
        """Announces something slow, then says how long it took."""
        self.say(f"{what} …")
        start = time.perf_counter()
        yield
        self.say(f"{what}: {time.perf_counter() - start:.1f} s")

    def facts(self, population: Population, run_path: Path) -> None:
        """Says what is about to run."""
        config, spec = population.config, population.program.env.spec
        members, devices = population.members, population.devices
        state = population.abstract()
        learner = state.learner
        self.say(f"run          {run_path}")
        self.say(
            f"task         {spec.name}: {spec.obs_size} observations, {spec.action_size} actions, "
            f"{config.task.num_envs} environments"
        )
        if spec.wrapping.words():
            self.say(f"wrappers     {', '.join(spec.wrapping.words())}")
        self.say(f"engine       {spec.engine} ({spec.engine_reason})")
        who = f"seed {members[0].seed}"
        if len(members) > 1:
            who = f"{len(members)} members: {', '.join(member.name for member in members)}"
        self.say(f"agent        {config.agent}, preset {config.preset}, {who}")
        if devices.members * devices.data > 1:
            self.say(
                f"devices      {devices.members} for the members times {devices.data} for the data "
                f"of each, {jax.process_count()} processes"
            )
        self.say(
            f"parameters   actor {_count(learner.actor_params)}, "
            f"critics {_count(learner.critic_params)}"
        )
        cache = num_bytes(state.context.cache)
        replay = "no replay"
        if state.buffer is not None:
            replay = f"replay {num_bytes(state.buffer) / 2**20:.1f} MiB"
        self.say(
            f"memory       {replay}"
            + (f", cache of acting {cache / 2**20:.1f} MiB" if cache else "")
        )

    def start_training(self, env_steps: int, total: int) -> None:
        """Shows the progress bar."""
        self._started = time.perf_counter()
        self._task = self._bar.add_task("train", total=total, completed=env_steps, eval_return="–")

    def chunk_done(self, env_steps: int) -> None:
        """Moves the bar."""
        self._bar.update(self._task, completed=env_steps)

    def evaluated(self, env_steps: int, records: list[Record]) -> None:
        """Shows an evaluation of each member."""
        returns = [record["return_mean"] for record in records]
        mean = sum(returns) / len(returns)
        if len(records) == 1:
            rest = f"± {records[0]['return_std']:.1f}  length {records[0]['length_mean']:.0f}"
        else:
            rest = f"mean of {len(records)} members, {min(returns):.1f} to {max(returns):.1f}"
        self._bar.update(self._task, eval_return=f"{mean:.0f}")
        self.say(
            f"{env_steps:>9,} env steps  {time.perf_counter() - self._started:6.0f} s  "
            f"eval return {mean:8.1f} {rest}"
        )

    def closing(
        self,
        started: float,
        folder: RunFolder,
        env_steps: int,
        interrupted: bool,
        evaluations: dict[str, list[Record]],
    ) -> None:
        """Says what came of it; ``started`` by ``time.perf_counter``."""
        if len(evaluations) == 1:
            self._evaluations(*evaluations.values())
        else:
            self._last_evaluations(evaluations)
        path, say = folder.path, self.say
        say(f"training time  {time.perf_counter() - started:.0f} s, evaluations included")
        say(f"checkpoint     {path / 'checkpoints' / str(env_steps)}")
        say(f"learning curve {path / 'learning_curve.png'}")
        if interrupted:
            say(f"stopped at {env_steps:,} env steps; continue with: sacformer resume {path}")

    def _last_evaluations(self, evaluations: dict[str, list[Record]]) -> None:
        """Prints a row for each member, below the bar."""
        if not self._bar.disable:
            self._bar.stop()
        table = Table(title="evaluations, mean action: the last, and the best")
        for column in ("member", "env steps", "return", "std", "best", "at env steps"):
            table.add_column(column, justify="left" if column == "member" else "right")
        for name, records in evaluations.items():
            if not records:  # lost, and none made since
                continue
            last, best = records[-1], max(records, key=rank)
            table.add_row(
                name,
                f"{last['env_steps']:,}",
                f"{last['return_mean']:.1f}",
                f"{last['return_std']:.1f}",
                f"{best['return_mean']:.1f}",
                f"{best['env_steps']:,}",
            )
        self.console.print(table)

    def _evaluations(self, evaluations: list[Record]) -> None:
        """Prints the evaluations as a table (at most the last 15), below the bar."""
        if not self._bar.disable:
            self._bar.stop()
        table = Table(title="evaluations, mean action")
        for column in ("env steps", "return", "std", "length", "episodes"):
            table.add_column(column, justify="right")
        for record in evaluations[-15:]:
            table.add_row(
                f"{record['env_steps']:,}",
                f"{record['return_mean']:.1f}",
                f"{record['return_std']:.1f}",
                f"{record['length_mean']:.0f}",
                str(record["episodes"]),
            )
        self.console.print(table)

"""Studies: runs by name, trained a few at a time, one table of their evaluations, its figures.

A study's script makes a :class:`Study` and returns its :meth:`Study.main`. All seeds of a run are
one program. Run NAME lies in runs/STUDY/NAME; a run that is done is skipped and one that was
stopped is resumed, so a script can be stopped (Ctrl-C) and started again at will. Whenever a run
ends, results/STUDY.csv and its figures (figures.py) are written anew; rows of runs that were not
asked for stay as they are.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import fcntl
import os
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import figures
from machine import UNKNOWN, cpu_with_cores
from report.scores import variant_of
from study_rows import NOT_COMPARED, rows_of, settings_digest
from study_table import Row, furthest, read_table, summary, write_table

import sacformer_jax
from sacformer_jax import Config, ConfigError, resume, train
from sacformer_jax.checkpoint import CheckpointError, RunFolder
from sacformer_jax.cli import EXIT_INTERRUPTED
from sacformer_jax.cores import usable_cores

EXIT_FAILED = 1
SCALES = ("cpu", "full")
_POLL_SECONDS = 0.2


@dataclasses.dataclass
class _Worker:
    """A process that trains one run."""

    name: str
    process: subprocess.Popen[bytes]
    cores: list[int]
    signals_sent: int = 0


class Study:
    """Runs that are compared with each other.

    Args:
      name: of the study.
      configs: every run's name, ``[TASK-]VARIANT``, and configuration, whose ``seeds`` are trained
        together; ``run_dir`` is set here. Seeds that a variant gets in another run belong to it
        where that run's name ends in ``-from-SEED``.
      script: the file that makes the study; it is started again as the worker of each run.
      runs: where run folders lie; default ``runs/NAME`` below the working directory.
      results: where table and picture go; default ``results`` beside the script.
    """

    def __init__(
        self,
        name: str,
        configs: dict[str, Config],
        script: str | Path,
        runs: Path | None = None,
        results: Path | None = None,
    ):
        self.name, self.script = name, Path(script).resolve()
        self.runs = runs or Path("runs") / name
        self.configs = {
            run: config.replace(run_dir=str(self.runs / run)) for run, config in configs.items()
        }
        results = results or self.script.parent / "results"
        self.table = results / f"{name}.csv"
        self.flags: tuple[str, ...] = ()

    def main(
        self,
        arguments: Sequence[str] | None = None,
        parents: Sequence[argparse.ArgumentParser] = (),
    ) -> int:
        """The command line; 0 when all is done, 3 after a signal, else 1 if a run failed."""
        parser = argparse.ArgumentParser(
            description=f"Runs of the study {self.name!r}.", parents=list(parents)
        )
        parser.add_argument(
            "--only", nargs="+", choices=list(self.configs), metavar="RUN", help="some of the runs"
        )
        parser.add_argument(
            "--jobs", type=int, default=1, help="runs side by side, each on its share of the cores"
        )
        parser.add_argument("--list", action="store_true", help="print the runs and stop")
        parser.add_argument("--worker", choices=list(self.configs), help=argparse.SUPPRESS)
        parser.add_argument("--cores", type=int, nargs="*", help=argparse.SUPPRESS)
        args = parser.parse_args(arguments)
        if args.worker:
            return self._work(args.worker, args.cores)
        names = args.only or list(self.configs)
        if args.list:
            print("\n".join(names))
            return 0
        cores = _cores()
        if not 1 <= args.jobs <= max(1, len(cores)):
            parser.error(f"--jobs {args.jobs}: must be from 1 to {max(1, len(cores))}, the cores")
        rows = read_table(self.table)
        for name in names:
            try:
                changed = self._changed(name)
            except (CheckpointError, ConfigError) as error:
                parser.error(f"{self.runs / name}: {error}")
            if changed:
                parser.error(
                    f"{self.runs / name} was trained with other settings ({', '.join(changed)}): "
                    "move it away to train anew"
                )
            if others := self._of_other_settings(name, rows):
                parser.error(
                    f"{self.table} has {', '.join(others)}, trained with other settings than "
                    f"{name} would be now, and counts them as the same: rename those runs, or take "
                    "their rows out"
                )
        shares = [cores[i :: args.jobs] for i in range(args.jobs)] if args.jobs > 1 else [[]]
        code = self._train(names, shares)
        self.write(names)
        print(summary(read_table(self.table), names))
        return code

    # --- running -----------------------------------------------------------------------------

    def _done(self, name: str) -> bool:
        config = self.configs[name]
        return (self._folder(name).latest_step() or 0) >= config.run.total_env_steps

    def _folder(self, name: str) -> RunFolder:
        return RunFolder(self.configs[name].run.run_dir)

    def _changed(self, name: str) -> list[str]:
        """Fields in which an existing run differs from what the study asks for now."""
        folder = self._folder(name)
        if folder.latest_step() is None:
            return []
        now, then = self.configs[name].flat(), folder.read_config().config.flat()
        return [field for field in now if field not in NOT_COMPARED and now[field] != then[field]]

    def _of_other_settings(self, name: str, rows: Iterable[Row]) -> list[str]:
        """Runs in the table's ``rows`` that are seeds of the same variant on the same task, trained
        with other settings. A run of this very name is not among them: it is trained anew.
        """
        config = self.configs[name]
        digest = settings_digest(config)
        variant = variant_of({"run": name, "env": config.task.env, "seed": config.all_seeds[0]})
        others = {
            row["run"]
            for row in rows
            if (row["env"], variant_of(row)) == (config.task.env, variant)
            and row["run"] != name
            and (row.get("settings") or digest) != digest
        }
        return sorted(others)

    def _train(self, names: list[str], shares: list[list[int]]) -> int:
        """Keeps one worker on each share of the cores; signals are passed on to the workers."""
        waiting, free = deque(n for n in names if not self._done(n)), deque(shares)
        working: list[_Worker] = []
        failed: list[str] = []
        asked: list[int] = []
        previous = {
            number: signal.signal(number, lambda got, _: asked.append(got))
            for number in (signal.SIGINT, signal.SIGTERM)
        }
        try:
            while working or (waiting and not asked):
                while waiting and free and not asked:
                    working.append(self._start(waiting.popleft(), free.popleft()))
                for worker in working:
                    while worker.signals_sent < len(asked):
                        worker.process.send_signal(asked[worker.signals_sent])
                        worker.signals_sent += 1
                ended = [w for w in working if w.process.poll() is not None]
                for worker in ended:
                    working.remove(worker)
                    free.append(worker.cores)
                    code = worker.process.returncode
                    print(f"{worker.name}: {'done' if code == 0 else f'ended with code {code}'}")
                    if code != 0 and not asked:
                        failed.append(worker.name)
                    self.write([worker.name])
                if not ended:
                    time.sleep(_POLL_SECONDS)
        finally:
            for worker in working:  # only after an error here: they are to save and end
                worker.process.terminate()
            for number, handler in previous.items():
                signal.signal(number, handler)
        if failed:
            print(f"failed: {', '.join(failed)}", file=sys.stderr)
        if asked:
            return EXIT_INTERRUPTED
        return EXIT_FAILED if failed else 0

    def _start(self, name: str, cores: list[int]) -> _Worker:
        """Starts a run's worker: on the terminal, or with a log where several run side by side."""
        command = [sys.executable, str(self.script), *self.flags, "--worker", name, "--cores"]
        command += [str(core) for core in cores]
        log = self.runs / f"{name}.log"
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("ab") if cores else contextlib.nullcontext() as output:
            # A session of its own: the terminal's Ctrl-C reaches only us, who pass it on once.
            process = subprocess.Popen(
                command, start_new_session=True, stdout=output, stderr=output
            )
        print(f"{name}: started" + (f" on cores {cores}, log in {log}" if cores else ""))
        return _Worker(name, process, cores)

    def _work(self, name: str, cores: list[int]) -> int:
        if cores:
            os.sched_setaffinity(0, cores)  # before JAX makes its threads
        config, folder = self.configs[name], self._folder(name)
        self._note_origin(name)
        if folder.latest_step() is None:
            result = train(config)
        else:
            result = resume(folder.path, total_env_steps=config.run.total_env_steps)
        return EXIT_INTERRUPTED if result.interrupted else 0

    # --- results -----------------------------------------------------------------------------

    def _note_origin(self, name: str) -> None:
        """Keeps by which versions of the library a run was trained, and on how many cores of which
        processors.
        """
        described = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--exclude=*"],
            cwd=Path(sacformer_jax.__file__).parent, capture_output=True, text=True, check=False,
        )  # fmt: skip
        begins = self._folder(name).latest_step() is None
        commit = described.stdout.strip() or UNKNOWN
        for what, value in (("commits", commit), ("cpus", cpu_with_cores(usable_cores()))):
            noted = [] if begins else self._noted(name, what) or [UNKNOWN]
            if value not in noted:
                self._notes(name, what).write_text("\n".join([*noted, value]) + "\n")

    def _notes(self, name: str, what: str) -> Path:
        return self.runs / f"{name}.{what}"

    def _noted(self, name: str, what: str) -> list[str]:
        path = self._notes(name, what)
        return path.read_text().splitlines() if path.exists() else []

    def rows(self, name: str) -> list[Row]:
        """A run's evaluations as rows of the table; none if it has not begun."""
        commits, cpus = self._noted(name, "commits"), self._noted(name, "cpus")
        return rows_of(self.name, name, self._folder(name), commits, cpus)

    def write(self, names: Iterable[str]) -> None:
        """Puts the rows of these runs into the table and draws it; other runs' rows stay, and
        those of a run that goes further there, as where it was trained on another machine.
        """
        with self._table_alone():
            there, new = read_table(self.table), {}
            for name, rows in ((name, self.rows(name)) for name in names):
                if not rows:
                    continue
                ours = rows[-1]["settings"]
                same = [row for row in there if (row.get("settings") or ours) == ours]
                here, known = furthest(rows)[name], furthest(same).get(name, 0)
                if here < known:
                    print(
                        f"{name}: {self.table.name} has {known:,} env steps of it, "
                        f"{self._folder(name).path} {here:,}; those in the table stay"
                    )
                else:
                    new[name] = rows
            if write_table(self.table, new, list(self.configs)):
                figures.draw(self.table)

    @contextlib.contextmanager
    def _table_alone(self) -> Iterator[None]:
        """While no other process of this study writes its table and pictures."""
        self.table.parent.mkdir(parents=True, exist_ok=True)
        folder = os.open(self.table.parent, os.O_RDONLY)
        try:
            with contextlib.suppress(OSError):  # there are file systems without locks
                fcntl.flock(folder, fcntl.LOCK_EX)
            yield
        finally:
            os.close(folder)


def main_of_scales(study_at: Callable[[str], Study], arguments: Sequence[str] | None = None) -> int:
    """The command line of a study that there is at several scales: :meth:`Study.main` and
    ``--scale``.

    Args:
      study_at: makes the study at a scale, one of ``SCALES``.
      arguments: instead of those of the process.
    """
    text = "cpu (default): small networks and few steps; full: those of the paper"
    return main_of_choices(study_at, "scale", SCALES, text, arguments)


def main_of_choices(
    study_at: Callable[[str], Study],
    name: str,
    choices: Sequence[str],
    text: str,
    arguments: Sequence[str] | None = None,
) -> int:
    """The command line of studies that differ in one choice: :meth:`Study.main` and its flag.

    Args:
      study_at: makes the study of a choice.
      name: of the flag, without dashes.
      choices: the first is the default.
      text: the flag's help.
      arguments: instead of those of the process.
    """
    flag = f"--{name}"
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument(flag, dest="choice", choices=choices, default=choices[0], help=text)
    choice = parser.parse_known_args(arguments)[0].choice
    study = study_at(choice)
    study.flags = (flag, choice)
    return study.main(arguments, [parser])


def _cores() -> list[int]:
    """The cores this process may use; none where processes cannot be bound to them."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []

"""Where metrics go: JSONL files, TensorBoard, and at the end of training CSV files.

``metrics.jsonl`` holds one JSON object a line, without anything that depends on the clock, so that
two equal runs write equal files. Every line has ``kind``, ``env_steps`` and ``updates``.

``kind = "train"``, one line a chunk; means over its updates, or over the episodes finished in it
(``null`` where none finished):
  ``episodes``, ``episode_return_mean``, ``episode_return_max``, ``episode_length_mean``,
  ``bad_physics`` (steps dropped), ``skipped_updates`` (those with a tensor that was not finite;
  they are in no mean), ``critic_loss``, ``actor_loss``, ``q_mean``, ``entropy`` (nats), ``alpha``,
  ``actor_grad_norm``, ``critic_grad_norm``. PPO has no ``q_mean`` and no ``alpha``, but
  ``approx_kl`` (nats), ``clip_fraction``, ``explained_variance`` (of the value targets, before the
  round's updates), ``learning_rate`` (the actor's); its losses are the clipped ones, without
  coefficients, and its gradient norms those before scaling down.
``kind = "pretrain"``, where there is a dataset: one line for each 250 updates on it, with
  ``critic_loss``, ``q_mean``, ``critic_grad_norm``, ``actor_loss`` (minus the log density of the
  actions shown, in nats; of a deterministic policy the squared distance), ``actor_grad_norm``,
  ``action_error`` (mean distance of the mean action to that shown, in units of the action),
  ``skipped_updates``.
``kind = "eval"``, one line an evaluation:
  ``episodes``, ``return_mean``, ``return_std``, ``return_min``, ``return_max``, ``length_mean``,
  ``bad_physics`` (episodes cut off there).

Of several members each has such a file of its own; ``timings.jsonl`` is the run's and has a line a
chunk: ``env_steps``, ``updates``, ``chunk_seconds``, ``steps_per_second``, ``ms_per_update`` (each
over all members), ``wall_seconds`` (training time since the program started or resumed, evaluations
included).

When training ends or stops, ``train.csv`` and ``eval.csv`` are written beside ``metrics.jsonl``:
its lines of that kind, a column for each name, empty for null. TensorBoard has all numbers, as
``train/critic_loss``, and the settings, for its page of hyperparameters.
"""

from __future__ import annotations

import csv
import json
import math
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from tensorboardX import SummaryWriter
from tensorboardX.summary import hparams

Record = dict[str, Any]

_LONG_QUEUE = 32_767  # the most that macOS allows


def plain(value: Any) -> Any:
    """A JSON value: NaN and infinity become None, arrays become numbers."""
    if isinstance(value, str) or value is None:
        return value
    number = value.item() if hasattr(value, "item") else value
    if isinstance(number, float) and not math.isfinite(number):
        return None
    return number


class _Log:
    """Appends records to a JSONL file, and their numbers to TensorBoard."""

    def __init__(self, path: Path, keep_bytes: int, tensorboard_dir: Path, purge_after: int | None):
        self._file = path.open("r+b" if path.exists() else "wb")
        self._file.truncate(keep_bytes)
        self._file.seek(0, 2)
        purge_step = 0 if purge_after is None else purge_after + 1
        self._events = _Events(tensorboard_dir, purge_step, f".{path.stem}")

    def _append(self, tag: str, record: Record) -> None:
        self._file.write(json.dumps(record).encode() + b"\n")
        self._file.flush()
        numbers = {
            f"{tag}/{name}": value
            for name, value in record.items()
            if isinstance(value, int | float) and name not in ("env_steps", "updates")
        }
        self._events.add(numbers, record["env_steps"])

    def close(self) -> None:
        """Flushes and closes all files."""
        try:
            self._file.close()
        finally:
            self._events.close()


class _Events:
    """TensorBoard's file of events. It is a convenience: where it cannot be written, that is said
    once, and everything is in the JSONL file all the same.
    """

    def __init__(self, folder: Path, purge_step: int, suffix: str):
        self._folder = folder
        self._writer: SummaryWriter | None = None

        def open_() -> None:
            # A queue that no chunk fills: nobody would empty it after its thread died.
            self._writer = SummaryWriter(
                str(folder), purge_step=purge_step, filename_suffix=suffix, max_queue=_LONG_QUEUE
            )

        self._guarded(open_)

    def add(self, numbers: Record, env_steps: int) -> None:
        """Adds numbers by name."""

        def add_scalars(writer: SummaryWriter) -> None:
            for name, value in numbers.items():
                writer.add_scalar(name, value, env_steps)

        self._write(add_scalars)

    def add_settings(self, settings: Record) -> None:
        """Adds what the page of hyperparameters shows."""

        def add_summaries(writer: SummaryWriter) -> None:
            # Into the same file as the metrics; the writer's own method would begin another run.
            for summary in hparams(settings, {"eval/return_mean": None}):
                writer.file_writer.add_summary(summary)

        self._write(add_summaries)

    def close(self) -> None:
        """Flushes and closes the file."""
        self._write(lambda writer: writer.close())

    def _write(self, do: Callable[[SummaryWriter], None]) -> None:
        writer = self._writer
        if writer is None:
            return
        events = writer.file_writer.event_writer
        if not events._worker.is_alive():  # an error of the disk ends it, which nobody is told
            events._event_queue.cancel_join_thread()
            self._given_up("its writer has died, as on a full disk")
            return
        self._guarded(lambda: do(writer))

    def _guarded(self, do: Callable[[], None]) -> None:
        try:
            do()
        except OSError as error:
            self._given_up(str(error.strerror or error))

    def _given_up(self, why: str) -> None:
        self._writer = None
        warnings.warn(
            f"TensorBoard: {self._folder} cannot be written ({why}); training goes on, and "
            "everything is in the JSONL file",
            stacklevel=2,
        )


class MetricLog(_Log):
    """Appends records to a member's ``metrics.jsonl`` and TensorBoard.

    Args:
      path: the JSONL file.
      tensorboard_dir: folder of TensorBoard events.
      keep_bytes: length to cut the file back to, when a run is resumed; to less where what is there
        ends earlier in whole records.
      purge_after: environment steps after which TensorBoard events are dropped, on resume; None
        drops all of them, for a run that starts.
      settings: of the member, for TensorBoard's page of hyperparameters.
    """

    def __init__(
        self,
        path: Path,
        tensorboard_dir: Path,
        keep_bytes: int = 0,
        purge_after: int | None = None,
        settings: dict[str, Any] | None = None,
    ):
        whole = max((end for _, end in _records(path) if end <= keep_bytes), default=0)
        super().__init__(path, whole, tensorboard_dir, purge_after)
        self.lost_bytes = keep_bytes - whole
        if settings:
            self._add_settings(settings)

    def _add_settings(self, settings: dict[str, Any]) -> None:
        plain_types = (str, bool, int, float)
        shown = {
            name: value if isinstance(value, plain_types) else str(value)
            for name, value in settings.items()
        }
        self._events.add_settings(shown)

    @property
    def num_bytes(self) -> int:
        """Length of the file, everything written so far included."""
        return self._file.tell()

    def write(self, kind: str, env_steps: int, updates: int, values: Record) -> Record:
        """Appends a record of metrics and returns it as written."""
        record = {"kind": kind, "env_steps": env_steps, "updates": updates}
        record.update({name: plain(value) for name, value in values.items()})
        self._append(kind, record)
        return record


class TimingLog(_Log):
    """Appends records to a run's ``timings.jsonl`` and TensorBoard; arguments as above."""

    def __init__(self, path: Path, tensorboard_dir: Path, purge_after: int | None = None):
        super().__init__(path, _timing_bytes(path, purge_after), tensorboard_dir, purge_after)

    def write(self, env_steps: int, updates: int, values: Record) -> Record:
        """Appends a record of timings and returns it as written."""
        record = {"env_steps": env_steps, "updates": updates, **values}
        self._append("timing", record)
        return record


def _records(path: Path) -> Iterator[tuple[Record, int]]:
    """Records and where each ends, up to the first line that is none, as a crash may leave it."""
    end = 0
    for line in path.read_bytes().splitlines(keepends=True) if path.exists() else ():
        try:
            record = json.loads(line)
        except ValueError:
            return
        if not line.endswith(b"\n"):
            return
        end += len(line)
        yield record, end


def _timing_bytes(path: Path, keep_until: int | None) -> int:
    """Length of the whole records up to ``keep_until`` env steps; None: no record."""
    length = 0
    for record, end in _records(path) if keep_until is not None else ():
        if record["env_steps"] > keep_until:
            break
        length = end
    return length


def read_records(path: Path, kind: str | None = None) -> list[Record]:
    """The records of a JSONL file, all or of one kind; none where there is no file.

    A line that is being written, or whose end a crash took, is left out, with all after it.
    """
    return [record for record, _ in _records(path) if kind in (None, record.get("kind"))]


def rank(evaluation: Record) -> tuple[bool, float]:
    """Greater is better. Episodes that were cut off look good where rewards are negative."""
    return not evaluation.get("bad_physics"), evaluation["return_mean"]


def write_csv(records: list[Record], kind: str, path: Path) -> None:
    """Writes the records of one kind as CSV, a column for each name in the order they come."""
    rows = [{k: v for k, v in record.items() if k != "kind"} for record in records]
    rows = [row for row, record in zip(rows, records, strict=True) if record["kind"] == kind]
    columns = list(dict.fromkeys(name for row in rows for name in row))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)

"""The metric files: appending, JSON values, cutting back on resume, reading."""

from __future__ import annotations

import errno
import json
import math
import threading
import warnings
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from tensorboardX.event_file_writer import EventsWriter

from sacformer_jax.logging import MetricLog, TimingLog, plain, read_records, write_csv


def _open(folder: Path, **kwargs: Any) -> MetricLog:
    return MetricLog(folder / "metrics.jsonl", folder / "tensorboard", **kwargs)


def _open_timings(folder: Path, purge_after: int | None = None) -> TimingLog:
    return TimingLog(folder / "timings.jsonl", folder / "tensorboard" / "timings", purge_after)


def _lines(path: Path) -> list[dict[str, Any]]:
    # Standard JSON: NaN and Infinity are not.
    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} in {path.name}")

    return [json.loads(line, parse_constant=refuse) for line in path.read_text().splitlines()]


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (None, None),
        ("text", "text"),
        (3, 3),
        (2.5, 2.5),
        (math.nan, None),
        (math.inf, None),
        (-math.inf, None),
        (np.float32(0.5), 0.5),
        (np.float32(np.nan), None),
        (np.float64(-np.inf), None),
        (np.int64(7), 7),
        (np.array(1.25), 1.25),
        (np.array([4]), 4),
        (jnp.float32(1.5), 1.5),
        (jnp.array(jnp.nan), None),
        (jnp.array(jnp.inf), None),
        (jnp.int32(-2), -2),
        (jnp.array(True), True),
    ],
    ids=repr,
)
def test_plain(value: Any, expected: Any) -> None:
    converted = plain(value)
    assert converted == expected
    assert type(converted) is type(expected)


def test_plain_refuses_an_array_of_many() -> None:
    with pytest.raises(ValueError, match=r"size|item"):
        plain(np.zeros(2))


def test_records_are_appended_as_json_lines(tmp_path: Path) -> None:
    log = _open(tmp_path)
    first = log.write("train", 100, 50, {"loss": jnp.float32(0.5), "mean": jnp.float32(jnp.nan)})
    second = log.write("eval", 200, 150, {"return_mean": np.float64(-3.5), "episodes": 4})
    log.close()
    assert first == {"kind": "train", "env_steps": 100, "updates": 50, "loss": 0.5, "mean": None}
    assert _lines(tmp_path / "metrics.jsonl") == [first, second]
    assert list(second) == ["kind", "env_steps", "updates", "return_mean", "episodes"]
    assert (tmp_path / "metrics.jsonl").read_bytes().endswith(b"\n")


def test_a_record_is_on_disk_at_once(tmp_path: Path) -> None:
    log = _open(tmp_path)
    record = log.write("eval", 1, 0, {"return_mean": 1.0})
    timings = _open_timings(tmp_path)
    timings.write(1, 0, {"chunk_seconds": 0.5})
    assert _lines(tmp_path / "metrics.jsonl") == [record]
    assert _lines(tmp_path / "timings.jsonl") == [
        {"env_steps": 1, "updates": 0, "chunk_seconds": 0.5}
    ]
    log.close()
    timings.close()


def test_metrics_bytes_counts_everything_written(tmp_path: Path) -> None:
    log = _open(tmp_path)
    assert log.num_bytes == 0
    log.write("train", 1, 1, {"loss": 1.0})
    one = log.num_bytes
    assert one == (tmp_path / "metrics.jsonl").stat().st_size > 0
    log.write("train", 2, 2, {"loss": 1.0})
    assert log.num_bytes == 2 * one
    log.close()


def test_resuming_cuts_the_metrics_back_and_goes_on_after(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    log = _open(tmp_path)
    kept = log.write("eval", 100, 0, {"return_mean": 1.0})
    keep_bytes = log.num_bytes
    log.write("eval", 200, 0, {"return_mean": 2.0})
    log.close()
    path.write_bytes(path.read_bytes() + b'{"kind": "train", "env_st')  # killed while writing

    log = _open(tmp_path, keep_bytes=keep_bytes, purge_after=100)
    assert (log.num_bytes, log.lost_bytes) == (keep_bytes, 0)
    again = log.write("eval", 200, 0, {"return_mean": 3.0})
    log.close()
    assert _lines(path) == [kept, again]


@pytest.mark.parametrize("left", ["nothing", "a part", "zeros"])
def test_a_file_that_lost_its_end_goes_on_after_its_last_whole_record(
    tmp_path: Path, left: str
) -> None:
    path = tmp_path / "metrics.jsonl"
    log = _open(tmp_path)
    first = log.write("eval", 100, 0, {"return_mean": 1.0})
    one = log.num_bytes
    log.write("eval", 200, 0, {"return_mean": 2.0})
    keep_bytes = log.num_bytes
    log.close()
    content = path.read_bytes()
    path.unlink()
    if left == "a part":
        path.write_bytes(content[: keep_bytes - 5])
    elif left == "zeros":  # as some file systems leave it when the power fails
        path.write_bytes(content[:one] + bytes(keep_bytes - one))

    log = _open(tmp_path, keep_bytes=keep_bytes, purge_after=200)
    kept = [] if left == "nothing" else [first]
    assert log.num_bytes == one * len(kept)
    assert log.lost_bytes == keep_bytes - log.num_bytes
    after = log.write("eval", 300, 0, {"return_mean": 3.0})
    log.close()
    assert _lines(path) == [*kept, after]


def test_a_new_log_empties_what_lay_there(tmp_path: Path) -> None:
    (tmp_path / "metrics.jsonl").write_text("left over\n")
    log = _open(tmp_path)
    record = log.write("train", 1, 1, {})
    log.close()
    assert _lines(tmp_path / "metrics.jsonl") == [record]


@pytest.mark.parametrize("end", [b'{"env_st', bytes(9), bytes(9) + b"\n"], ids=repr)
@pytest.mark.parametrize(
    ("purge_after", "kept"), [(None, []), (1, [1]), (2, [1, 2]), (9, [1, 2, 3])]
)
def test_timings_are_cut_back_to_where_the_run_goes_on(
    tmp_path: Path, purge_after: int | None, kept: list[int], end: bytes
) -> None:
    path = tmp_path / "timings.jsonl"
    log = _open_timings(tmp_path)
    for env_steps in (1, 2, 3):
        log.write(env_steps, 0, {"chunk_seconds": 0.5})
    log.close()
    path.write_bytes(path.read_bytes() + end)

    log = _open_timings(tmp_path, purge_after)
    log.write(9, 0, {"chunk_seconds": 0.5})
    log.close()
    assert [line["env_steps"] for line in _lines(path)] == [*kept, 9]


def test_tensorboard_holds_the_scalars(tmp_path: Path) -> None:
    log = _open(tmp_path)
    log.write("eval", 100, 0, {"return_mean": 1.0})
    log.close()
    timings = _open_timings(tmp_path)
    timings.write(100, 0, {"chunk_seconds": 0.5})
    timings.close()
    for folder, tag in (("", b"eval/return_mean"), ("timings", b"timing/chunk_seconds")):
        # One file in each folder: TensorBoard follows one at a time.
        (events,) = (f for f in (tmp_path / "tensorboard" / folder).iterdir() if f.is_file())
        assert tag in events.read_bytes()
        assert b"env_steps" not in events.read_bytes()  # it is the axis


def test_a_disk_that_is_full_costs_tensorboard_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its thread dies of that, and everything else would wait for it for good."""

    def full(writer: EventsWriter, event: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    log = _open(tmp_path)
    events = log._events._writer.file_writer.event_writer
    monkeypatch.setattr(threading, "excepthook", lambda hook: None)
    monkeypatch.setattr(EventsWriter, "write_event", full)

    def write_until_it_is_seen() -> None:
        log.write("train", 0, 0, {"critic_loss": 0.0})  # by now it may be dead already
        events._worker.join(20)
        log.write("train", 1, 1, {"critic_loss": 1.0})

    with pytest.warns(UserWarning, match="TensorBoard: .*cannot be written"):
        write_until_it_is_seen()
    with warnings.catch_warnings(action="error"):  # that is said once
        for step in range(2, 50):
            log.write("train", step, step, {"critic_loss": float(step)})
        log.close()
    assert len(_lines(tmp_path / "metrics.jsonl")) == 50


def test_a_folder_that_tensorboard_cannot_have(tmp_path: Path) -> None:
    (tmp_path / "tensorboard").write_text("in the way")
    with pytest.warns(UserWarning, match="TensorBoard: .*cannot be written"):
        log = _open(tmp_path, settings={"tau": 0.1})
    log.write("train", 1, 1, {"critic_loss": 1.0})
    log.close()
    assert len(_lines(tmp_path / "metrics.jsonl")) == 1


def test_read_records_by_kind(tmp_path: Path) -> None:
    log = _open(tmp_path)
    train = log.write("train", 1, 1, {"loss": 2.0})
    evaluation = log.write("eval", 1, 1, {"return_mean": 2.0})
    later = log.write("train", 2, 2, {"loss": 1.0})
    log.close()
    path = tmp_path / "metrics.jsonl"
    assert read_records(path) == [train, evaluation, later]
    assert read_records(path, "train") == [train, later]
    assert read_records(path, "eval") == [evaluation]
    assert read_records(path, "other") == []


def test_tensorboard_has_the_settings(tmp_path: Path) -> None:
    settings = {"env": "Hopper", "discount": 0.99, "tune_alpha": True, "target_entropy": None}
    log = _open(tmp_path, settings=settings)
    log.write("eval", 100, 0, {"return_mean": 1.0})
    log.close()
    (events,) = (tmp_path / "tensorboard").iterdir()
    content = events.read_bytes()
    for words in (b"_hparams_/session_start_info", b"tune_alpha", b"Hopper", b"target_entropy"):
        assert words in content
    assert np.float64(0.99).tobytes() in content
    assert content.count(b"eval/return_mean") == 2  # as the metric of the page, and its value


def test_csv_has_a_column_for_each_name_and_nothing_for_null(tmp_path: Path) -> None:
    log = _open(tmp_path)
    log.write("eval", 0, 0, {"return_mean": -3.25})
    log.write("train", 100, 50, {"loss": 0.1 + 0.2, "mean": math.nan})
    log.write("train", 200, 90, {"loss": 2.0, "mean": 1.0, "more": 7})
    log.close()
    write_csv(read_records(tmp_path / "metrics.jsonl"), "train", tmp_path / "train.csv")
    assert (tmp_path / "train.csv").read_text().splitlines() == [
        "env_steps,updates,loss,mean,more",
        "100,50,0.30000000000000004,,",
        "200,90,2.0,1.0,7",
    ]

"""Reports: what is read from a run's folder, and a page that needs nothing else."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import xml.etree.ElementTree as ET
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sacformer_jax import CheckpointError, Config, ConfigError, cli, report
from sacformer_jax.envs import EnvSpec
from sacformer_jax.logging import Record, read_records
from sacformer_jax.members import seed_members
from sacformer_jax.report.reading import read_run
from sacformer_jax.run_folder import RunFolder, labels
from sacformer_jax.runner import sources_of

SPEC = EnvSpec("Hopper", 11, 3, (-1.0,) * 3, (1.0,) * 3, 1000, "native", "a test")


def _lines(path: Path, records: list[Record]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(json.dumps(record) + "\n" for record in records))


def _eval(env_steps: int, mean: float) -> Record:
    return {
        "kind": "eval", "env_steps": env_steps, "updates": 0, "episodes": 4, "return_mean": mean,
        "return_std": 2.0, "return_min": mean - 3, "return_max": mean + 3, "length_mean": 100.0,
    }  # fmt: skip


def _train(env_steps: int, **values: Any) -> Record:
    return {"kind": "train", "env_steps": env_steps, "updates": env_steps, **values}


def _timing(env_steps: int, speed: float, wall: float) -> Record:
    return {
        "env_steps": env_steps, "updates": env_steps, "chunk_seconds": 1.0,
        "steps_per_second": speed, "ms_per_update": 1.0, "wall_seconds": wall,
    }  # fmt: skip


def _run(path: Path, seeds: int = 1, **fields: Any) -> RunFolder:
    """A run's folder with made-up metrics: 3 evaluations, 2 chunks, resumed once."""
    config = Config.from_preset("cpu", env="Hopper", seeds=seeds, total_env_steps=5_000, **fields)
    folder, members = RunFolder(path), seed_members(config.all_seeds)
    folder.create(config, sources_of(config), SPEC, members)
    for index, member in enumerate(members):
        records = [
            _eval(1_000, 10.0 + index),
            _train(2_000, critic_loss=4.0 + index, bad_physics=1, skipped_updates=index),
            _eval(2_000, 20.0 + 4 * index),
            _train(3_000, critic_loss=None, bad_physics=2, skipped_updates=0),
            _eval(3_000, 15.0 + 10 * index),
        ]
        _lines(folder.metrics_path(member.name), records)
    timings = [_timing(2_000, 100.0, 12.0), _timing(3_000, 300.0, 5.0)]
    _lines(folder.timings_path, timings)
    return folder


class _Page(HTMLParser):
    """What a page refers to and says."""

    def __init__(self, text: str):
        super().__init__()
        self.sources: list[str] = []
        self.cells: list[str] = []
        self.words, self._in_cell = "", False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.sources += [value or "" for name, value in attrs if name in ("src", "href")]
        self._in_cell = tag == "td"

    def handle_data(self, data: str) -> None:
        self.words += data
        if self._in_cell:
            self.cells.append(data)


# --- what is read --------------------------------------------------------------------------------


def test_a_run_is_read_with_its_counters(tmp_path: Path) -> None:
    folder = _run(tmp_path / "run", seeds=2)
    (folder.path / "damaged" / "2000").mkdir(parents=True)
    fault = {"first_tensor_not_finite": "critic_loss"}
    (folder.member_path("seed-1") / "fault.json").write_text(json.dumps(fault))
    run = read_run(folder.path, "run")
    assert (run.env_steps, run.steps_per_second, run.stretches) == (3_000, 200.0, 2)
    # Its clock began anew when it was resumed.
    assert run.training_seconds.tolist() == [12.0, 17.0]
    faults = run.faults
    assert (faults.bad_physics, faults.skipped_updates, faults.damaged_checkpoints) == (6, 1, 1)
    assert faults.given_up == {"seed-1": "critic_loss"}
    assert faults.total == 9


def test_the_interval_over_members_is_the_bootstrap_of_their_mean(tmp_path: Path) -> None:
    curve = read_run(_run(tmp_path / "run", seeds=2).path, "run").curve()
    assert curve is not None
    assert curve.env_steps.tolist() == [1_000, 2_000, 3_000]
    assert curve.mean.tolist() == [10.5, 22.0, 20.0]
    # Of two members a quarter of the samples holds one of them only.
    assert curve.low.tolist() == [10.0, 20.0, 15.0]
    assert curve.high.tolist() == [11.0, 24.0, 25.0]
    assert "2 members" in curve.interval


def test_the_interval_of_one_member_is_that_of_its_episodes(tmp_path: Path) -> None:
    curve = read_run(_run(tmp_path / "run").path, "run").curve()
    assert curve is not None
    np.testing.assert_array_equal(curve.high - curve.mean, 2.0)
    np.testing.assert_array_equal(curve.mean - curve.low, 2.0)
    assert "episodes" in curve.interval


def test_members_are_compared_where_all_were_evaluated(tmp_path: Path) -> None:
    folder = _run(tmp_path / "run", seeds=2)
    _lines(folder.metrics_path("seed-1"), [_eval(1_000, 11.0), _eval(3_000, 25.0)])
    curve = read_run(folder.path, "run").curve()
    assert curve is not None
    assert curve.env_steps.tolist() == [1_000, 3_000]


def test_a_line_being_written_is_left_out(tmp_path: Path) -> None:
    folder = _run(tmp_path / "run")
    path = folder.metrics_path("seed-0")
    whole = path.read_text()
    for end in ('{"kind": "eval", "env_st', "\0\0\0", "\0\0\0\n"):  # or lost in a power cut
        path.write_text(whole + end)
        assert read_records(path)[-1]["env_steps"] == 3_000
    assert read_run(folder.path, "run").env_steps == 3_000


def test_labels_are_as_short_as_they_can_be() -> None:
    assert labels(["/a/x", "/a/y"]) == ["x", "y"]
    assert labels(["/a/b/x", "/a/c/x"]) == ["b/x", "c/x"]
    assert labels(["/a/x", "/x"]) == ["a/x", "x"]
    with pytest.raises(ConfigError, match="'/a/x' was given twice"):
        labels(["/a/x", "/a/y", "/a/x"])


# --- the page ------------------------------------------------------------------------------------


def test_the_page_needs_nothing_else(tmp_path: Path) -> None:
    folder = _run(tmp_path / "run")
    (folder.path / "videos").mkdir()
    (folder.path / "videos" / "step_2000.mp4").write_bytes(b"a video")
    (folder.path / "videos" / ".step_3000.new.mp4").write_bytes(b"half of one")
    text = report([folder.path]).read_text()
    page = _Page(text)
    assert all(source.startswith("data:") for source in page.sources)
    assert "http" not in text.replace("http-equiv", "")
    kinds = [source.split(";")[0] for source in page.sources]
    assert kinds.count("data:image/svg+xml") == 3
    (video,) = (source for source in page.sources if source.startswith("data:video/mp4"))
    assert base64.b64decode(video.split(",")[1]) == b"a video"
    for source in page.sources:
        if source.startswith("data:image"):
            root = ET.fromstring(base64.b64decode(source.split(",")[1]))
            assert root.tag.endswith("svg")
            assert len(list(root.iter())) > 50


def test_several_runs_are_told_apart(tmp_path: Path) -> None:
    paths = [
        _run(tmp_path / "one", batch_size=64).path,
        _run(tmp_path / "<b>two", batch_size=32, seeds=2).path,
    ]
    path = report(paths, tmp_path / "both.html")
    assert path == tmp_path / "both.html"
    text = path.read_text()
    assert "<b>two" not in text  # names are text, not HTML
    cells = _Page(text).cells
    place = cells.index("batch_size")
    assert cells[place : place + 3] == ["batch_size", "64", "32"]
    differing = text[text.index("<h2>Differences") : text.index("<details>")]
    assert "batch_size" in differing
    assert "discount" not in differing
    assert "15.0 [13.0, 17.0]" in cells  # the last evaluation of the first
    assert "20.0 [15.0, 25.0]" in cells


def test_a_run_that_has_only_begun_has_a_page(tmp_path: Path) -> None:
    folder = _run(tmp_path / "run")
    folder.metrics_path("seed-0").unlink()
    folder.timings_path.unlink()
    text = report([folder.path]).read_text()
    assert text.count("Nothing yet.") == 3


@pytest.mark.parametrize(
    ("runs", "to", "error", "message"),
    [
        ([], None, ConfigError, "at least one run"),
        (["run", "run"], None, ConfigError, "given twice"),
        (["none"], None, CheckpointError, "no config.json there"),
        (["run"], "missing/report.html", ConfigError, "cannot be written"),
    ],
)
def test_bad_input_is_refused(
    tmp_path: Path, runs: list[str], to: str | None, error: type[Exception], message: str
) -> None:
    _run(tmp_path / "run")
    with pytest.raises(error, match=message):
        report([tmp_path / run for run in runs], None if to is None else tmp_path / to)


def test_the_command_writes_into_the_folder_of_a_single_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = _run(tmp_path / "run")
    assert cli.main(["report", str(folder.path)]) == 0
    assert str(folder.path / "report.html") in capsys.readouterr().out
    assert (folder.path / "report.html").stat().st_size > 10_000
    assert cli.main(["report", str(tmp_path / "nothing")]) == cli.EXIT_BAD_INPUT


@pytest.mark.skipif(shutil.which("chromium") is None, reason="chromium is not installed")
def test_a_browser_draws_it(tmp_path: Path) -> None:
    folder = _run(tmp_path / "run", seeds=2)
    page = report([folder.path])
    command = ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--dump-dom"]
    probe = (
        "<script>document.title = [...document.images].map("
        "image => image.complete && image.naturalWidth > 500).join()</script>"
    )
    page.write_text(page.read_text().replace("</html>", probe + "</html>"))
    done = subprocess.run(
        [*command, f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=5000",
         page.as_uri()],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert "<title>true,true,true</title>" in done.stdout

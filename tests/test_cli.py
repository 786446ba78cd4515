"""The command line: help, parsing, refusals, and whole runs."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path

import jax
import pytest

from sacformer_jax import Config, cli
from sacformer_jax.checkpoint import RunFolder
from sacformer_jax.cli import EXIT_BAD_INPUT, EXIT_INTERRUPTED, main
from sacformer_jax.config import field_places
from sacformer_jax.envs import EnvSpec
from sacformer_jax.launch import Launch
from sacformer_jax.members import seed_members
from sacformer_jax.presets import resolve
from sacformer_jax.runner import sources_of
from sacformer_jax.tracking import Tracking

STOP = 400
HUGE = 1_000_000
# SAC's networks compile fastest.
TINY = {
    "agent": "sac", "env": "Hopper", "num_envs": 2, "max_episode_steps": 50,
    "prefill_env_steps": 200, "chunk_env_steps": 100, "eval_every": 100, "eval_episodes": 2,
    "checkpoint_every": HUGE, "actor_width": 8, "actor_layers": 1, "critic_width": 8,
    "batch_size": 4, "buffer_capacity": 2000, "updates_per_env_step": 1.0, "seed": 3,
}  # fmt: skip
WATCHDOG_SECONDS = 500


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")


def _flags(fields: dict[str, object]) -> list[str]:
    return [part for name, value in fields.items() for part in (_flag(name), str(value))]


@dataclasses.dataclass(frozen=True)
class Said:
    """What a command answered."""

    code: object
    out: str
    err: str


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]):
    """Runs a command in this process."""

    def call(*args: object) -> Said:
        capsys.readouterr()
        try:
            code: object = main([str(arg) for arg in args])
        except SystemExit as stopped:  # the parser of flags leaves like this
            code = stopped.code
        return Said(code, *capsys.readouterr())

    return call


def _assert_refused(said: Said, *mentioned: object) -> None:
    """Exit code 2 and one line on stderr that says why."""
    assert said.code == EXIT_BAD_INPUT == 2
    assert said.out == ""
    assert said.err.startswith("error: ")
    assert said.err.count("\n") == 1
    assert said.err.endswith("\n")
    for text in mentioned:
        assert str(text) in said.err


# --- help and describe -------------------------------------------------------------------------


def _squeezed(text: str) -> str:
    """Text without the space, line breaks and boxes that only lay it out."""
    return re.sub(r"[\s│╭╮╰╯─]", "", text)


def test_help_of_train_has_every_field(run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    said = run("train", "--help")
    assert said.code == 0
    places = field_places()
    entries = re.findall(r"^[\s│]*(--[a-z][a-z-]*)", said.out, re.MULTILINE)
    others = {
        _flag(field.name) for kind in (Launch, Tracking) for field in dataclasses.fields(kind)
    }
    assert sorted(entries) == sorted({_flag(name) for name in places} | others)
    text = _squeezed(said.out)
    flat = Config.from_preset("cpu").flat()
    for name in places:
        start = text.index(_squeezed(f"{_flag(name)}"))
        default = repr(flat[name]) if flat[name] == "" else str(flat[name])
        # What stands between the flag and its default: what it takes, and a sentence.
        described = text[start : text.index(f"(default:{default})", start)]
        assert 10 < len(described) - len(_flag(name)) < 200, name
        assert described.count("(default:") == 0, name


def test_help_has_the_promised_flags(run) -> None:
    out = run("train", "--help").out
    for flag in (
        "--preset", "--env", "--engine", "--agent", "--seed", "--total-env-steps", "--num-envs",
        "--updates-per-env-step", "--eval-every", "--checkpoint-every", "--run-dir",
    ):  # fmt: skip
        assert re.search(rf"^[\s│]*{flag} ", out, re.MULTILINE), flag


@pytest.mark.parametrize(
    ("command", "flags"),
    [
        ("resume", ["--total-env-steps"]),
        ("evaluate", ["--gymnasium", "--episodes", "--policy", "--seed", "--json"]),
    ],
)
def test_help_of_other_commands(run, command: str, flags: list[str]) -> None:
    said = run(command, "--help")
    assert said.code == 0
    for flag in flags:
        assert flag in said.out


def test_without_arguments_the_commands_are_listed(run) -> None:
    said, asked = run(), run("--help")
    assert said.code == EXIT_BAD_INPUT
    assert asked.code == 0
    for command in ("train", "resume", "evaluate", "describe"):
        assert re.search(rf"^  {command} ", said.out, re.MULTILINE)
    assert asked.out == said.out


def _described(out: str) -> dict[str, tuple[str, str]]:
    """Value and source by field, from the table of ``describe``."""
    rows = {}
    for line in out.splitlines():
        name, value, source = line[:24].strip(), line[24:40].strip(), line[40:].strip()
        rows[name] = (value, source)
    return rows


def test_describe_prints_every_field_with_its_source(run) -> None:
    said = run("describe", "--env", "Hopper", "--num-envs", "3", "--tau=0.01", "--no-tune-alpha")
    assert said.code == 0
    rows = _described(said.out)
    assert list(rows) == list(field_places())
    given = {"env": "Hopper", "num_envs": "3", "tau": "0.01", "tune_alpha": "False"}
    for name, value in given.items():
        assert rows[name] == (value, "command line")
    assert all(source for _, source in rows.values())
    preset = resolve("cpu", {"env": "Hopper"})
    for name in set(rows) - set(given):
        assert rows[name][1] == preset.sources[name]
        assert rows[name][0] == (str(preset.config.flat()[name]) or "''")


def test_describe_json(run) -> None:
    said = run("describe", "--preset", "paper", "--env=Humanoid", "--json", "--seed", 5)
    assert said.code == 0
    described = json.loads(said.out)
    config = Config.from_dict(described["config"])
    assert config == Config.from_preset("paper", env="Humanoid", seed=5)
    assert (config.learning.alpha, config.context.context_length) == (0.05, 10)
    assert set(described["sources"]) == set(field_places())
    assert described["sources"]["seed"] == "command line"
    assert described["sources"]["alpha"] == "authors' program: alpha 0.05 on Humanoid"


@pytest.mark.parametrize(
    ("args", "fields"),
    [
        ([], {}),
        (["--agent", "sac", "--preset", "paper"], {"agent": "sac", "preset": "paper"}),
        (["--env", "Humanoid", "--alpha", "0.3"], {"env": "Humanoid", "alpha": 0.3}),
        (["--total_env_steps", "50000"], {"total_env_steps": 50_000}),
        (["--target-entropy", "-2"], {"target_entropy": -2.0}),
        (["--normalize-obs"], {"normalize_obs": True}),
        (["--run-dir", "a b/ä"], {"run_dir": "a b/ä"}),
        (["--return-conditioning", "none"], {"return_conditioning": "none"}),
    ],
    ids=str,
)
def test_flags_mean_the_same_as_in_python(run, args: list[str], fields: dict) -> None:
    said = run("describe", "--json", *args)
    assert said.code == 0
    config = Config.from_dict(json.loads(said.out)["config"])
    assert config == Config.from_preset(**{"preset": "cpu", **fields})


# --- refusals ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("args", "mentioned"),
    [
        (["frobnicate"], "'frobnicate'"),
        (["--verbose"], "'--verbose'"),
        (["train", "--num-envs", "0"], "num_envs=0"),
        (["train", "--tau", "nan"], "tau=nan"),
        (["train", "--target-return", "1e400"], "target_return=inf"),
        (["train", "--preset", "gpu"], "preset='gpu'"),
        (["train", "--agent", "td4"], "agent='td4'"),
        (["train", "--agent", "sac", "--context-length", "6"], "context_length=6"),
        (["train", "--total-env-steps", "100"], "total_env_steps=100"),
        (["describe", "--actor-heads", "3"], "actor_heads=3"),
    ],
    ids=str,
)
def test_bad_settings_are_refused_in_a_line(
    run, args: list[str], mentioned: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # where `runs/` would be made
    _assert_refused(run(*args), mentioned)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("args", "mentioned"),
    [
        (["train", "--num-env", "3"], "--num-env"),
        (["train", "--num-envs", "four"], "four"),
        (["train", "--num-envs"], "--num-envs"),
        (["train", "--engine", "warp"], "warp"),
        (["train", "stray"], "stray"),
        (["describe", "--tune-alpha", "maybe"], "maybe"),
        (["resume"], "PATH"),
        (["resume", "somewhere", "--total-env-steps", "many"], "many"),
        (["evaluate", "somewhere", "--episodes", "few"], "few"),
        (["evaluate", "somewhere", "--video"], "--video"),
        (["evaluate", "somewhere", "--policy", "worst"], "worst"),
    ],
    ids=str,
)
def test_wrong_flags_are_refused(
    run, args: list[str], mentioned: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    said = run(*args)
    assert said.code == EXIT_BAD_INPUT
    assert said.out == ""
    assert mentioned in said.err
    assert "Traceback" not in said.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "args",
    [
        ["resume"],
        ["resume", "--total-env-steps", "900"],
        ["evaluate"],
        ["evaluate", "--gymnasium", "--json"],
        ["describe"],
        ["describe", "--json"],
    ],
    ids=str,
)
def test_paths_that_are_no_run_are_refused(run, args: list[str], tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("not a run")
    before = sorted(tmp_path.rglob("*"))
    for name in ("missing", "empty", "file"):
        path = tmp_path / name
        _assert_refused(run(args[0], path, *args[1:]), path, "config.json")
    assert sorted(tmp_path.rglob("*")) == before


@pytest.fixture
def run_without_checkpoint(tmp_path: Path) -> Path:
    config = Config.from_preset("cpu", **TINY)
    spec = EnvSpec("Hopper", 11, 3, (-1.0,) * 3, (1.0,) * 3, 1000, "native", "test", "Hopper-v5")
    RunFolder(tmp_path / "run").create(config, sources_of(config), spec, seed_members([0]))
    return tmp_path / "run"


@pytest.mark.parametrize(
    ("command", "flags", "mentioned"),
    [
        ("evaluate", [], "no best policy yet"),
        ("evaluate", ["--policy", "latest"], "no latest policy yet"),
        ("evaluate", ["--episodes", "0"], "episodes=0"),
    ],
)
def test_a_run_without_checkpoint_is_refused(
    run, run_without_checkpoint: Path, command: str, flags: list[str], mentioned: str
) -> None:
    _assert_refused(run(command, run_without_checkpoint, *flags), mentioned)


def test_a_run_without_checkpoint_is_described_all_the_same(
    run, run_without_checkpoint: Path
) -> None:
    said = run("describe", run_without_checkpoint, "--json")
    assert said.code == 0
    described = json.loads(said.out)
    assert Config.from_dict(described["config"]) == Config.from_preset("cpu", **TINY)
    assert described["counters"] is None
    assert described["digest"] is None


def test_a_damaged_run_is_refused(run, run_without_checkpoint: Path) -> None:
    (run_without_checkpoint / "config.json").write_text("{")
    for command in ("resume", "evaluate", "describe"):
        _assert_refused(run(command, run_without_checkpoint), "config.json", "damaged")


def test_a_run_is_not_trained_over(
    run, run_without_checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # As if it had a checkpoint; tests/test_runs.py does the same with a real one.
    monkeypatch.setattr(RunFolder, "latest_step", lambda self: STOP)
    said = run("train", *_flags(TINY), "--run-dir", run_without_checkpoint)
    _assert_refused(said, f"sacformer resume {run_without_checkpoint}")


# --- whole runs ----------------------------------------------------------------------------------


class Command:
    """A ``sacformer`` command running in its own process; killed if it hangs.

    Its standard error goes to a file, so that no full pipe can stop it.
    """

    def __init__(self, folder: Path, *args: object):
        self._stderr = folder / f"{len(list(folder.iterdir()))}.stderr"
        with self._stderr.open("w") as stderr:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "sacformer_jax.cli", *(str(arg) for arg in args)],
                stdout=subprocess.PIPE,
                stderr=stderr,
                text=True,
                cwd=folder,
            )
        self._watchdog = threading.Timer(WATCHDOG_SECONDS, self.process.kill)
        self._watchdog.daemon = True
        self._watchdog.start()
        self._lines: list[str] = []

    def read_until(self, text: str) -> None:
        """Blocks until a line with ``text`` is printed."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._lines.append(line)
            if text in line:
                return
        pytest.fail(f"{text!r} was not printed; stderr: {self._stderr.read_text()}")

    def stop(self) -> None:
        """Ends it if it still runs."""
        self._watchdog.cancel()
        self.process.kill()
        self.process.wait()

    def wait(self) -> Said:
        rest, _ = self.process.communicate()
        self._watchdog.cancel()
        return Said(self.process.returncode, "".join(self._lines) + rest, self._stderr.read_text())


@dataclasses.dataclass(frozen=True)
class Runs:
    """Two equal runs, one that ended at ``STOP`` and one, a process of its own, stopped by Ctrl-C;
    then both resumed.

    Attributes:
      folder: where they are, as ``ended`` and ``stopped``.
      trained: what `train` said of each.
      stopped_at: environment steps of the stopped one.
      resumed: what `resume` said of each.
      total: environment steps after resuming.
    """

    folder: Path
    trained: dict[str, Said]
    stopped_at: int
    resumed: dict[str, Said]
    total: int


def _here(*args: object) -> Said:
    """What a command answers in this process."""
    with (
        contextlib.redirect_stdout(io.StringIO()) as out,
        contextlib.redirect_stderr(io.StringIO()) as err,
    ):
        code = main([str(arg) for arg in args])
    return Said(code, out.getvalue(), err.getvalue())


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Runs:
    folder = tmp_path_factory.mktemp("cli")

    def training(name: str, total: int) -> tuple[object, ...]:
        return "train", *_flags(TINY), "--run-dir", folder / name, "--total-env-steps", total

    ended = _here(*training("ended", STOP))
    stopping = Command(tmp_path_factory.mktemp("logs"), *training("stopped", HUGE))
    try:
        stopping.read_until("eval return")
        stopping.process.send_signal(signal.SIGINT)
        trained = {"ended": ended, "stopped": stopping.wait()}
    finally:
        stopping.stop()
    stopped_at = RunFolder(folder / "stopped").latest_step()
    assert stopped_at is not None, trained["stopped"].err
    total = max(stopped_at, STOP) + 100
    resumed = {name: _here("resume", folder / name, "--total-env-steps", total) for name in trained}
    return Runs(folder, trained, stopped_at, resumed, total)


def test_ctrl_c_saves_and_says_how_to_go_on(runs: Runs) -> None:
    said = runs.trained["stopped"]
    assert said.code == EXIT_INTERRUPTED == 3
    assert "Traceback" not in said.err
    assert f"sacformer resume {runs.folder / 'stopped'}" in said.out
    assert f"stopped at {runs.stopped_at:,} env steps" in said.out
    assert (runs.folder / "stopped" / "checkpoints" / str(runs.stopped_at)).is_dir()
    # The signal may have come before the first chunk or within one, which is then finished.
    assert 200 <= runs.stopped_at < HUGE
    assert runs.stopped_at % 100 == 0


def test_train_and_resume_end_well(runs: Runs) -> None:
    for said in (runs.trained["ended"], runs.resumed["ended"], runs.resumed["stopped"]):
        assert said.code == 0, said.err
        assert "Traceback" not in said.err
    out = runs.trained["ended"].out
    for fact in (
        f"run          {runs.folder / 'ended'}",
        "Hopper: 11 observations, 3 actions, 2 environments",
        "agent        sac, preset cpu, seed 3",
        "engine       native",
        str(runs.folder / "ended" / "checkpoints" / str(STOP)),
        str(runs.folder / "ended" / "learning_curve.png"),
    ):
        assert fact in out
    assert "sacformer resume" not in out
    assert f"resuming at  {STOP} env steps" in runs.resumed["ended"].out
    assert f"resuming at  {runs.stopped_at:,} env steps" in runs.resumed["stopped"].out


def test_stopped_and_ended_runs_are_resumed_to_the_same(run, runs: Runs) -> None:
    described = []
    for name in ("ended", "stopped"):
        said = run("describe", runs.folder / name, "--json")
        assert said.code == 0
        described.append(json.loads(said.out))
    ended, stopped = described
    assert ended["digest"] == stopped["digest"]
    assert re.fullmatch(r"[0-9a-f]{64}", ended["digest"])
    assert ended["counters"] == stopped["counters"]
    assert ended["counters"]["env_steps"] == runs.total
    assert ended["counters"]["updates"] == runs.total - 200
    assert set(ended["counters"]) == {
        "env_steps", "updates", "skipped_updates", "first_fault", "episodes", "bad_physics",
    }  # fmt: skip
    assert ended["counters"]["first_fault"] is None
    metrics = [(runs.folder / name / "metrics.jsonl").read_bytes() for name in ("ended", "stopped")]
    assert metrics[0] == metrics[1]


def test_describe_a_run(run, runs: Runs) -> None:
    path = runs.folder / "ended"
    said = run("describe", path, "--json")
    described = json.loads(said.out)
    expected = {**TINY, "run_dir": str(path), "total_env_steps": STOP}
    given = resolve("cpu", expected).config
    assert Config.from_dict(described["config"]) == given
    assert described["sources"]["num_envs"] == "command line"
    assert described["sources"]["tau"].startswith("default")
    table = run("describe", path).out
    for name, value in described["counters"].items():
        shown = str(value) if value is None else f"{value:,}"
        assert re.search(rf"^{name} +{shown}$", table, re.MULTILINE)
    assert described["digest"] in table
    assert [line.split()[0] for line in table.splitlines()][: len(given.flat())] == [*given.flat()]


def test_evaluate_in_gymnasium_prints_one_json_line(runs: Runs, tmp_path: Path) -> None:
    said = Command(
        tmp_path, "evaluate", runs.folder / "ended", "--gymnasium", "--episodes", 2, "--json"
    ).wait()
    assert said.code == 0, said.err
    assert said.out.count("\n") == 1
    record = json.loads(said.out)
    assert set(record) == {
        "env", "episodes", "return_mean", "return_std", "length_mean", "reward_forward",
        "reward_survive", "reward_ctrl",
    }  # fmt: skip
    assert record["env"] == "Hopper-v5"
    assert record["episodes"] == 2
    assert record["length_mean"] >= 1
    # The terms are means per step, and sum to the reward.
    terms = sum(record[name] for name in ("reward_forward", "reward_survive", "reward_ctrl"))
    assert terms * record["length_mean"] == pytest.approx(record["return_mean"], rel=1e-4)
    assert record["reward_ctrl"] <= 0


def test_evaluate_in_gymnasium_beside_random_actions(run, runs: Runs) -> None:
    said = run("evaluate", runs.folder / "ended", "--gymnasium", "--episodes", 1)
    assert said.code == 0
    title, policy, random = said.out.splitlines()
    assert title == "Hopper-v5, 1 episodes"
    assert re.match(r"  best policy +return +-?[\d.]+ ± 0.0 +length \d+", policy)
    assert re.match(r"  random actions +return +-?[\d.]+ ± 0.0 +length \d+", random)


def test_a_refusal_in_a_process(tmp_path: Path) -> None:
    said = Command(tmp_path, "resume", tmp_path / "missing").wait()
    _assert_refused(said, tmp_path / "missing")


def test_an_interrupted_host_call_ends_like_any_interrupt(monkeypatch, capsys):
    """XLA turns the KeyboardInterrupt into an error of its own; other errors stay errors."""

    def fails(message: str) -> None:
        def describe(args: list[str]) -> int:
            raise jax.errors.JaxRuntimeError(message)

        monkeypatch.setattr(cli, "_describe", describe)

    fails("INTERNAL: the host function failed:\nTraceback …\nKeyboardInterrupt\n")
    assert main(["describe"]) == cli.EXIT_KILLED
    assert "stopped at once" in capsys.readouterr().err
    fails("RESOURCE_EXHAUSTED: out of memory")
    with pytest.raises(jax.errors.JaxRuntimeError, match="out of memory"):
        main(["describe"])

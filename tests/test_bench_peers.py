"""The benchmark's peers: their programs' host and the comparison, with tiny programs."""

import functools
import sys
from pathlib import Path

import pytest
from bench.peer_programs import ours
from bench.peer_programs.host import PeerError, Program, ensure_venv
from bench.peer_programs.protocol import Setting
from bench.peers import CASES, ENVIRONMENT, PEERS, compare, requirements

SETTING = Setting("sac", "HalfCheetah", stretch_steps=100, cores=2)

# Its second argument: the seconds that it says a stretch took.
GOOD = """
import sys
from bench.peer_programs.protocol import Session

print("a library says hello")
session = Session()
session.ready("jax", "jaxlib", parameters=7)
while session.wanted():
    print("[1, 2]")  # JSON, but no answer
    steps = session.setting.stretch_steps
    session.report(steps, 2 * steps, float(sys.argv[2]))
"""
FAILS_AT_START = "import sys; print('a line', file=sys.stderr); raise ValueError('no such thing')"
FAILS_LATER = GOOD.replace('print("[1, 2]")', "sys.exit('out of memory')")
SILENT = "import time; time.sleep(60)"


def start(code: str, *arguments: str, limit_seconds: float = 10.0) -> Program:
    command = [sys.executable, "-c", code, SETTING.to_json(), *arguments]
    return Program(command, ENVIRONMENT, limit_seconds)


@pytest.fixture
def good():
    return lambda seconds: functools.partial(start, GOOD, str(seconds))


def test_setting_arrives_as_it_was_sent():
    assert Setting.from_json(SETTING.to_json()) == SETTING


def test_every_peer_is_compared_by_its_own_figures(good):
    results = compare({"slow": good(2.0), "fast": good(0.5), "ours": good(0.25)}, "peer.sac", 2)
    assert results["peer.sac.slow.steps_per_s"] == 50.0
    assert results["peer.sac.fast.steps_per_s"] == results["peer.sac.fast.steps_per_s_min"] == 200.0
    assert results["peer.sac.fast.updates_per_env_step"] == 2.0
    assert results["peer.sac.fast.parameters"] == 7
    assert {"peer.sac.fast.version", "peer.sac.fast.jaxlib_version"} <= set(results)
    assert results["peer.sac.fastest_peer"] == "fast"
    assert results["peer.sac.ours_over_fastest"] == 2.0


@pytest.mark.parametrize(
    ("code", "error"),
    [
        (FAILS_AT_START, "status 1: ValueError: no such thing"),
        (FAILS_LATER, "status 1: out of memory"),
    ],
)
def test_failing_peer_is_reported_and_stops_no_other(good, code, error):
    starts = {"bad": functools.partial(start, code, "1.0"), "good": good(1.0), "ours": good(1.0)}
    results = compare(starts, "peer.sac", 2)
    assert {key: value for key, value in results.items() if ".bad." in key} == {
        "peer.sac.bad.error": error
    }
    assert results["peer.sac.good.steps_per_s"] == 100.0
    assert results["peer.sac.ours_over_fastest"] == 1.0


def test_peer_that_cannot_be_set_up_is_reported(good):
    def no_network() -> Program:
        raise PeerError("setting up x: no such package")

    def no_python() -> Program:
        return Program(["./no-such-python"], {}, 1.0)

    results = compare({"a": no_network, "b": no_python, "ours": good(1.0)}, "peer.sac", 1)
    assert results["peer.sac.a.error"] == "setting up x: no such package"
    assert "no-such-python" in str(results["peer.sac.b.error"])
    assert results["peer.sac.ours.steps_per_s"] == 100.0
    assert "peer.sac.ours_over_fastest" not in results


def test_silent_program_is_stopped():
    program = start(SILENT, limit_seconds=0.5)
    with pytest.raises(PeerError, match="status -9"):
        program.answer()
    program.stop()


def test_environment_is_made_only_when_its_packages_change(tmp_path):
    made: list[list[str]] = []

    def install(venv: Path, packages) -> None:
        assert not venv.exists(), "the old one should be gone"
        venv.mkdir()
        made.append(list(packages))

    def broken(venv: Path, packages) -> None:
        venv.mkdir()
        raise PeerError("no such package")

    venv = tmp_path / "venvs" / "x"
    for packages in (["a==1"], ["a==1"], ["a==2"]):
        assert ensure_venv(venv, packages, install) == venv / "bin" / "python"
    assert made == [["a==1"], ["a==2"]]
    assert (venv.parent / ".gitignore").read_text() == "*\n"

    with pytest.raises(PeerError):
        ensure_venv(venv, ["a==3"], broken)
    ensure_venv(venv, ["a==3"], install)  # tried again: a half-made one does not count
    assert made[-1] == ["a==3"]


def test_every_peer_has_its_program_and_environment():
    folder = Path(ENVIRONMENT["PYTHONPATH"]) / "bench" / "peer_programs"
    for peer in PEERS.values():
        assert (folder / f"{peer.module}.py").is_file()
        assert peer.venv is None or peer.venv in requirements()


@pytest.mark.parametrize("name", CASES)
def test_every_case_is_our_preset_and_has_known_peers(name):
    case = CASES[name]
    assert set(case.peers) < set(PEERS)
    setting = case.setting()
    made = ours.config(setting)  # asserts that the preset has the setting's values
    assert made.agent == setting.agent
    if setting.agent == "ppo":  # a stretch is whole rollouts
        assert setting.stretch_steps % (setting.num_envs * setting.rollout_steps) == 0


def test_setting_that_is_not_our_preset_is_noticed():
    setting = Setting("td3", "HalfCheetah", stretch_steps=100, cores=2, policy_delay=3)
    with pytest.raises(AssertionError):
        ours.config(setting)

"""Exported policies equal ``Policy.predict``, in a process that cannot import this package."""

from __future__ import annotations

import json
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from policies import OBS, small_policy

from sacformer_jax import ConfigError, cli, export_policy
from sacformer_jax.acting_step import FORMAT_VERSION, ActingStep
from sacformer_jax.policy import Policy

LOADER = Path(__file__).parents[1] / "examples" / "run_exported.py"
STEPS, ENVS = 45, 3
CASES: dict[str, dict[str, Any]] = {
    "window": {},
    "episode": {"acting_context": "episode", "tokens": "gsa"},
    "joint": {"tokens": "joint", "time_embedding": "rotary"},
    "ppo": {"agent": "ppo"},
}

PROGRAM = """
import json, sys
for name in ("sacformer_jax", "flax", "brax", "optax", "orbax", "gymnasium", "mujoco"):
    sys.modules[name] = None  # importing it fails
sys.path.insert(0, sys.argv[1])
import numpy as np
from run_exported import load

inputs = np.load(sys.argv[3])
outputs = {}
for path in json.loads(sys.argv[2]):
    num_envs = inputs["obs"].shape[1]
    step, state, manifest = load(path, num_envs)
    actions = []
    for row in zip(inputs["obs"], inputs["start"], inputs["reward"]):
        action, state = step(row[0], state, row[1], row[2])
        actions.append(np.asarray(action))
    outputs[path] = np.stack(actions)
np.savez(sys.argv[4], **outputs)
assert sys.modules["sacformer_jax"] is None
"""


def _inputs() -> dict[str, np.ndarray]:
    """Of episodes that start at different steps."""
    rng = np.random.default_rng(0)
    start = rng.random((STEPS, ENVS)) < 0.05
    start[0] = True
    return {
        "obs": rng.normal(size=(STEPS, ENVS, OBS)).astype(np.float32),
        "reward": rng.normal(5.0, 20.0, (STEPS, ENVS)).astype(np.float32),
        "start": start,
    }


def _predicted(policy: Policy, deterministic: bool = True) -> np.ndarray:
    state, actions = policy.initial_state(ENVS), []
    for obs, start, reward in zip(*(_inputs()[k] for k in ("obs", "start", "reward")), strict=True):
        action, state = policy.predict(obs, state, start, deterministic, reward)
        actions.append(action)
    return np.stack(actions)


@pytest.fixture(scope="module")
def policies() -> dict[str, Policy]:
    return {name: small_policy(**fields) for name, fields in CASES.items()}


@pytest.fixture(scope="module")
def files(policies: dict[str, Policy], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("exported")
    made = {name: export_policy(each, folder / f"{name}.zip") for name, each in policies.items()}
    made["drawn"] = export_policy(
        policies["ppo"], folder / "drawn.zip", num_envs=ENVS, deterministic=False
    )
    return made


def test_it_acts_like_the_policy_where_the_package_is_not(
    policies: dict[str, Policy], files: dict[str, Path], tmp_path: Path
) -> None:
    np.savez(tmp_path / "inputs.npz", **_inputs())
    arguments = [str(LOADER.parent), json.dumps([str(path) for path in files.values()])]
    arguments += [str(tmp_path / "inputs.npz"), str(tmp_path / "outputs.npz")]
    subprocess.run([sys.executable, "-c", PROGRAM, *arguments], check=True, cwd=tmp_path)
    outputs = np.load(tmp_path / "outputs.npz")
    for name, path in files.items():
        policy = policies["ppo" if name == "drawn" else name]
        expected = _predicted(policy, deterministic=name != "drawn")
        np.testing.assert_allclose(outputs[str(path)], expected, atol=1e-5, err_msg=name)
    # What was compared depends on what is remembered, and on what is drawn.
    forgetful, _ = policies["window"].predict(_inputs()["obs"][-1])
    assert np.abs(forgetful - outputs[str(files["window"])][-1]).max() > 0.01
    assert np.abs(outputs[str(files["drawn"])] - outputs[str(files["ppo"])]).max() > 0.1


def test_the_state_is_as_small_as_can_be(policies: dict[str, Policy]) -> None:
    def names(policy: Policy, deterministic: bool = True) -> set[str]:
        return {leaf.name for leaf in ActingStep(policy, deterministic).leaves}

    window = {"context.obs", "context.return_so_far", "context.time_step", "context.mask"}
    assert names(policies["window"]) == window
    assert names(policies["window"], deterministic=False) == {*window, "key"}
    blind = small_policy(return_conditioning="none")
    assert names(blind) == window - {"context.return_so_far"}
    assert names(policies["episode"]) >= {*window, "context.action"}
    assert sum("cache" in name for name in names(policies["episode"])) == 2  # keys and values
    for agent in ("sac", "td3", "ddpg", "ppo"):
        assert names(small_policy(agent)) == set()
    assert names(small_policy("ppo"), deterministic=False) == {"key"}


def test_the_manifest_says_what_it_is(policies: dict[str, Policy], files: dict[str, Path]) -> None:
    with zipfile.ZipFile(files["window"]) as archive:
        assert archive.namelist() == ["manifest.json", "policy.jax_export"]
        manifest = json.loads(archive.read("manifest.json"))
        program = jax.export.deserialize(bytearray(archive.read("policy.jax_export")))
    assert manifest["format"] == "sacformer-policy"
    assert manifest["format_version"] == FORMAT_VERSION == 1
    assert manifest["gymnasium_id"] == "Pendulum-v1"
    assert (manifest["action_low"], manifest["action_high"]) == ([-2.0], [2.0])
    assert manifest["uses_reward"] is True
    assert manifest["inputs"]["obs"] == {"shape": ["N", OBS], "dtype": "float32"}
    assert manifest["state"]["context.mask"] == {"shape": ["N", 4], "dtype": "bool"}
    assert manifest["config"] == policies["window"].config.to_dict()
    about = manifest["jax_export"]
    assert about["platforms"] == list(program.platforms) == ["cpu", "cuda", "tpu"]
    assert about["calling_convention_version"] == program.calling_convention_version
    assert manifest["made_with"]["jax"] == jax.__version__


def test_another_format_is_refused_by_the_loader(files: dict[str, Path], tmp_path: Path) -> None:
    with zipfile.ZipFile(files["ppo"]) as archive:
        manifest = json.loads(archive.read("manifest.json"))
        program = archive.read("policy.jax_export")
    later = tmp_path / "later.zip"
    with zipfile.ZipFile(later, "w") as archive:
        archive.writestr("manifest.json", json.dumps({**manifest, "format_version": 2}))
        archive.writestr("policy.jax_export", program)
    ran = subprocess.run(
        [sys.executable, LOADER, later], check=False, capture_output=True, text=True
    )
    assert ran.returncode == 1
    assert "of format sacformer-policy 2, but this loader reads sacformer-policy 1" in ran.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"format": "torch"}, "format='torch': must be jax or onnx"),
        ({"num_envs": 0}, "num_envs=0: must be at least 1, or None for any"),
        ({"platforms": ("gpu",)}, r"platforms=\('gpu',\): must be some of cpu, cuda, rocm, tpu"),
        ({"platforms": ()}, r"platforms=\(\): must be some of"),
        ({"deterministic": False}, "num_envs=None: a policy that draws random numbers"),
        ({"format": "onnx", "deterministic": False, "num_envs": 2}, "random numbers do not conv"),
        ({"of": "episode", "format": "onnx"}, "fixed number of environments only; give num_envs"),
        ({"of": "bfloat16", "format": "onnx", "num_envs": 1}, "compute_dtype=bfloat16: onnxrunt"),
    ],
    ids=str,
)
def test_what_cannot_be_exported_is_refused(
    policies: dict[str, Policy], tmp_path: Path, arguments: dict[str, Any], message: str
) -> None:
    arguments = dict(arguments)
    of = arguments.pop("of", "window")
    policy = policies[of] if of in policies else small_policy(compute_dtype=of)
    with pytest.raises(ConfigError, match=message):
        export_policy(policy, tmp_path / "policy", **arguments)
    assert list(tmp_path.iterdir()) == []


def test_files_are_never_overwritten(policies: dict[str, Policy], files: dict[str, Path]) -> None:
    content = files["ppo"].read_bytes()
    with pytest.raises(ConfigError, match="is there already; choose another file"):
        export_policy(policies["ppo"], files["ppo"])
    assert files["ppo"].read_bytes() == content
    with pytest.raises(ConfigError, match="there is no folder"):
        export_policy(policies["ppo"], files["ppo"].parent / "missing" / "policy.zip")


@pytest.mark.parametrize(
    ("missing", "format", "extra"),
    [("flatbuffers", "jax", "export"), ("jax2onnx", "onnx", "onnx")],
)
def test_a_missing_extra_is_named(
    policies: dict[str, Policy], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    missing: str, format: Any, extra: str,
) -> None:  # fmt: skip
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(ConfigError, match=rf"{missing}.*sacformer-jax\[{extra}\]"):
        export_policy(policies["ppo"], tmp_path / "policy", format=format)
    assert list(tmp_path.iterdir()) == []


def test_the_command(
    policies: dict[str, Policy], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    asked: list[tuple[Any, ...]] = []

    def load(*arguments: Any) -> Policy:
        asked.append(arguments)
        return policies["ppo"]

    monkeypatch.setattr("sacformer_jax.policy.load_policy", load)
    to = tmp_path / "policy.zip"
    command = ["export", "runs/x", "--to", str(to), "--policy", "latest", "--member", "3"]
    assert cli.main([*command, "--num-envs", "2", "--platforms", "cpu"]) == 0
    assert asked == [(Path("runs/x"), "latest", "3")]
    assert f"written to {to}" in capsys.readouterr().out
    with zipfile.ZipFile(to) as archive:
        manifest = json.loads(archive.read("manifest.json"))
    assert manifest["inputs"]["obs"]["shape"] == [2, OBS]
    assert manifest["jax_export"]["platforms"] == ["cpu"]
    assert cli.main(command) == cli.EXIT_BAD_INPUT
    assert "is there already" in capsys.readouterr().err


@pytest.mark.parametrize("case", ["window", "episode", "joint", "ppo", "td3"])
def test_onnxruntime_acts_like_the_policy(
    policies: dict[str, Policy], tmp_path: Path, case: str
) -> None:
    pytest.importorskip("jax2onnx", reason="needs the extra onnx")
    import onnxruntime

    policy = policies[case] if case in policies else small_policy(case)
    num_envs = ENVS if case == "episode" else None
    path = export_policy(policy, tmp_path / "policy.onnx", format="onnx", num_envs=num_envs)
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    manifest = json.loads(session.get_modelmeta().custom_metadata_map["manifest.json"])
    state = {
        f"state.{name}": np.zeros(
            [ENVS if size == "N" else size for size in x["shape"]], x["dtype"]
        )
        for name, x in manifest["state"].items()
    }
    inputs, actions = _inputs(), []
    for t in range(STEPS):
        given = {
            "obs": inputs["obs"][t],
            "episode_start": inputs["start"][t],
            "reward": inputs["reward"][t],
        }
        action, *after = session.run(None, {**given, **state})
        state = dict(zip(state, after, strict=True))
        actions.append(action)
    np.testing.assert_allclose(np.stack(actions), _predicted(policy), atol=1e-4)

"""Environments of one's own: by name, of any kind, checked; whole runs, and brax's way."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import pytest
from brax import envs as brax_envs
from probe import EPISODE, PointEnv
from trees import unequal

from sacformer_jax import (
    Config,
    ConfigError,
    as_brax,
    check_env,
    env_names,
    load_policy,
    make_env,
    register_env,
    stored,
    train,
)
from sacformer_jax.envs.brax_env import BraxEnv
from sacformer_jax.envs.own import as_env
from sacformer_jax.envs.physics import EngineChoice
from sacformer_jax.presets import resolve
from sacformer_jax.train import make_training_env

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "examples"
sys.path.append(str(EXAMPLES))
from swing_up_env import SwingUp  # noqa: E402

TINY = {
    "env": "probe:KeepingEnv", "agent": "sac", "num_envs": 2, "prefill_env_steps": 40,
    "total_env_steps": 100, "chunk_env_steps": 20, "buffer_capacity": 200, "batch_size": 4,
    "actor_width": 8, "actor_layers": 1, "critic_width": 8, "eval_every": 20,
    "checkpoint_every": 20, "eval_episodes": 2,
}  # fmt: skip
MODULE = """
from probe import PointEnv
point, number = PointEnv(), 3
class Holder:
    inner = point
def other(size):
    return point
def made():
    made.calls += 1
    return PointEnv()
made.calls = 0
"""


@pytest.fixture
def names(monkeypatch):
    """Whatever is registered or looked up in a test is forgotten after it."""
    monkeypatch.setattr(env_names, "_REGISTERED", {})
    env_names.find.cache_clear()
    yield
    env_names.find.cache_clear()


@pytest.fixture
def here(names, tmp_path, monkeypatch):
    """A working directory with a user's module; only the installed programs know the others."""
    (tmp_path / "users_module.py").write_text(MODULE)
    (tmp_path / "needs_more.py").write_text("import not_installed_anywhere")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    for module in ("users_module", "needs_more"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    return tmp_path


# --- by name -------------------------------------------------------------------------------------


def test_a_module_of_the_working_directory_is_found(here):
    assert isinstance(make_env("users_module:point"), PointEnv)
    assert make_env("users_module:Holder.inner") is make_env("users_module:point")
    assert sys.path[0] == str(here)


def test_a_factory_is_called_once_whatever_asks(here):
    first = make_env("users_module:made")
    assert make_env("users_module:made") is first
    assert env_names.own_limit("users_module:made") == EPISODE
    assert sys.modules["users_module"].made.calls == 1


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("no_such_module:x", r"there is no module 'no_such_module', neither in '/.*PYTHONPATH"),
        ("needs_more:x", "'needs_more' imports 'not_installed_anywhere', which is not installed"),
        ("users_module:pint", r"\(/.*users_module.py\) has no 'pint'; did you mean 'point'\?"),
        ("users_module:zzz", "has no 'zzz'; it has point, number, Holder, other, made"),
        ("users_module:Holder.x", "what it names in module 'users_module' .*; it has inner"),
        ("users_module:other", "cannot be called without arguments .*'size'"),
        ("users_module:number", "is of type builtins.int; must be a Task, .* brax.envs.Env"),
        ("users_module:", "must be MODULE:ATTRIBUTE"),
        ("users_module.py:point", "name the module, not its file: users_module:point"),
        ("Chetah", r"no such environment; there are HalfCheetah, .*MODULE:ATTRIBUTE"),
        ("brax:point", "no such environment"),
    ],
)
def test_names_that_stand_for_nothing_are_told_what_was_tried(here, name, message):
    with pytest.raises(ConfigError, match=f"env={name!r}: .*{message}"):
        make_env(name)


def test_what_was_registered_is_known_and_nothing_else_is_hidden_by_it(names):
    register_env("point", PointEnv)
    assert isinstance(make_env("point"), PointEnv)
    with pytest.raises(
        ConfigError, match=r"there are HalfCheetah, .*, point, playground:NAME .*; and for one"
    ):
        make_env("pont")
    with pytest.raises(ConfigError, match=r"'point': is registered already; .*replace=True"):
        register_env("point", PointEnv)
    other = PointEnv()
    register_env("point", other, replace=True)
    assert make_env("point") is other
    for name, message in (("Hopper", "is one of the tasks"), ("brax:ant", "without a colon")):
        with pytest.raises(ConfigError, match=message):
            register_env(name, PointEnv, replace=True)


def test_the_environments_own_limit_is_the_default_and_no_return_is_made_up(names):
    resolved = resolve("cpu", {"env": "probe:PointEnv"})
    assert resolved.config.task.max_episode_steps == EPISODE
    assert resolved.sources["max_episode_steps"] == "the environment's own time limit"
    assert resolved.config.context.target_return == "auto"
    given = {"max_episode_steps": 7, "target_return": -1.0, "env": "probe:PointEnv"}
    config = Config.from_preset("cpu", **given)
    assert (config.task.max_episode_steps, config.context.target_return) == (7, -1.0)
    assert resolve("cpu", {"env": "brax:ant"}).config.context.target_return == "auto"
    # Where no return is looked at there is no target, whoever said so.
    for preset, given in (("cpu", {"return_conditioning": "none"}), ("best", {}), ("memory", {})):
        unconditioned = resolve(preset, {"env": "probe:PointEnv", **given})
        unconditioned.config.validated()
        assert unconditioned.sources["target_return"].startswith("default")
    looking = Config.from_preset("best", env="probe:PointEnv", return_conditioning="commanded")
    assert looking.context.target_return == "auto"
    for agent in ("sac", "ppo"):
        Config.from_preset("cpu", env="probe:PointEnv", agent=agent)
    assert Config.from_preset("cpu", env="Hopper").task.max_episode_steps == 1000


# --- the contract --------------------------------------------------------------------------------


def changed(step=None, reset=None, **spec) -> PointEnv:
    """The point environment with one thing wrong."""
    env, good = PointEnv(), PointEnv()
    env.spec = dataclasses.replace(env.spec, **spec)
    if step is not None:
        env.step = lambda state, action: step(*good.step(state, action), action)
    if reset is not None:
        env.reset = lambda key: reset(*good.reset(key))
    return env


def with_step(**fields):
    return lambda state, step, action: (
        state,
        step.replace(**{name: f(step, action) for name, f in fields.items()}),
    )


BROKEN = {
    r"spec.action_high=\(inf,\): must be finite": changed(action_high=(np.inf,)),
    r"spec.action_low=\(1.0,\): must be below": changed(action_low=(1.0,)),
    r"spec.action_low=\(-1.0, -1.0\): must be a tuple of 1": changed(action_low=(-1.0, -1.0)),
    "spec.max_episode_steps=0: must be 1 or more": changed(max_episode_steps=0),
    r"reset: obs is float32\[2\]: must be float32\[3\]": changed(obs_size=3),
    "reset gives ShapedArray|reset gives ShapeDtypeStruct: must be a pair": changed(
        reset=lambda state, obs: obs
    ),
    r"reset: obs is dict: must be": changed(reset=lambda state, obs: (state, {"x": obs})),
    r"step: obs is int32\[2\]": changed(with_step(obs=lambda s, a: s.obs.astype(int))),
    r"step: reward is float32\[1\]: must be float32\[\]": changed(with_step(reward=lambda s, a: a)),
    r"step: terminated is float32\[\]: must be bool\[\]": changed(
        with_step(terminated=lambda s, a: s.reward)
    ),
    r"step: truncated is bool\[1\]: must be bool\[\]": changed(
        with_step(truncated=lambda s, a: a > 0)
    ),
    "reward_terms is of type list": changed(with_step(reward_terms=lambda s, a: [s.reward])),
    "must be an EnvStep": changed(lambda state, step, action: (state, step.obs)),
    r"differs from that after reset: \['v'\] is float32\[2\], there missing": changed(
        lambda state, step, action: ({"v": state}, step)
    ),
    r"it is float16\[2\], there float32\[2\]": changed(
        lambda state, step, action: (state.astype(jnp.float16), step)
    ),
}


@pytest.mark.parametrize("message", BROKEN)
def test_a_broken_contract_is_named_before_anything_is_run(message):
    with pytest.raises(ConfigError, match=f"env='mine': .*({message})"):
        as_env(BROKEN[message], EngineChoice(), "mine")


def test_steps_are_taken_where_asked_for():
    check_env(PointEnv())
    nan = changed(with_step(reward=lambda step, action: step.reward * jnp.nan))
    check_env(nan, num_steps=0)
    with pytest.raises(ConfigError, match="env='point': step: reward is not finite"):
        check_env(nan)
    drawn = np.random.default_rng(0)
    shape = jax.ShapeDtypeStruct((2,), np.float32)
    impure = changed(
        reset=lambda state, obs: (
            state,
            jax.pure_callback(lambda: drawn.random(2, np.float32), shape),
        )
    )
    with pytest.raises(ConfigError, match="must be pure functions"):
        check_env(impure)


def test_what_lacks_the_methods_is_told_to_derive_from_jax_env():
    class Bare:
        spec, reset, step = PointEnv().spec, PointEnv.reset, PointEnv.step

    with pytest.raises(ConfigError, match="has no step_and_refill; derive its class from JaxEnv"):
        check_env(Bare())
    with pytest.raises(ConfigError, match="spec is of type NoneType: must be an EnvSpec"):
        check_env(object())


# --- whole runs ----------------------------------------------------------------------------------


def test_arrays_without_elements_are_stored_too(tmp_path):
    tree = {"full": jnp.arange(3.0), "none": jnp.zeros((0, 3)), "inner": [jnp.zeros(0, jnp.int32)]}
    with ocp.StandardCheckpointer() as checkpointer:
        checkpointer.save(tmp_path / "state", stored.without_empty(tree))
    metadata = {"items": {"state": stored.described(tree)}, "version": "1"}
    restored = stored.read_item(tmp_path, "state", metadata, jax.eval_shape(lambda: tree))
    assert not unequal(restored, tree)
    stored.check_digests("state", metadata, restored)


def test_a_training_environment_is_made_of_it(names):
    env = make_training_env(Config.from_preset("cpu", **TINY))
    assert (env.num_envs, env.max_episode_steps, env.spec.name) == (2, EPISODE, "point")


@pytest.mark.slow
def test_a_run_goes_on_in_another_process_and_its_policy_needs_no_environment(names, tmp_path):
    run = tmp_path / "run"
    result = train(Config.from_preset("cpu", run_dir=str(run), **TINY), quiet=True)
    assert result.env_steps == 100
    assert json.loads((run / "config.json").read_text())["env_spec"]["name"] == "point"
    script = "from sacformer_jax.cli import main; import sys; sys.exit(main(sys.argv[1:]))"

    def sacformer(*args: str, cwd: Path) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", f"import sys; sys.path.remove(''); {script}", *args]
        return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=300)

    lost = sacformer("resume", str(run), "--total-env-steps", "140", cwd=tmp_path)
    assert lost.returncode == 2
    assert f"no module 'probe', neither in '{tmp_path}'" in lost.stderr
    gone_on = sacformer("resume", str(run), "--total-env-steps", "140", cwd=Path(__file__).parent)
    assert gone_on.returncode == 0, gone_on.stderr
    records = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert max(record["env_steps"] for record in records) == 140
    env_names.find.cache_clear()
    assert load_policy(run).predict(np.zeros(2))[0].shape == (1,)


# --- brax ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def swing_up():
    """The example, brax's own steps and ours from the same resets."""
    theirs = SwingUp()
    ours = as_env(theirs, EngineChoice(), "swing_up")
    actions = jax.random.uniform(jax.random.key(1), (30, 1), minval=-1.0)

    @jax.jit
    def run(key):
        state, obs = ours.reset(key)
        return obs, *jax.lax.scan(ours.step, state, actions)

    return theirs, ours, jax.device_get(run(jax.random.key(0)))


def test_the_brax_example_is_an_environment(swing_up):
    _, ours, (obs, state, steps) = swing_up
    assert (ours.spec.name, ours.spec.engine) == ("swing_up", "brax generalized")
    assert (ours.spec.obs_size, ours.spec.action_size, ours.spec.max_episode_steps) == (3, 1, 200)
    np.testing.assert_allclose(obs, [1.0, 0.0, 0.0], atol=0.11)  # hanging, within its noise
    height = -steps.obs[:, 0]
    np.testing.assert_array_equal(steps.reward_terms["reward_height"], height)
    np.testing.assert_allclose(np.sum(steps.obs[:, :2] ** 2, axis=1), 1.0, rtol=1e-5)
    assert np.ptp(height) > 0.01
    np.testing.assert_array_equal(state.obs, steps.obs[-1])
    assert not steps.terminated.any()


def test_a_brax_class_is_found_by_module_and_where_brax_has_it_registered(names, monkeypatch):
    monkeypatch.setattr(brax_envs, "_envs", dict(brax_envs._envs))
    brax_envs.register_environment("swing_up", SwingUp)
    assert make_env("brax:swing_up", brax_backend="generalized").spec.max_episode_steps == 200
    config = Config.from_preset("cpu", env="swing_up_env:SwingUp")
    assert config.task.max_episode_steps == 200
    assert make_env(config.task.env).spec.name == "swing_up_env:SwingUp"


class DictObs(SwingUp):
    """Its observation is no vector."""

    def reset(self, rng):
        return super().reset(rng).replace(obs={"state": jnp.zeros(3)})


def test_brax_environments_that_cannot_be_are_refused(swing_up):
    theirs = swing_up[0]
    with pytest.raises(ConfigError, match="wrapped in brax's AutoResetWrapper: give the bare"):
        BraxEnv(brax_envs.training.wrap(theirs, episode_length=10))
    with pytest.raises(ConfigError, match=r"env='DictObs': its observation is dict: must be one"):
        BraxEnv(DictObs())


def test_ours_through_braxs_view_and_back_is_the_same():
    ours = PointEnv()
    back = as_env(as_brax(ours), EngineChoice())
    state, obs = back.reset(jax.random.key(0))
    np.testing.assert_array_equal(obs, ours.reset(jax.random.key(0))[1])
    _, step = back.step(state, jnp.array([0.5]))
    _, expected = ours.step(ours.reset(jax.random.key(0))[0], jnp.array([0.5]))
    np.testing.assert_array_equal(step.obs, expected.obs)
    np.testing.assert_array_equal(step.reward, expected.reward)


# --- the page ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["reach_task.py", "reach.xml", "swing_up_env.py", "slider_playground.py"]
)
def test_the_page_shows_the_examples_as_they_are(name):
    text = (EXAMPLES / name).read_text()
    assert text in (ROOT / "docs" / "own_task.md").read_text()
    if name.endswith(".py"):
        assert len([line for line in text.splitlines() if line.strip()]) <= 40


def test_the_pages_environment_keeps_the_contract():
    page = (ROOT / "docs" / "own_task.md").read_text()
    (code,) = [block for block in page.split("```python\n") if "class Point(JaxEnv)" in block]
    namespace: dict[str, type] = {}
    exec(code.split("```")[0], namespace)
    point, key, action = namespace["Point"](), jax.random.key(0), jnp.array([0.5])
    check_env(point, num_steps=0)
    state, expected_state = point.reset(key)[0], PointEnv().reset(key)[0]
    np.testing.assert_array_equal(state, expected_state)
    step, expected = point.step(state, action)[1], PointEnv().step(expected_state, action)[1]
    np.testing.assert_allclose(step.obs, expected.obs, rtol=1e-6)
    assert step.reward == expected.reward

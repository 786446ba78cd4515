"""The MuJoCo Playground adapter against Playground itself."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sacformer_jax import Config, ConfigError
from sacformer_jax.envs import VectorEnv, make_env
from sacformer_jax.envs.playground_env import PlaygroundEnv, playground_names

LIMIT, NUM_ENVS, NUM_STEPS, REPEAT = 6, 2, 6, 3
NAME = "TestsPointMass"


def test_without_the_extra_it_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco_playground", None)
    for refused in (
        lambda: make_env("playground:CheetahRun"),
        lambda: Config.from_preset("cpu", env="playground:CheetahRun"),
    ):
        with pytest.raises(ConfigError, match=r"Playground .*pip install .*\[playground\]"):
            refused()


@pytest.fixture(scope="module")
def package():
    return pytest.importorskip(
        "mujoco_playground", reason="the extra playground is not installed", exc_type=ImportError
    )


@pytest.fixture(scope="module")
def registered(package):
    """A task of the user's own, three steps in one: a point mass, done at a certain speed."""
    suite = package.dm_control_suite
    theirs = type(suite.load("PointMass", config_overrides={"impl": "jax"}))

    class Task(theirs):
        def step(self, state, action):
            state = super().step(state, action)
            speed = state.data.qvel[0]
            return state.replace(done=((speed > 0.05) & (speed < 0.055)).astype(float))

    class Told(theirs):
        def reset(self, rng):
            state = super().reset(rng)
            return state.replace(obs={"state": state.obs, "privileged_state": state.obs[:2]})

    def config():
        config = suite.get_default_config("PointMass")
        with config.unlocked():
            config.action_repeat, config.episode_length = REPEAT, REPEAT * LIMIT
        return config

    for name, task in ((NAME, Task), ("TestsDictionary", Told)):
        suite.register_environment(name, task, config)
    yield Task(config(), {"impl": "jax"})
    for name in (NAME, "TestsDictionary"):
        del suite._envs[name], suite._cfgs[name]


@pytest.fixture(scope="module")
def point(registered):
    """Two points, one drawn to the right and one to the left, for some steps without resets."""
    env = make_env(f"playground:{NAME}")
    action = np.zeros((NUM_ENVS, env.spec.action_size), np.float32)
    action[:, 0] = 1.0, -1.0
    reset, step = jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step))
    first = [reset(jax.random.split(jax.random.key(seed), NUM_ENVS)) for seed in range(4)]
    states, steps = [first[0][0]], []
    for _ in range(NUM_STEPS):
        state, out = step(states[-1], action)
        states.append(state)
        steps.append(out)
    return SimpleNamespace(
        spec=env.spec,
        theirs=registered,
        action=action,
        first_obs=np.stack([obs for _, obs in first]),
        states=states,
        step=jax.tree.map(lambda *leaves: np.stack(leaves), *jax.device_get(steps)),
    )


def test_spec(point):
    spec = point.spec
    assert (spec.name, spec.engine, spec.gymnasium_id) == (f"playground:{NAME}", "mjx", None)
    assert (spec.obs_size, spec.action_size) == (4, 2)
    assert (spec.action_low, spec.action_high) == ((-1.0, -1.0), (1.0, 1.0))
    assert spec.max_episode_steps == LIMIT  # of ours, each three of theirs


def test_resets_are_freshly_random(point):
    assert np.unique(point.first_obs[..., 0]).size == point.first_obs[..., 0].size == 8


def test_a_step_is_three_of_playgrounds_own(point):
    their_step = jax.jit(point.theirs.step)
    # It has that speed after the second of the three steps of one of ours, and after no other.
    assert np.argwhere(point.step.terminated).tolist() == [[3, 0]]
    assert not np.any(point.step.truncated | point.step.bad)
    for t, env in ((0, 0), (3, 0), (4, 0), (NUM_STEPS - 1, 1)):
        state = jax.tree.map(lambda x, i=env: x[i], point.states[t])
        reward, done, terms = 0.0, False, dict.fromkeys(state.metrics, 0.0)
        for _ in range(REPEAT):
            state = their_step(state, point.action[env])
            reward += float(state.reward)
            done |= bool(state.done > 0.5)
            terms = {name: terms[name] + float(state.metrics[name]) for name in terms}
        ours = jax.tree.map(lambda x, i=(t, env): x[i], point.step)
        # Another program (no vmap, no scan), so another rounding.
        np.testing.assert_allclose(ours.obs, state.obs, rtol=1e-4, atol=1e-5)
        assert ours.reward == pytest.approx(reward, rel=1e-4)
        assert bool(ours.terminated) is done
        assert set(ours.reward_terms) == {"reward/near_target", "reward/small_control"}
        for name, value in ours.reward_terms.items():
            assert value == pytest.approx(terms[name], rel=1e-4, abs=1e-6)


def test_refusals(registered):
    with pytest.raises(ConfigError, match=r"'playground:Cheetah': .*close ones are CheetahRun"):
        make_env("playground:Cheetah")
    with pytest.raises(ConfigError, match=r"dictionary \(privileged_state \(2,\), state \(4,\)\)"):
        make_env("playground:TestsDictionary")
    with pytest.raises(ConfigError, match=r"mjx_impl='warp': .*mjx_impl=jax"):
        make_env("playground:CheetahRun", mjx_impl="warp")
    with pytest.raises(ConfigError, match="mjx_impl='numpy': must be one of jax, warp"):
        make_env("playground:CheetahRun", mjx_impl="numpy")
    assert {"CheetahRun", "Go1JoystickFlatTerrain", "PandaPickCube", NAME} <= {*playground_names()}


def test_a_robot_that_cannot_be_cloned_is_told(package, monkeypatch):
    def no_network() -> None:
        raise FileNotFoundError("git")

    monkeypatch.setattr(package.locomotion.mjx_env, "ensure_menagerie_exists", no_network)
    with pytest.raises(ConfigError, match=r"Go1Footstand': .*mujoco_menagerie.*failed: git"):
        PlaygroundEnv("Go1Footstand")


def test_the_tasks_own_episode_and_highest_return_are_the_defaults(registered):
    config = Config.from_preset("cpu", env="playground:CheetahRun")
    assert config.task.max_episode_steps == 1000
    assert (config.context.target_return, config.context.return_scale) == (1000.0, 100.0)
    config = Config.from_preset("cpu", env=f"playground:{NAME}", agent="sac")
    assert config.task.max_episode_steps == LIMIT
    walk = Config.from_preset("cpu", env="playground:Go1JoystickFlatTerrain")
    assert walk.context.target_return == "auto"
    Config.from_preset("memory", env="playground:Go1JoystickFlatTerrain")  # looks at no return


@pytest.mark.slow
def test_cheetah_run_in_a_vector_env_and_its_physics_breaking_down(package):
    limit = 7
    env = VectorEnv(make_env("playground:CheetahRun"), 2, limit)
    state = jax.jit(env.init)(jax.random.key(0))
    starts, step = [state.obs], jax.jit(env.step)
    for t in range(1, 3 * limit + 1):
        state, out = step(state, env.random_action(jax.random.key(t)))
        assert np.all((out.reward >= 0) & (out.reward <= 1))
        assert not np.any(out.terminated | out.bad)
        assert np.all(out.truncated) == np.any(out.truncated) == (t % limit == 0)
        if t % limit == 0:
            starts.append(out.next_obs)
    assert np.unique(np.concatenate(starts)[:, 1]).size == 8
    # The horizontal position is not observed, yet it tells; Playground calls this done.
    data = state.env.data
    broken = data.replace(qpos=data.qpos.at[1, 0].set(jnp.nan))
    _, out = step(state.replace(env=state.env.replace(data=broken)), jnp.zeros((2, 6)))
    assert out.bad.tolist() == out.truncated.tolist() == [False, True]
    assert not np.any(out.terminated)


def test_an_environment_of_ones_own_is_named_by_its_module(package):
    config = Config.from_preset("cpu", env="slider_playground:Slider", agent="sac")
    assert config.task.max_episode_steps == 100
    env = make_env("slider_playground:Slider")
    assert (env.spec.name, env.spec.obs_size, env.spec.engine) == (
        "slider_playground:Slider", 2, "mjx",
    )  # fmt: skip
    assert make_env(env._env).spec.name == "Slider"


@pytest.mark.slow
def test_an_environment_of_ones_own_steps(package):
    env = make_env("slider_playground:Slider")
    state, step = jax.jit(env.step)(jax.jit(env.reset)(jax.random.key(0))[0], jnp.ones(1))
    position = float(state.data.qpos[0])
    assert float(step.reward) == pytest.approx(np.exp(-4 * position**2), rel=1e-5)
    np.testing.assert_allclose(step.obs, [position, state.data.qvel[0]], rtol=1e-6)
    assert not step.terminated

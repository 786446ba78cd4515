"""The MJX engine against C MuJoCo, step by step from states along Gymnasium's trajectories."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from types import SimpleNamespace

import engines
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from mujoco.mjx._src import collision_driver

from sacformer_jax import Config, ConfigError, make_program
from sacformer_jax.envs import EngineChoice, make_env, mjx_engine
from sacformer_jax.envs.mjx_engine import MjxEngine, MjxState
from sacformer_jax.envs.physics import ResetNoise
from sacformer_jax.envs.tasks import TASKS

NUM_ENVS, NUM_STEPS, KEPT_EVERY = 8, 60, 6
# Compiling MJX's step takes from a quarter of a minute (HalfCheetah) to one and a half (Humanoid).
QUICK = "Hopper"
EACH_TASK = [pytest.param(name, marks=() if name == QUICK else pytest.mark.slow) for name in TASKS]
# Largest differences allowed over NUM_ENVS * NUM_STEPS single environment steps: qpos and qvel
# absolute, as are rewards; observations relative to 1 + their size.
TOLERANCES = {
    "HalfCheetah": {"qpos": 2e-5, "qvel": 1e-3, "obs": 1e-3, "reward": 2e-5},
    "Hopper": {"qpos": 2e-6, "qvel": 5e-5, "obs": 5e-5, "reward": 5e-6},
    "Walker2d": {"qpos": 2e-5, "qvel": 1e-3, "obs": 1e-3, "reward": 1e-4},
    "Ant": {"qpos": 2e-5, "qvel": 2e-3, "obs": 2e-3, "reward": 2e-4},
    "Humanoid": {"qpos": 2e-5, "qvel": 2e-3, "obs": 2e-3, "reward": 2e-4},
}


def random_noise(engine: MjxEngine, num: int) -> ResetNoise:
    draw = np.random.default_rng(0).uniform
    return ResetNoise(
        jnp.asarray(draw(-0.1, 0.1, (num, engine.nq)), jnp.float32),
        jnp.asarray(draw(-0.1, 0.1, (num, engine.nv)), jnp.float32),
    )


@functools.cache
def case(name: str) -> SimpleNamespace:
    """Single steps of both engines from states along trajectories of random actions."""
    reference = make_env(name, "native")
    words, actions = engines.sample_steps(reference, NUM_ENVS, NUM_STEPS, KEPT_EVERY)
    # MJX has no PGS, Gymnasium's solver for the Humanoid: compare with what it has instead.
    reference.engine.model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    env = make_env(name, "mjx")
    states, share_in_contact = engines.mjx_states(env.engine, reference.engine, words)

    # One compilation for all tests of a task, which takes most of their time.
    @jax.jit
    def step(states, actions, reset, noise):
        physics, fresh = env.engine.step_and_reset(states, actions, reset, noise)
        return physics, jax.vmap(env._env_step)(physics, actions), fresh

    noise = random_noise(env.engine, len(actions))
    resets = np.arange(len(actions)) % 2 == 0
    physics, steps, fresh = jax.device_get(step(states, actions, resets, noise))
    expected_physics = jax.vmap(reference.engine.step)(words, actions)
    expected = jax.vmap(reference._env_step)(expected_physics, actions)
    return SimpleNamespace(
        env=env,
        reference=reference,
        states=states,
        share_in_contact=share_in_contact,
        actions=actions,
        step=step,
        resets=resets,
        noise=noise,
        physics=physics,
        steps=steps,
        fresh=fresh,
        expected_physics=jax.device_get(expected_physics),
        expected=jax.device_get(expected),
    )


@pytest.mark.parametrize("name", EACH_TASK)
def test_single_steps_agree_with_c_mujoco(name):
    made, tolerance = case(name), TOLERANCES[name]
    for field in ("qpos", "qvel"):
        actual = getattr(made.physics.quantities, field)
        expected = getattr(made.expected_physics.quantities, field)
        np.testing.assert_allclose(actual, expected, rtol=0, atol=tolerance[field])
    np.testing.assert_allclose(
        made.steps.obs, made.expected.obs, rtol=tolerance["obs"], atol=tolerance["obs"]
    )
    np.testing.assert_allclose(
        made.steps.reward, made.expected.reward, rtol=0, atol=tolerance["reward"]
    )
    assert made.steps.reward_terms.keys() == made.expected.reward_terms.keys()
    np.testing.assert_array_equal(made.steps.terminated, made.expected.terminated)
    assert not made.steps.bad.any()
    assert made.share_in_contact > 0.2  # there is something to agree on


@pytest.mark.parametrize("name", EACH_TASK)
def test_a_second_step_goes_on_from_the_first(name):
    made, tolerance = case(name), TOLERANCES[name]
    physics, steps, _ = jax.device_get(
        made.step(made.physics.state, made.actions, made.resets, made.noise)
    )
    engine = made.reference.engine
    expected_physics = jax.vmap(engine.step)(made.expected_physics.state, made.actions)
    expected = jax.vmap(made.reference._env_step)(expected_physics, made.actions)
    # The first step's errors grow, in a few states by much: contacts may open a little later.
    for actual, wanted, limit in (
        (physics.quantities.qpos, expected_physics.quantities.qpos, tolerance["qpos"]),
        (physics.quantities.qvel, expected_physics.quantities.qvel, tolerance["qvel"]),
        (steps.reward[:, None], expected.reward[:, None], tolerance["reward"]),
    ):
        errors = np.abs(actual - wanted).max(axis=1)
        assert np.quantile(errors, 0.9) < 10 * limit
    roots = 1 if TASKS[name].measure == "root" else 2
    assert not np.any(made.physics.state.qpos[:, :roots])
    np.testing.assert_allclose(
        made.physics.state.origin[:, :roots],
        made.physics.quantities.qpos[:, :roots],
        atol=1e-6,
    )
    # The warm start is the acceleration found last, as C MuJoCo keeps it.
    words = engine.unpack_state(made.expected_physics.state)[0]
    found = words[:, -engine.nv :]
    scale = 1 + np.abs(found).max()
    assert np.quantile(np.abs(made.physics.state.qacc_warmstart - found), 0.9) < 1e-3 * scale


@pytest.mark.parametrize("name", EACH_TASK)
def test_far_from_the_origin_nothing_is_lost(name):
    made = case(name)
    roots = 1 if TASKS[name].measure == "root" else 2
    far = dataclasses.replace(made.states, origin=made.states.origin + 500.0)
    physics, steps, _ = jax.device_get(made.step(far, made.actions, ~made.resets, made.noise))
    np.testing.assert_array_equal(steps.reward, made.steps.reward)
    np.testing.assert_array_equal(steps.obs, made.steps.obs)
    np.testing.assert_allclose(
        physics.quantities.qpos[:, :roots],
        made.physics.quantities.qpos[:, :roots] + 500.0,
        rtol=2e-7,
    )


@pytest.mark.parametrize("name", EACH_TASK)
def test_resets_agree_with_c_mujoco_and_come_only_where_asked_for(name):
    made = case(name)
    expected = jax.device_get(jax.vmap(made.reference.engine.reset)(made.noise))
    wanted = made.resets
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a[wanted], b[wanted], rtol=1e-4, atol=2e-5),
        made.fresh.quantities,
        expected.quantities,
    )
    # What is measured enters the first step's displacement.
    _, measured = made.reference.engine.unpack_state(expected.state)
    fresh = made.fresh.state
    np.testing.assert_allclose((fresh.measured + fresh.origin)[wanted], measured[wanted], atol=1e-5)
    assert not made.fresh.bad.any()
    assert not any(np.any(leaf[~wanted]) for leaf in jax.tree.leaves(made.fresh))
    nowhere = np.zeros_like(wanted)
    *_, none = jax.device_get(made.step(made.states, made.actions, nowhere, made.noise))
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(none))


# An environment that breaks down takes every iteration that the solver may take.
@pytest.mark.parametrize(
    "value",
    [
        np.nan,
        pytest.param(np.inf, marks=pytest.mark.slow),
        pytest.param(1e12, marks=pytest.mark.slow),
    ],
)
def test_a_breakdown_is_reported_and_stays_alone(value):
    made = case(QUICK)
    broken = dataclasses.replace(made.states, qvel=made.states.qvel.at[3, 2].set(value))
    physics, *_ = jax.device_get(made.step(broken, made.actions, made.resets, made.noise))
    np.testing.assert_array_equal(physics.bad, np.arange(len(made.actions)) == 3)
    others = np.arange(len(made.actions)) != 3
    # The solver stops when all environments have converged, so the others may be a little off.
    np.testing.assert_allclose(
        physics.quantities.qvel[others], made.physics.quantities.qvel[others], atol=1e-3
    )


# --- contact frames ------------------------------------------------------------------------------

_CAPSULE = mujoco.MjModel.from_xml_string("""
<mujoco><worldbody>
  <geom type="plane" size="5 5 1"/>
  <body><freejoint/><geom type="capsule" size="0.1 0.5"/></body>
</worldbody></mujoco>
""")


def _frames(qpos):
    model = mjx.put_model(_CAPSULE)
    data = mjx.make_data(_CAPSULE).replace(qpos=qpos)
    contact = mjx.collision(model, mjx.kinematics(model, data))._impl.contact
    return contact.frame, contact.dist


@functools.cache
def _compiled_frames(corrected):
    context = mjx_engine._traced_like_mujoco() if corrected else contextlib.nullcontext()
    with context:
        return jax.jit(_frames).lower(jnp.zeros(7)).compile()


@pytest.mark.parametrize("degrees", [0.0, 0.1, 10.0, 29.0, 31.0, 60.0, 90.0])
def test_capsules_touch_the_floor_in_the_frames_of_c_mujoco(degrees):
    angle, data = np.deg2rad(degrees), mujoco.MjData(_CAPSULE)
    data.qpos[2] = 0.5 * np.cos(angle) + 0.09
    # About an axis in the plane that is neither x nor y.
    data.qpos[3:] = [np.cos(angle / 2), *(np.sin(angle / 2) * np.array([0.6, 0.8, 0.0]))]
    mujoco.mj_forward(_CAPSULE, data)
    expected = data.contact.frame.reshape(-1, 3, 3)
    assert len(expected) == (2 if degrees == 90.0 else 1)
    qpos = jnp.asarray(data.qpos, jnp.float32)

    frame, distance = _compiled_frames(corrected=True)(qpos)
    np.testing.assert_allclose(frame[distance < 0], expected, atol=2e-4)
    if 0 < degrees < 30:  # what is being corrected
        frame, distance = _compiled_frames(corrected=False)(qpos)
        assert np.abs(frame[distance < 0] - expected).max() > 0.1


def test_mjx_is_left_as_it_was():
    before = dict(collision_driver._COLLISION_FUNC)

    def fail() -> None:
        with mjx_engine._traced_like_mujoco():
            assert before != collision_driver._COLLISION_FUNC
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    make_env("Hopper", "mjx")
    assert before == collision_driver._COLLISION_FUNC


# --- choosing ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("backend", "engine"), [("cpu", "native"), ("gpu", "mjx"), ("tpu", "mjx")])
def test_the_device_decides_unless_asked(backend, engine, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    choice, reason = EngineChoice("auto", mjx_preset="fast").resolved()
    assert choice.engine == engine
    assert "auto" in reason
    assert backend in reason
    assert ("preset fast" in reason) == (engine == "mjx")
    for asked in ("native", "mjx"):
        assert EngineChoice(asked).resolved()[0].engine == asked


def test_presets_set_the_solver():
    for task in TASKS.values():
        budget = mjx_engine.FAST_ITERATIONS[task.name]
        opt = MjxEngine(task, "fast").model.opt
        assert (opt.iterations, opt.ls_iterations) == (budget.newton, budget.line_search)
    parity, fast = (MjxEngine(TASKS["Humanoid"], preset).model.opt for preset in ("parity", "fast"))
    assert parity.solver == fast.solver == mujoco.mjtSolver.mjSOL_NEWTON
    assert (parity.iterations, parity.ls_iterations) == (50, 50)
    assert (fast.iterations, fast.ls_iterations) == (4, 8)


@pytest.mark.parametrize(
    ("task", "reason"), [("Ant", "contact forces"), ("Hopper", r"warp-lang|NVIDIA")]
)
def test_warp_is_refused_where_it_cannot_be(task, reason):
    if jax.default_backend() == "gpu" and task == "Hopper":
        pytest.skip("can have it")
    with pytest.raises(ConfigError, match=f"mjx_impl='warp': .*({reason})"):
        make_env(task, "mjx", mjx_impl="warp")


# --- training ------------------------------------------------------------------------------------

TINY = {
    "env": "HalfCheetah", "num_envs": 2, "max_episode_steps": 20, "prefill_env_steps": 40,
    "chunk_env_steps": 8, "total_env_steps": 80, "actor_width": 8, "actor_heads": 1,
    "actor_layers": 1, "critic_width": 8, "batch_size": 4, "buffer_capacity": 200,
}  # fmt: skip


@pytest.mark.parametrize("engine", ["mjx", "native"])
def test_only_the_native_engine_calls_the_host(engine):
    program = make_program(Config.from_preset("cpu", engine=engine, **TINY))
    state = jax.eval_shape(program.init, jax.random.key(0))
    lowered = program.train_chunk.lower(state).as_text()
    # By name on a CPU, as a callback elsewhere.
    calls = "sacformer_jax.native." in lowered or "callback" in lowered
    assert calls == (engine == "native")


@pytest.mark.slow
def test_sacformer_trains_on_mjx_from_start_to_end():
    program = make_program(Config.from_preset("cpu", engine="mjx", **TINY))
    state, _ = program.prefill(program.init(jax.random.key(0)))
    assert isinstance(state.env.env, MjxState)
    before = jax.device_get(state.learner.actor_params)
    for _ in range(3):
        state, metrics = program.train_chunk(state)
    assert int(state.counters.env_steps) == 64
    assert int(state.counters.episodes) == 2
    assert int(state.counters.bad_physics) == 0
    assert all(np.isfinite(metrics[name]) for name in ("critic_loss", "actor_loss", "q_mean"))
    changed = jax.tree.map(lambda a, b: np.any(a != b), before, state.learner.actor_params)
    assert all(jax.tree.leaves(changed))

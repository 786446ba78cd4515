"""Tasks of one's own on both engines: the example, other models, and what is refused."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from sacformer_jax import ConfigError, Coordinates, MujocoEnv, Task, VectorEnv, make_env
from sacformer_jax.envs import TASKS, EngineChoice
from sacformer_jax.envs.mjx_engine import FAST_ITERATIONS, MjxEngine

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
sys.path.append(str(EXAMPLES))
from reach_task import reach  # noqa: E402

NUM_STEPS = 12


def joint_model(actuator: str = '<motor joint="j" ctrlrange="-1 2"/>', inside: str = "") -> str:
    """MJCF of one hinge."""
    return f"""
    <mujoco><worldbody><body name="b"><joint name="j" axis="0 1 0"/>
      <geom size=".1" pos=".3 0 0"/>{inside}</body></worldbody>
      <actuator>{actuator}</actuator></mujoco>
    """


def forward(q, action, x_velocity):
    return {"reward_forward": x_velocity}


def hinge(**fields) -> Task:
    return Task(**{"name": "Hinge", "xml_file": joint_model(), "reward_terms": forward, **fields})


def rollout(env: MujocoEnv, actions: jax.Array, key: jax.Array):
    @jax.jit
    def run(key):
        state, obs = env.reset(key)
        return obs, jax.lax.scan(env.step, state, actions)[1]

    return jax.device_get(run(key))


def some_actions(env: MujocoEnv, num_steps: int = NUM_STEPS) -> jax.Array:
    low, high = jnp.array(env.spec.action_low), jnp.array(env.spec.action_high)
    return jax.random.uniform(jax.random.key(1), (num_steps, low.size), minval=low, maxval=high)


def assert_engines_agree(task: Task, tolerance: float) -> None:
    native, mjx = (MujocoEnv(task, EngineChoice(engine)) for engine in ("native", "mjx"))
    assert (
        dataclasses.replace(native.spec, engine="mjx", engine_reason=mjx.spec.engine_reason)
        == mjx.spec
    )
    actions, key = some_actions(native), jax.random.key(5)
    (obs, steps), (mjx_obs, mjx_steps) = (rollout(env, actions, key) for env in (native, mjx))
    np.testing.assert_allclose(mjx_obs, obs, rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(mjx_steps.obs, steps.obs, rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(mjx_steps.reward, steps.reward, rtol=tolerance, atol=tolerance)
    np.testing.assert_array_equal(mjx_steps.terminated, steps.terminated)
    assert not np.any(mjx_steps.bad | steps.bad)
    assert np.ptp(steps.obs, axis=0).max() > 0.1  # it moved


# --- the example ---------------------------------------------------------------------------------


def test_the_example_is_what_c_mujoco_does():
    """Its observations and rewards, from MuJoCo's own simulation and NumPy."""
    env = MujocoEnv(reach, EngineChoice("native"))
    actions, key = np.asarray(some_actions(env)), jax.random.key(5)
    first_obs, steps = rollout(env, jnp.asarray(actions), key)
    model = mujoco.MjModel.from_xml_path(str(EXAMPLES / "reach.xml"))
    data = mujoco.MjData(model)
    data.qpos[:] = reach.reset(key, Coordinates(jnp.zeros(4), jnp.zeros(4))).qpos
    mujoco.mj_forward(model, data)
    start = data.site("target").xpos - data.site("fingertip").xpos
    np.testing.assert_allclose(first_obs[-2:], start[:2], atol=1e-6)
    for t, action in enumerate(actions):
        data.ctrl[:] = action
        mujoco.mj_step(model, data, reach.frame_skip)
        gap = (data.site("target").xpos - data.site("fingertip").xpos)[:2]
        arm = data.qpos[:2]
        expected = [*np.cos(arm), *np.sin(arm), *data.qvel[:2], *data.qpos[2:], *gap]
        np.testing.assert_allclose(steps.obs[t], expected, rtol=1e-5, atol=1e-5)
        distance, cost = np.linalg.norm(gap), 0.01 * np.sum(action**2)
        np.testing.assert_allclose(steps.reward[t], -distance - cost, rtol=1e-5)
        np.testing.assert_allclose(steps.reward_terms["reward_distance"][t], -distance, rtol=1e-5)
        assert steps.terminated[t] == (distance < 0.01)


def test_the_example_ends_where_the_target_is_reached():
    at_target = dataclasses.replace(
        reach,
        reset=lambda key, initial: initial.replace(qpos=jnp.array([0.0, 0.0, 0.2, 0.0])),
    )
    _, steps = rollout(MujocoEnv(at_target, EngineChoice("native")), jnp.zeros((1, 2)), None)
    assert steps.terminated[0]


@pytest.mark.slow
def test_the_example_is_the_same_on_both_engines():
    assert_engines_agree(reach, 2e-5)


def test_resets_are_the_tasks_own_and_new_each_time():
    limit, num_envs = 3, 4
    env = VectorEnv(MujocoEnv(reach, EngineChoice("native")), num_envs, limit)
    state = env.init(jax.random.key(0))
    step, starts = jax.jit(env.step), [np.asarray(state.obs)]
    for _ in range(3 * limit):
        state, stepped = step(state, jnp.zeros((num_envs, 2)))
        if np.all(stepped.truncated):
            starts.append(np.asarray(stepped.next_obs))
    targets = np.concatenate(starts)[:, 6:8]
    assert len(np.unique(targets, axis=0)) == len(targets) == 4 * num_envs
    np.testing.assert_allclose(np.linalg.norm(targets, axis=1), 0.15, rtol=1e-5)


# --- defaults and other models -------------------------------------------------------------------


def test_defaults_are_all_positions_and_velocities_the_models_start_and_no_end():
    env = MujocoEnv(hinge(), EngineChoice("native"))
    assert (env.spec.name, env.spec.obs_size, env.spec.max_episode_steps) == ("Hinge", 2, 1000)
    assert (env.spec.action_low, env.spec.action_high) == ((-1.0,), (2.0,))
    assert env.spec.gymnasium_id is None
    obs, steps = rollout(env, jnp.full((NUM_STEPS, 1), 2.0), jax.random.key(0))
    np.testing.assert_array_equal(obs, 0.0)
    assert not np.any(steps.terminated)
    # x_velocity is that of qpos[0], the mean over the step.
    positions = np.concatenate([[0.0], steps.obs[:, 0]])
    np.testing.assert_allclose(steps.reward, np.diff(positions) / 0.002, rtol=1e-3)


def test_noise_and_frame_skip_without_a_reset_of_ones_own():
    noisy = MujocoEnv(hinge(qpos_noise=0.5, qvel_noise=0.1, frame_skip=7), EngineChoice("native"))
    obs = np.asarray(jax.vmap(noisy.reset)(jax.random.split(jax.random.key(0), 200))[1])
    assert 0.4 < np.abs(obs[:, 0]).max() <= 0.5
    assert 0.08 < np.abs(obs[:, 1]).max() <= 0.1
    assert noisy.engine.dt == pytest.approx(7 * 0.002)


def test_a_file_of_gymnasiums_that_is_no_task_here():
    env = make_env(Task("Swimmer", "swimmer.xml", forward, frame_skip=4))
    assert (env.spec.obs_size, env.spec.action_size) == (10, 2)


def test_an_equal_task_has_the_same_engine_and_a_list_will_do():
    tasks = [hinge(derived=names) for names in (["xpos"], ("xpos",))]
    assert tasks[0] == tasks[1]
    assert make_env(tasks[0], "native").engine is make_env(tasks[1], "native").engine


def test_the_five_are_recentred_and_name_their_twin():
    for name, task in TASKS.items():
        assert task.recentre_root
        assert task.gymnasium_id == f"{name}-v5"


ARM_AND_BALL = """
<mujoco>
  <option timestep="0.005" integrator="{integrator}"/>
  <worldbody>
    <body name="arm">
      <joint name="j" axis="0 1 0" damping=".05"/><geom size=".05" fromto="0 0 0 .5 0 0"
       type="capsule" contype="0" conaffinity="0"/><site name="hand" pos=".5 0 0"/>
    </body>
    <body name="ball" pos="2 1 1"><freejoint/><geom size=".1" contype="0" conaffinity="0"/></body>
  </worldbody>
  <actuator>
    <general joint="j" ctrlrange="-1 1" dyntype="filter" dynprm=".05" gainprm="3"/>
    <position joint="j" ctrlrange="-2 2" kp="2"/>
  </actuator>
  <sensor><framepos objtype="site" objname="hand"/><jointvel joint="j"/>
    <framelinvel objtype="body" objname="ball"/></sensor>
</mujoco>
"""
ALL_BUT_CONTACTS = (
    "xpos", "xquat", "xipos", "subtree_com", "geom_xpos", "site_xpos", "sensordata",
    "actuator_force", "qfrc_actuator", "cvel", "cinert",
)  # fmt: skip


@pytest.mark.parametrize(
    "integrator",
    ["Euler", *(pytest.param(i, marks=pytest.mark.slow) for i in ("RK4", "implicitfast"))],
)
def test_engines_agree_on_activations_free_bodies_and_all_quantities(integrator):
    """Nothing is taken for a root that could be moved, nor is an actuator's state forgotten."""

    def observe(q):
        return jnp.concatenate([q.qpos, q.qvel, *(q.derived[n].ravel() for n in ALL_BUT_CONTACTS)])

    task = Task(
        "ArmAndBall",
        ARM_AND_BALL.format(integrator=integrator),
        forward,
        observe=observe,
        derived=ALL_BUT_CONTACTS,
        qpos_noise=0.3,
        qvel_noise=0.5,
        frame_skip=3,
    )
    assert_engines_agree(task, 2e-4)


def test_where_the_root_is_recentred_positions_are_the_worlds():
    """A cart far out: what is derived moves with it, on mjx as on native, and so does its speed,
    and what is the world's stays.
    """
    cart = joint_model().replace('axis="0 1 0"', 'type="slide" axis="1 0 0"')
    cart = cart.replace("<worldbody>", '<worldbody><site pos="3 0 1"/>')
    derived = ("xpos", "xipos", "subtree_com", "geom_xpos", "site_xpos")

    def observe(q):
        return jnp.concatenate([q.qpos, q.qvel, *(q.derived[name].ravel() for name in derived)])

    task = hinge(
        xml_file=cart.replace("<geom", '<geom mass=".02"'),
        observe=observe,
        derived=derived,
        reset=lambda key, start: start.replace(qpos=jnp.array([500.0])),
        frame_skip=2,
        recentre_root=True,
    )
    assert_engines_agree(task, 2e-6)


def test_mjx_takes_the_models_solver_and_few_iterations_of_its_own():
    cg = joint_model().replace("<mujoco>", '<mujoco><option solver="CG"/>')
    fast = MjxEngine(hinge(xml_file=cg), "fast").model.opt
    assert fast.solver == mujoco.mjtSolver.mjSOL_CG
    assert fast.iterations == max(budget.newton for budget in FAST_ITERATIONS.values())


# --- what is refused -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"xml_file": "hinge.xml"}, r"'hinge.xml' is not among.*xml_file=Path\('hinge.xml'\)"),
        ({"xml_file": Path("no/hinge.xml")}, r"there is no file '/.*no/hinge.xml'"),
        ({"xml_file": "<mujoco><worldbody><body><joint/></worldbody></mujoco>"},
         "task 'Hinge': its MJCF does not compile: XML parse error"),
        ({"xml_file": joint_model(actuator="")}, "no actuators.*<actuator>"),
        ({"xml_file": "<mujoco/>"}, "has no joint"),
        ({"xml_file": joint_model('<motor name="m" joint="j"/><motor joint="j"/>')},
         r"without a range of control: m, number 1; give each a ctrlrange"),
        ({"derived": ("sensordata",)}, "nothing that derived='sensordata' could report"),
        ({"derived": ("ximat",)}, r"derived=\('ximat',\): must be names among .*xpos"),
        ({"derived": ("xpos", "xpos")}, "must be names that differ"),
        ({"measure": "head"}, "measure='head': must be one of root, torso, mass_center"),
        ({"frame_skip": 0}, "frame_skip=0: must be a whole number of at least 1"),
        ({"max_episode_steps": 2.5}, "max_episode_steps=2.5: must be a whole number"),
        ({"qvel_noise": -1.0}, "qvel_noise=-1.0: must be a finite number, 0 or more"),
        ({"terminated": True}, "terminated=True: must be a function"),
        ({"recentre_root": True}, "first joint that is neither free nor a slide along x"),
        ({"recentre_root": True, "derived": ("sensordata",)}, "without sensordata"),
        ({"reward_terms": lambda q, a, v: v}, "must give a dict of one or more scalars"),
        ({"reward_terms": lambda q, a, v: {}}, "must give a dict of one or more scalars"),
        ({"reward_terms": lambda q, a, v: {"r": q.qvel}}, r"gives 'r' of shape \(1,\)"),
        ({"observe": lambda q: q.derived["xpos"][0]}, r"derived=\(\): has no 'xpos'"),
        ({"observe": lambda q: {"qpos": q.qpos}}, r"observe gives \{.*must be a vector \[O\]"),
        ({"observe": lambda q: q.qpos[None]}, r"must be a vector \[O\] of float32"),
        ({"reset": lambda key, start: start.replace(qvel=jnp.zeros(3))},
         r"reset gives qvel of shape \(3,\): must be \(1,\)"),
        ({"terminated": lambda q: q.qpos > 0}, r"terminated is bool\[1\]: must be bool\[\]"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_with_the_tasks_name_and_the_remedy(fields, message):
    with pytest.raises(ConfigError, match=message):
        make_env(hinge(**fields), "native")


def test_mjx_refuses_delays_of_the_model():
    delayed = joint_model('<motor joint="j" ctrlrange="-1 1" delay="0.02" nsample="4"/>')
    try:
        task = hinge(xml_file=delayed)
        make_env(task, "native")
    except ConfigError as error:  # MuJoCo from before there were delays
        pytest.skip(str(error))
    with pytest.raises(ConfigError, match=r"'Hinge': its model delays .*use engine=native"):
        make_env(task, "mjx")


def test_mjx_says_what_it_cannot_run():
    damper = joint_model('<damper joint="j" kv="1" ctrlrange="0 1"/>').replace(
        "<mujoco>", '<mujoco><option integrator="implicit"/>'
    )
    make_env(hinge(xml_file=damper), "native")
    with pytest.raises(ConfigError, match=r"engine='mjx'.*'Hinge'.*use engine=native"):
        make_env(hinge(xml_file=damper), "mjx")

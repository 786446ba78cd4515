"""The native engine against Gymnasium itself, and as a pure function inside jit, scan and vmap."""

from __future__ import annotations

import functools
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from sacformer_jax.envs import native_host
from sacformer_jax.envs.mujoco_env import MujocoEnv
from sacformer_jax.envs.native import NativeEngine
from sacformer_jax.envs.native_host import STATE_SPEC, Worker
from sacformer_jax.envs.physics import EngineChoice, ResetNoise
from sacformer_jax.envs.tasks import TASKS

NUM_STEPS = 1000
NUM_FAR_STEPS = 50
WITH_CONTACT_FORCES = ("Ant", "Humanoid")
# Under random actions these three fall over, and the trajectory goes on through it.
FALLING = ("Hopper", "Walker2d", "Humanoid")


# --- helpers ---------------------------------------------------------------------------------


@functools.cache
def make(name: str) -> MujocoEnv:
    return MujocoEnv(name, EngineChoice("native"))


def physics_of(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    state = np.zeros(mujoco.mj_stateSize(model, STATE_SPEC))
    mujoco.mj_getState(model, data, state, STATE_SPEC)
    return state


def measured_xy(env: MujocoEnv, unwrapped: gymnasium.Env) -> np.ndarray:
    """What the forward reward measures, by Gymnasium's own definitions."""
    model, data = unwrapped.model, unwrapped.data
    if env.task.measure == "root":
        return np.array([data.qpos[0], 0.0])
    if env.task.measure == "torso":
        return data.body("torso").xpos[:2].copy()
    centre = np.einsum("b,bj->j", model.body_mass, data.xipos) / model.body_mass.sum()
    return centre[:2]


def words_from(env: MujocoEnv, unwrapped: gymnasium.Env) -> jax.Array:
    """Our packed state, taken from Gymnasium's ``MjData``."""
    physics = physics_of(unwrapped.model, unwrapped.data)
    return jnp.asarray(env.engine.pack_state(physics, measured_xy(env, unwrapped)))


def edit_state(engine: NativeEngine, words: jax.Array, field: str, value: float) -> jax.Array:
    """The packed state with the last entry of ``qpos`` or ``qvel`` replaced."""
    physics, measured = engine.unpack_state(np.asarray(words))
    data = mujoco.MjData(engine.model)
    mujoco.mj_setState(engine.model, data, physics.copy(), STATE_SPEC)
    getattr(data, field)[-1] = value
    return jnp.asarray(engine.pack_state(physics_of(engine.model, data), measured))


def gymnasium_rollout(unwrapped: gymnasium.Env, actions: np.ndarray) -> SimpleNamespace:
    """Steps Gymnasium, never resetting, and records everything."""
    steps, data = [], unwrapped.data
    for action in actions:
        obs, reward, terminated, _, info = unwrapped.step(action)
        terms = {name: info[name] for name in info if name.startswith("reward_")}
        physics = physics_of(unwrapped.model, data)
        row = (physics, data.qpos.copy(), data.qvel.copy(), obs, reward, terminated, terms)
        steps.append(row)
    *columns, terms = zip(*steps, strict=True)
    names = ("physics", "qpos", "qvel", "obs", "reward", "terminated")
    return SimpleNamespace(
        **dict(zip(names, map(np.array, columns), strict=True)),
        terms={name: np.array([term[name] for term in terms]) for name in terms[0]},
    )


def assert_trees_equal(actual, expected) -> None:
    """Bit for bit: same structure, dtypes and values."""
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


def assert_rewards_close(step, reference: SimpleNamespace) -> None:
    """Within 1e-5 of the largest term, since terms of both signs cancel in the sum."""
    scale = np.max(np.abs(list(reference.terms.values())), axis=0)
    assert np.all(np.abs(step.reward - reference.reward) <= 1e-5 * scale)


def random_noise(engine: NativeEngine, *shape: int) -> ResetNoise:
    rng = np.random.default_rng(7)
    qpos = rng.uniform(-0.1, 0.1, (*shape, engine.nq)).astype(np.float32)
    qvel = rng.uniform(-0.1, 0.1, (*shape, engine.nv)).astype(np.float32)
    return ResetNoise(qpos=jnp.asarray(qpos), qvel=jnp.asarray(qvel))


def random_actions(engine: NativeEngine, *shape: int, seed: int = 8) -> jax.Array:
    low, high = np.asarray(engine.action_low), np.asarray(engine.action_high)
    actions = np.random.default_rng(seed).uniform(low, high, (*shape, low.size))
    return jnp.asarray(actions.astype(np.float32))


# --- parity with Gymnasium -------------------------------------------------------------------


@pytest.fixture(scope="module", params=TASKS)
def case(request):
    """One task, its Gymnasium twin, and the same 1,000 random actions played on both.

    A second copy starts at x = 500 m; of that Gymnasium plays the first 50 steps.
    """
    env = make(request.param)
    unwrapped = gymnasium.make(env.spec.gymnasium_id).unwrapped
    unwrapped.reset(seed=1)
    unwrapped.action_space.seed(2)
    actions = np.stack([unwrapped.action_space.sample() for _ in range(NUM_STEPS)])
    start = words_from(env, unwrapped)
    reference = gymnasium_rollout(unwrapped, actions)
    unwrapped.reset(seed=3)
    qpos = unwrapped.data.qpos.copy()
    qpos[0] += 500.0
    unwrapped.set_state(qpos, unwrapped.data.qvel.copy())
    far_start = words_from(env, unwrapped)
    far_reference = gymnasium_rollout(unwrapped, actions[:NUM_FAR_STEPS])

    @jax.jit
    def rollout(words, actions):
        def body(words, action):
            words, step = jax.vmap(env.step, in_axes=(0, None))(words, action)
            return words, (words, step)

        return jax.lax.scan(body, words, actions)[1]

    both = jax.device_get(rollout(jnp.stack([start, far_start]), actions))
    words, step = jax.tree.map(lambda x: x[:, 0], both)
    far_words, far_step = jax.tree.map(lambda x: x[:NUM_FAR_STEPS, 1], both)
    yield SimpleNamespace(
        name=request.param,
        env=env,
        unwrapped=unwrapped,
        actions=actions,
        words=words,
        step=step,
        reference=reference,
        far_words=far_words,
        far_step=far_step,
        far_reference=far_reference,
    )
    unwrapped.close()


def test_spec_is_gymnasiums(case):
    spec, unwrapped = case.env.spec, case.unwrapped
    registered = gymnasium.spec(spec.gymnasium_id)
    assert (spec.obs_size,) == unwrapped.observation_space.shape
    assert (spec.action_size,) == unwrapped.action_space.shape
    np.testing.assert_array_equal(np.float32(spec.action_low), unwrapped.action_space.low)
    np.testing.assert_array_equal(np.float32(spec.action_high), unwrapped.action_space.high)
    assert spec.max_episode_steps == registered.max_episode_steps
    assert case.env.engine.dt == unwrapped.dt


def test_trajectory_equals_gymnasiums_to_the_last_bit(case):
    physics, _ = case.env.engine.unpack_state(case.words)
    expected, model = case.reference, case.unwrapped.model
    assert physics.dtype == expected.physics.dtype == np.float64
    different = np.flatnonzero(np.any(physics != expected.physics, axis=1))
    assert different.size == 0, f"first different step: {different[0]}"
    # That was MuJoCo's whole state; see that it does hold the positions and velocities.
    qpos, qvel = np.split(physics[:, 1 : 1 + model.nq + model.nv], [model.nq], axis=1)
    np.testing.assert_array_equal(qpos, expected.qpos)
    np.testing.assert_array_equal(qvel, expected.qvel)
    assert np.all(np.std(qpos, axis=0) > 0)


def test_observations_equal_gymnasiums(case):
    assert case.step.obs.dtype == np.float32
    np.testing.assert_allclose(case.step.obs, case.reference.obs, rtol=1e-5, atol=1e-12)
    if case.name in WITH_CONTACT_FORCES:
        # cfrc_ext ends both observations: 6 numbers per body but the world.
        contact_forces = case.step.obs[:, -6 * (case.unwrapped.model.nbody - 1) :]
        touching = np.any(contact_forces != 0, axis=1)
        assert touching.sum() > NUM_STEPS // 10


def test_rewards_and_their_terms_equal_gymnasiums(case):
    terms, expected = case.step.reward_terms, case.reference.terms
    assert terms.keys() == expected.keys()
    for name in expected:
        np.testing.assert_allclose(terms[name], expected[name], rtol=1e-5, atol=1e-12, err_msg=name)
        assert np.any(expected[name] != 0), f"{name} is never tested"
    assert_rewards_close(case.step, case.reference)


def test_terminations_equal_gymnasiums(case):
    np.testing.assert_array_equal(case.step.terminated, case.reference.terminated)
    assert not np.any(case.step.bad)
    if case.name in FALLING:
        assert 0 < np.sum(case.step.terminated) < NUM_STEPS


def test_rewards_far_from_the_origin(case):
    physics, _ = case.env.engine.unpack_state(case.far_words)
    assert np.all(case.far_reference.qpos[:, 0] > 400.0)
    np.testing.assert_array_equal(physics, case.far_reference.physics)
    assert_rewards_close(case.far_step, case.far_reference)
    assert np.max(np.abs(case.far_step.reward - case.far_reference.reward)) < 1e-3


def test_a_state_is_complete_and_nothing_stale_leaks_into_a_step(case):
    # From the middle of the trajectory, on an MjData that has meanwhile been elsewhere.
    engine, middle = case.env.engine, 300
    step = jax.jit(engine.step)
    words, action = jnp.asarray(case.words[middle]), case.actions[middle + 1]
    first = step(words, action)
    np.testing.assert_array_equal(np.asarray(first.state), case.words[middle + 1])
    step(jnp.asarray(case.words[-1]), case.actions[0])
    step(edit_state(engine, words, "qvel", 1e12), case.actions[1])
    engine.reset(random_noise(engine))
    step(words, jnp.full_like(action, jnp.nan))
    assert_trees_equal(step(words, action), first)


# --- inside jit, scan and vmap ---------------------------------------------------------------


@pytest.fixture(scope="module")
def ant():
    """Two threads' engine; states in contact with the floor; the scan and its batched form."""
    engine = NativeEngine(TASKS["Ant"], num_threads=2)

    def rollout(step):
        def body(words, action):
            physics = step(words, action)
            return physics.state, physics

        return jax.jit(lambda words, actions: jax.lax.scan(body, words, actions)[1])

    single = rollout(engine.step)
    start = engine.reset(random_noise(engine)).state
    physics = single(start, random_actions(engine, 100))
    touching = np.any(np.asarray(physics.quantities.derived["cfrc_ext"]) != 0, axis=(1, 2))
    states = physics.state[np.flatnonzero(touching)[-6:]]
    return SimpleNamespace(
        engine=engine,
        single=single,
        batched=rollout(jax.vmap(jax.vmap(engine.step))),
        states=states.reshape(2, 3, -1),  # seeds × environments
        actions=random_actions(engine, 100, 2, 3, seed=9),
    )


def test_seeds_by_environments_is_one_host_call_a_step_and_equals_single_calls(ant):
    jax.block_until_ready(ant.states)
    before = ant.engine.host_calls
    batched = jax.block_until_ready(ant.batched(ant.states, ant.actions))
    assert ant.engine.host_calls - before == 100
    for seed, env in np.ndindex(2, 3):
        single = ant.single(ant.states[seed, env], ant.actions[:, seed, env])
        assert_trees_equal(jax.tree.map(lambda x, i=(seed, env): x[:, *i], batched), single)


def test_a_batch_of_resets_is_one_host_call_and_equals_single_resets(ant):
    engine, noise = ant.engine, random_noise(ant.engine, 2, 2)
    before = engine.host_calls
    batched = jax.block_until_ready(jax.vmap(jax.vmap(engine.reset))(noise))
    assert engine.host_calls - before == 1
    for i in np.ndindex(2, 2):
        single = engine.reset(jax.tree.map(lambda x, i=i: x[i], noise))
        assert_trees_equal(jax.tree.map(lambda x, i=i: x[i], batched), single)


def test_a_batch_is_shared_between_threads(ant, monkeypatch):
    calls, step, both_are_in = [], Worker.step, threading.Barrier(2)

    def recorded(worker, inputs, outputs, chunk):
        caller = (threading.get_ident(), id(worker))
        if caller not in (earlier for earlier, _ in calls):
            both_are_in.wait(timeout=60)
        calls.append((caller, list(chunk)))
        step(worker, inputs, outputs, chunk)

    monkeypatch.setattr(Worker, "step", recorded)
    jax.block_until_ready(jax.vmap(jax.vmap(ant.engine.step))(ant.states, ant.actions[0]))
    # Each environment once, by two threads with an MjData each.
    assert sorted(i for _, chunk in calls for i in chunk) == list(range(6))
    callers = {caller for caller, _ in calls}
    assert len({thread for thread, _ in callers}) == len({worker for _, worker in callers}) == 2


def test_little_work_and_a_busy_pool_stay_on_the_calling_thread(ant, monkeypatch):
    step, expected = jax.vmap(ant.engine.step), ant.batched(ant.states, ant.actions)
    expected = jax.block_until_ready(jax.tree.map(lambda x: x[0, 0], expected))
    pool = ant.engine.threads.pool
    submitted, submit = [], pool.submit
    monkeypatch.setattr(
        pool, "submit", lambda *args: submitted.append(submit(*args)) or submitted[-1]
    )
    with monkeypatch.context() as patched:
        patched.setattr(native_host, "_WORTH_SHARING", 1e9)
        assert_trees_equal(step(ant.states[0], ant.actions[0, 0]), expected)
    assert not submitted
    released = threading.Event()
    for _ in range(ant.engine.num_threads):
        submit(released.wait, 60)
    assert_trees_equal(step(ant.states[0], ant.actions[0, 0]), expected)
    assert not released.is_set()
    released.set()
    assert [helper.cancelled() for helper in submitted] == [True]


@pytest.mark.parametrize(
    ("name", "num_envs", "shared"),
    [
        ("HalfCheetah", 4, False),  # 5 frames of 9 degrees of freedom each
        ("Hopper", 2, False),  # 4 frames of 4 evaluations of 6
        ("Hopper", 8, True),
        ("Humanoid", 1, False),
        ("Humanoid", 2, True),
    ],
)
def test_a_batch_is_shared_where_that_is_worth_it(name, num_envs, shared, monkeypatch):
    engine = NativeEngine(TASKS[name], num_threads=2)
    words = jax.vmap(engine.reset)(random_noise(engine, num_envs)).state
    submitted, submit = [], engine.threads.pool.submit
    monkeypatch.setattr(
        engine.threads.pool, "submit", lambda *args: submitted.append(args) or submit(*args)
    )
    jax.block_until_ready(jax.vmap(engine.step)(words, random_actions(engine, num_envs)))
    assert bool(submitted) == shared


@pytest.mark.parametrize("broken", [0, 1], ids=["calling", "helping"])
def test_an_exception_in_a_thread_surfaces_when_none_works_any_more(ant, monkeypatch, broken):
    workers, step, both_are_in = ant.engine.threads.workers, Worker.step, threading.Barrier(2)
    entered, started, ended = set(), [], []

    def breaking(worker, *args):
        if worker not in entered:
            entered.add(worker)
            both_are_in.wait(timeout=60)
        if worker is workers[broken]:
            raise ValueError("this one breaks")
        started.append(worker)
        time.sleep(0.05)  # still at it when the other has ended
        step(worker, *args)
        ended.append(worker)

    expected = jax.block_until_ready(ant.batched(ant.states, ant.actions[:1]))
    with monkeypatch.context() as patched:
        patched.setattr(Worker, "step", breaking)
        with pytest.raises(Exception, match="ValueError: this one breaks"):
            jax.block_until_ready(ant.batched(ant.states, ant.actions[:1]))
        assert started == ended == [workers[1 - broken]] * len(started)
        assert started
    assert not any(worker.lock.locked() for worker in workers)
    assert_trees_equal(ant.batched(ant.states, ant.actions[:1]), expected)


def test_a_helper_left_by_an_interrupted_call_keeps_its_mjdata(ant, monkeypatch):
    engine = NativeEngine(TASKS["Ant"], num_threads=3)
    batched = jax.vmap(jax.vmap(engine.step))
    expected = jax.tree.map(lambda x: x[0], ant.batched(ant.states, ant.actions))
    jax.block_until_ready(expected)
    step, left, released = Worker.step, threading.Event(), threading.Event()

    def slow(worker, *args):
        if worker is not engine.threads.workers[1]:
            left.wait(60)
        elif not left.is_set():
            left.set()
            released.wait(60)
        else:
            assert released.is_set()
        step(worker, *args)

    def interrupted(helpers):
        raise KeyboardInterrupt

    monkeypatch.setattr(Worker, "step", slow)
    with monkeypatch.context() as patched:
        patched.setattr(native_host, "wait", interrupted)
        with pytest.raises(BaseException, match="KeyboardInterrupt"):
            jax.block_until_ready(batched(ant.states, ant.actions[0]))
    assert engine.threads.workers[1].lock.locked()
    threading.Timer(0.2, released.set).start()
    assert_trees_equal(batched(ant.states, ant.actions[0]), expected)


def test_no_environments_do_no_harm():
    engine = make("Ant").engine
    noise, ctrl = random_noise(engine, 0), random_actions(engine, 0)
    fresh = jax.vmap(engine.reset)(noise)
    assert fresh.state.shape == (0, engine.reset(random_noise(engine)).state.size)
    stepped = jax.vmap(engine.step)(fresh.state, ctrl)
    both = engine.step_and_reset(fresh.state, ctrl, jnp.zeros(0, bool), noise)
    for physics in (stepped, *both):
        assert_trees_equal(physics, fresh)


@pytest.mark.parametrize("num_threads", [1, 4, 9])
def test_results_do_not_depend_on_the_number_of_threads(ant, num_threads):
    engine = NativeEngine(TASKS["Ant"], num_threads=num_threads)
    assert engine.num_threads == num_threads
    step = jax.vmap(jax.vmap(engine.step))
    words, expected = ant.states, ant.batched(ant.states, ant.actions)
    for t in range(3):
        physics = step(words, ant.actions[t])
        words = physics.state
        assert_trees_equal(physics, jax.tree.map(lambda x, t=t: x[t], expected))


def test_two_programs_at_once_get_their_own_results(ant, monkeypatch):
    arguments = {
        "single": (ant.single, ant.states[0, 0], ant.actions[:, 0, 0]),
        "batched": (ant.batched, ant.states, ant.actions),
    }
    expected = {key: jax.device_get(f(*args)) for key, (f, *args) in arguments.items()}
    busy, shared, users, step = set(), [], set(), Worker.step

    def guarded(worker, *args):
        # An MjData in two threads' hands at once is the bug to catch, lucky results or not.
        shared.append(id(worker) in busy)
        if shared[-1]:
            return  # stepping would crash the process
        users.add((id(worker), threading.get_ident()))
        busy.add(id(worker))
        step(worker, *args)
        busy.discard(id(worker))

    monkeypatch.setattr(Worker, "step", guarded)
    results, start_line = {}, threading.Barrier(2)

    def run(key):
        program, *args = arguments[key]
        start_line.wait()
        results[key] = [jax.device_get(program(*args)) for _ in range(3)]

    threads = [threading.Thread(target=run, args=(key,)) for key in arguments]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not any(shared)
    # The first MjData serves the calling threads, of which there were several.
    assert max(np.unique([worker for worker, _ in users], return_counts=True)[1]) > 1
    for key, repetitions in results.items():
        for result in repetitions:
            assert_trees_equal(result, expected[key])


@pytest.mark.parametrize("name", ["Hopper", "Humanoid"])
def test_step_and_reset_equals_step_and_reset_apart(name):
    engine = make(name).engine
    noise, fresh_noise = random_noise(engine, 4), random_noise(engine, 5)
    fresh_noise = jax.tree.map(lambda x: x[1:], fresh_noise)
    words = jax.vmap(engine.reset)(noise).state
    ctrl, reset = random_actions(engine, 4), jnp.array([True, False, True, False])
    before = engine.host_calls
    both = engine.step_and_reset(words, ctrl, reset, fresh_noise)
    stepped, fresh = jax.block_until_ready(both)
    assert engine.host_calls - before == 1
    assert_trees_equal(stepped, jax.vmap(engine.step)(words, ctrl))
    apart = jax.vmap(engine.reset)(fresh_noise)
    assert_trees_equal(*(jax.tree.map(lambda x: x[::2], tree) for tree in (fresh, apart)))
    assert np.any(np.asarray(apart.quantities.qpos[1::2]) != 0)
    for leaf in jax.tree.leaves(jax.tree.map(lambda x: x[1::2], fresh)):
        assert not np.any(np.asarray(leaf))


def test_every_breakdown_of_the_physics_is_reported_and_stays_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo may write a log into the working directory
    engine = make("Hopper").engine
    words = engine.reset(random_noise(engine)).state
    states = jnp.stack(
        [
            words,
            edit_state(engine, words, "qpos", np.nan),
            edit_state(engine, words, "qvel", 1e12),
            edit_state(engine, words, "qvel", 1e9),  # allowed; the acceleration is not
            words,
            words,
        ]
    )
    ctrl = jnp.zeros((6, 3)).at[4].set(jnp.nan)
    physics = jax.vmap(engine.step)(states, ctrl)
    assert physics.bad.tolist() == [False, True, True, True, True, False]
    alone = engine.step(words, ctrl[0])
    for i in (0, 5):
        assert_trees_equal(jax.tree.map(lambda x, i=i: x[i], physics), alone)
    # Nothing is remembered: the same worker's next step is not bad.
    assert not engine.step(words, ctrl[0]).bad


@pytest.mark.parametrize("name", ["HalfCheetah", "Ant", "Humanoid"])
def test_a_breakdown_within_a_chunk_is_that_of_one_environment(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo may write a log into the working directory
    engine = NativeEngine(TASKS[name], num_threads=1)
    words, bad = jax.vmap(engine.reset)(random_noise(engine, 16)).state, [2, 5, 6]
    for i in bad:
        words = words.at[i].set(edit_state(engine, words[i], "qvel", 1e12))
    ctrl, chunks, step = random_actions(engine, 16), [], Worker.step

    def recorded(worker, inputs, outputs, chunk):
        chunks.append(len(chunk))
        step(worker, inputs, outputs, chunk)

    monkeypatch.setattr(Worker, "step", recorded)
    physics = jax.vmap(engine.step)(words, ctrl)
    assert chunks[0] == 8  # the bad ones among others
    assert np.flatnonzero(physics.bad).tolist() == bad
    for i in set(range(16)) - set(bad):
        alone = engine.step(words[i], ctrl[i])
        assert_trees_equal(jax.tree.map(lambda x, i=i: x[i], physics), alone)


def test_packing_and_unpacking_a_state():
    engine = make("Hopper").engine
    physics = np.array([np.pi, -0.0, 1e-300, np.inf, np.nan])
    words = engine.pack_state(physics, np.array([500.25, -1.0]))
    assert words.dtype == np.uint32
    assert words.shape == (14,)
    unpacked, measured = engine.unpack_state(np.stack([words, words]))
    assert unpacked.tobytes() == 2 * physics.tobytes()
    np.testing.assert_array_equal(measured, [[500.25, -1.0]] * 2)


# --- deadlocks -------------------------------------------------------------------------------

# Host calls and XLA's own thread pool share the cores; a callback that waits for that pool (by
# any use of jax inside it, say) hangs, but only now and then. In a process of its own, because a
# hung computation cannot be ended from within.
_MANY_CALLS = """
import sys
import jax, jax.numpy as jnp
from sacformer_jax.envs.core import VectorEnv
from sacformer_jax.envs import make_env

chunks, chunk = int(sys.argv[1]), 1000
env = VectorEnv(make_env("Hopper", "native"), 2)
weights = jax.random.normal(jax.random.key(5), (256, 256)) / 16

@jax.jit
def roll(state, x, key):
    def body(carry, key):
        state, x = carry
        state, step = jax.vmap(env.step)(state, jax.vmap(env.random_action)(jax.random.split(key)))
        return (state, jnp.tanh(x @ weights)), step.reward
    return jax.lax.scan(body, (state, x), jax.random.split(key, chunk))

state, x = jax.jit(jax.vmap(env.init))(jax.random.split(jax.random.key(0))), jnp.ones((256, 256))
before = jax.block_until_ready(state) and env.env.engine.host_calls
for i in range(chunks):
    (state, x), reward = jax.block_until_ready(roll(state, x, jax.random.key(i)))
    assert jnp.all(jnp.isfinite(reward)) and jnp.all(jnp.isfinite(x))
print("host calls:", env.env.engine.host_calls - before)
"""


@pytest.mark.parametrize(
    "num_calls", [2_000, pytest.param(100_000, marks=pytest.mark.slow)], ids=str
)
def test_many_host_calls_beside_matrix_products_do_not_hang(num_calls):
    finished = subprocess.run(
        [sys.executable, "-c", _MANY_CALLS, str(num_calls // 1000)],
        capture_output=True,
        text=True,
        timeout=300 + num_calls // 20,  # far beyond what it takes: only a hang gets there
        check=False,
    )
    assert finished.returncode == 0, finished.stderr
    assert finished.stdout.split("\n")[-2] == f"host calls: {num_calls}"

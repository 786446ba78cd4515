"""Time limit, auto-reset and bad physics; the same on the native engine; reset distributions."""

from __future__ import annotations

from types import SimpleNamespace

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from compiling import with_users_loops
from scipy import stats

from sacformer_jax.envs import TASKS, VectorEnv, make_env
from sacformer_jax.envs.core import EnvSpec, EnvStep, JaxEnv

# --- an environment that does what it is told ------------------------------------------------

GO, TERMINATE, FLAG_BAD, NAN_OBS, INF_REWARD, BAD_TERM = range(6)
LIMIT, NUM_ENVS, NUM_STEPS = 5, 4, 14


class CountingEnv(JaxEnv):
    """Observes which episode this is (a random number) and its own count of steps.

    The action is a command; the reward is 100 + the count, so that no reward is 0 by itself.
    """

    spec = EnvSpec(
        name="counting",
        obs_size=2,
        action_size=1,
        action_low=(0.0,),
        action_high=(5.0,),
        max_episode_steps=1000,
        engine="none",
        engine_reason="a test",
    )

    def reset(self, key):
        state = jnp.stack([jax.random.uniform(key), 0.0])
        return state, state

    def step(self, state, action):
        state = state + jnp.array([0.0, 1.0])
        command, reward = action[0], 100.0 + state[1]
        return state, EnvStep(
            obs=jnp.where(command == NAN_OBS, jnp.array([jnp.nan, 1.0]) * state, state),
            reward=jnp.where(command == INF_REWARD, jnp.inf, reward),
            # Broken physics may say anything, "terminated" too.
            terminated=command > GO,
            bad=command == FLAG_BAD,
            reward_terms={"reward_count": jnp.where(command > TERMINATE, jnp.nan, reward)},
        )


def commands(*scripts: dict[int, int]) -> jax.Array:
    """Actions ``[T, N, 1]``; each environment's script tells step → command."""
    actions = np.zeros((NUM_STEPS, NUM_ENVS, 1), np.float32)
    for env, script in enumerate(scripts):
        for step, command in script.items():
            actions[step, env] = command
    return jnp.asarray(actions)


@pytest.fixture(scope="module")
def counting():
    env = VectorEnv(CountingEnv(), NUM_ENVS, max_episode_steps=LIMIT)

    def rollout(key, actions):
        def body(state, action):
            state, step = env.step(state, action)
            return state, (step, state.time_step)

        state = env.init(key)
        return state.obs, *jax.lax.scan(body, state, actions)[1]

    jitted = jax.jit(rollout)

    def play(seed, actions):
        first_obs, step, time_step = jax.device_get(jitted(jax.random.key(seed), actions))
        return SimpleNamespace(
            first_obs=first_obs,
            step=step,
            time_step=time_step,
            # What was acted on at each step.
            obs_before=np.concatenate([first_obs[None], step.next_obs[:-1]]),
        )

    return SimpleNamespace(env=env, rollout=rollout, jitted=jitted, play=play)


def steps_where(mask: np.ndarray) -> list[int]:
    return np.flatnonzero(mask).tolist()


def test_time_limit_truncates_exactly_and_is_not_a_termination(counting):
    run = counting.play(0, commands())
    for env in range(NUM_ENVS):
        assert steps_where(run.step.truncated[:, env]) == [4, 9]
        assert run.time_step[:, env].tolist() == [1, 2, 3, 4, 0] * 2 + [1, 2, 3, 4]
    assert not np.any(run.step.terminated)
    assert not np.any(run.step.bad)


def test_termination_is_kept_apart_from_truncation(counting):
    # Before the limit; exactly at the limit; at the first step of an episode, twice running.
    run = counting.play(0, commands({2: TERMINATE}, {4: TERMINATE}, {0: TERMINATE, 1: TERMINATE}))
    assert [steps_where(column) for column in run.step.terminated.T] == [[2], [4], [0, 1], []]
    # The time limit counts from each episode's own start.
    assert [steps_where(column) for column in run.step.truncated.T] == [
        [7, 12],
        [9],
        [6, 11],
        [4, 9],
    ]
    np.testing.assert_array_equal(run.step.done, run.step.terminated | run.step.truncated)
    assert run.time_step[:6, 2].tolist() == [0, 0, 1, 2, 3, 4]


def test_final_observation_and_fresh_one_are_both_given(counting):
    run = counting.play(0, commands({2: TERMINATE}, {4: TERMINATE}))
    step, done = run.step, run.step.done
    # `obs` continues the episode acted in, whether or not it ended there.
    np.testing.assert_array_equal(step.obs[..., 0], run.obs_before[..., 0])
    np.testing.assert_array_equal(step.obs[..., 1], run.obs_before[..., 1] + 1)
    np.testing.assert_array_equal(step.reward, 100 + step.obs[..., 1])
    np.testing.assert_array_equal(step.reward_terms["reward_count"], step.reward)
    # `next_obs` is the same within an episode and a fresh reset at its end.
    np.testing.assert_array_equal(step.next_obs[~done], step.obs[~done])
    assert np.all(step.next_obs[done][:, 1] == 0)
    assert np.all(step.next_obs[done][:, 0] != step.obs[done][:, 0])
    np.testing.assert_array_equal(run.time_step, step.next_obs[..., 1])


def test_every_reset_is_new(counting):
    always = dict.fromkeys(range(NUM_STEPS), TERMINATE)
    episodes = []
    for seed in (0, 1):
        run = counting.play(seed, commands(always, {3: TERMINATE, 4: FLAG_BAD}, always))
        episodes += [run.first_obs[:, 0], run.step.next_obs[run.step.done][:, 0]]
        again = counting.play(seed, commands(always, {3: TERMINATE, 4: FLAG_BAD}, always))
        np.testing.assert_array_equal(run.step.next_obs, again.step.next_obs)
    episodes = np.concatenate(episodes)
    assert episodes.size > 2 * 2 * NUM_STEPS
    assert np.unique(episodes).size == episodes.size


@pytest.mark.parametrize("breakdown", [FLAG_BAD, NAN_OBS, INF_REWARD])
@pytest.mark.parametrize("when", [0, 2, LIMIT - 1])
def test_bad_physics_truncates_and_nothing_of_it_leaves(counting, breakdown, when):
    run, twin = (counting.play(0, commands({}, script)) for script in ({when: breakdown}, {}))
    step = run.step
    assert steps_where(step.bad[:, 1]) == [when]
    assert step.truncated[when, 1]
    assert not np.any(step.terminated)
    assert step.reward[when, 1] == 0
    assert step.reward_terms["reward_count"][when, 1] == 0
    np.testing.assert_array_equal(step.obs[when, 1], run.obs_before[when, 1])
    # A fresh episode follows, with its whole time limit.
    assert step.next_obs[when, 1, 1] == 0
    assert step.next_obs[when, 1, 0] != step.obs[when, 1, 0]
    assert steps_where(step.truncated[:, 1])[:2] == [when, when + LIMIT]
    for leaf in jax.tree.leaves(step):
        assert np.all(np.isfinite(leaf))
    others = [0, 2, 3]
    for mine, undisturbed in zip(jax.tree.leaves(step), jax.tree.leaves(twin.step), strict=True):
        np.testing.assert_array_equal(mine[:, others], undisturbed[:, others])


SCRIPTS = ({2: TERMINATE}, {4: TERMINATE, 6: NAN_OBS}, {0: FLAG_BAD, 1: TERMINATE}, {})


def test_the_same_with_and_without_jit(counting):
    first_obs, steps, time_steps = counting.jitted(jax.random.key(3), commands(*SCRIPTS))
    state = counting.env.init(jax.random.key(3))
    np.testing.assert_array_equal(state.obs, first_obs)
    for t in range(8):
        state, step = counting.env.step(state, commands(*SCRIPTS)[t])
        expected = jax.tree.map(lambda x, t=t: x[t], (steps, time_steps))
        jax.tree.map(np.testing.assert_array_equal, (step, state.time_step), expected)


def test_seeds_under_vmap_equal_each_alone(counting):
    keys = jax.random.split(jax.random.key(4), 2)
    actions = jnp.stack([commands(*SCRIPTS), commands(*SCRIPTS[::-1])])
    together = jax.jit(jax.vmap(counting.rollout))(keys, actions)
    for i in range(2):
        alone = counting.jitted(keys[i], actions[i])
        mine = jax.tree.map(lambda x, i=i: x[i], together)
        jax.tree.map(np.testing.assert_array_equal, mine, alone)


def test_random_actions_fill_the_bounds(counting):
    keys = jax.random.split(jax.random.key(0), 500)
    actions = np.asarray(jax.vmap(counting.env.random_action)(keys)).ravel()
    assert stats.kstest(actions, stats.uniform(0, 5).cdf).pvalue > 1e-3
    assert counting.env.random_action(keys[0]).shape == (NUM_ENVS, 1)


def test_limits_of_the_arguments():
    with pytest.raises(ValueError, match="num_envs=0"):
        VectorEnv(CountingEnv(), 0)
    with pytest.raises(ValueError, match="max_episode_steps=0"):
        VectorEnv(CountingEnv(), 1, max_episode_steps=0)
    assert VectorEnv(CountingEnv(), 1).max_episode_steps == 1000
    assert VectorEnv(CountingEnv(), 1, 7).spec.max_episode_steps == 7


def test_an_episode_of_one_step_is_a_fresh_one_each_time():
    env = VectorEnv(CountingEnv(), 2, max_episode_steps=1)
    state, starts = env.init(jax.random.key(0)), []
    for _ in range(4):
        starts.append(np.asarray(state.obs[:, 0]))
        state, step = env.step(state, jnp.zeros((2, 1)))
        assert np.all(step.truncated)
        assert step.obs[:, 1].tolist() == [1.0, 1.0]
    assert np.unique(starts).size == 8


# --- the native engine -----------------------------------------------------------------------

HOPPER_LIMIT = 20


@pytest.fixture(scope="module")
def hopper():
    """Three Hoppers: one left alone, one tilted beyond its limits, one with absurd velocities."""
    env = VectorEnv(make_env("Hopper", "native"), 3, max_episode_steps=HOPPER_LIMIT)
    engine = env.env.engine
    state = jax.jit(env.init)(jax.random.key(0))
    physics, measured = (x.copy() for x in engine.unpack_state(np.asarray(state.env)))
    nq = engine.nq
    physics[1, 1 + 2] = 0.5  # time comes first, then qpos; Hopper's angle is limited to 0.2
    broken = physics.copy()
    broken[2, 1 + nq + 3] = 1e12
    words = [
        jnp.stack([jnp.asarray(engine.pack_state(*env)) for env in zip(p, measured, strict=True)])
        for p in (physics, broken)
    ]

    @jax.jit
    def rollout(state):
        def body(state, key):
            next_state, step = env.step(state, env.random_action(key))
            return next_state, (step, next_state.time_step, next_state.env)

        return jax.lax.scan(body, state, jax.random.split(jax.random.key(1), 50))[1]

    return SimpleNamespace(
        env=env,
        engine=engine,
        rollout=rollout,
        sound=state.replace(env=words[0]),
        broken=state.replace(env=words[1]),
    )


def test_native_auto_reset(hopper):
    before = hopper.engine.host_calls
    step, time_step, words = jax.device_get(hopper.rollout(hopper.sound))
    assert hopper.engine.host_calls - before == 50  # resets cost no calls of their own
    assert not np.any(step.bad)
    assert steps_where(step.terminated[:, 1])[0] == 0
    assert np.abs(step.obs[0, 1, 1]) > 0.2  # the final observation is of the tilted Hopper
    np.testing.assert_array_equal(step.truncated, ~step.terminated & (time_step == 0))
    for env in range(3):
        ends = steps_where(step.done[:, env])
        lengths, terminated = np.diff([-1, *ends]), step.terminated[ends, env]
        assert np.all(lengths <= HOPPER_LIMIT)
        np.testing.assert_array_equal(
            step.truncated[ends, env], (lengths == HOPPER_LIMIT) & ~terminated
        )
    assert np.any(step.truncated)
    # Fresh ones are Gymnasium's initial posture within its noise, every time another, and the
    # physics goes on from there: the packed state and what is observed are the same.
    fresh = step.next_obs[step.done]
    posture = np.array([1.25, 0, 0, 0, 0, *[0] * 6])
    assert np.all(np.abs(fresh - posture) <= 5e-3 + 1e-6)
    assert np.unique(fresh[:, 0]).size == len(fresh) >= 6
    physics, _ = hopper.engine.unpack_state(words)
    np.testing.assert_array_equal(physics[..., 2:7].astype(np.float32), step.next_obs[..., :5])
    assert np.all(physics[step.done][:, 0] == 0)  # MuJoCo's clock starts again
    np.testing.assert_array_equal(step.next_obs[~step.done], step.obs[~step.done])


def test_native_bad_physics_is_found_though_mujoco_resets_silently(hopper, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    step, _, words = jax.device_get(hopper.rollout(hopper.broken))
    twin, _, _ = jax.device_get(hopper.rollout(hopper.sound))
    assert steps_where(step.bad[:, 2]) == [0]
    assert step.truncated[0, 2]
    assert not step.terminated[0, 2]
    assert step.reward[0, 2] == 0
    assert all(term[0, 2] == 0 for term in step.reward_terms.values())
    np.testing.assert_array_equal(step.obs[0, 2], hopper.broken.obs[2])
    assert np.all(np.abs(step.next_obs[0, 2, 1:]) <= 5e-3 + 1e-6)
    physics, _ = hopper.engine.unpack_state(words)
    assert np.all(np.isfinite(physics))
    for leaf in jax.tree.leaves(step):
        assert np.all(np.isfinite(leaf))
    for mine, undisturbed in zip(jax.tree.leaves(step), jax.tree.leaves(twin), strict=True):
        np.testing.assert_array_equal(mine[:, :2], undisturbed[:, :2])


def test_native_bad_physics_writes_no_log_file(hopper, monkeypatch, tmp_path):
    # MuJoCo's default warning handler appends to MUJOCO_LOG.TXT in the working directory.
    monkeypatch.chdir(tmp_path)
    step, _, _ = jax.device_get(hopper.rollout(hopper.broken))
    assert np.any(step.bad)
    assert list(tmp_path.iterdir()) == []


# --- resets of the five tasks ----------------------------------------------------------------

NUM_RESETS = 2000

# What gymnasium.envs.mujoco.*_v5 draws: uniform half-width of qpos; law and scale of qvel.
RESET_LAWS = {
    "HalfCheetah": (0.1, "normal", 0.1),
    "Hopper": (5e-3, "uniform", 5e-3),
    "Walker2d": (5e-3, "uniform", 5e-3),
    "Ant": (0.1, "normal", 0.1),
    "Humanoid": (1e-2, "uniform", 1e-2),
}


@pytest.fixture(scope="module", params=TASKS)
def resets(request):
    """2,000 draws of the reset noise; three resets made of them; Gymnasium's twin."""
    env = make_env(request.param, "native")
    engine, height = env.engine, 1 if env.task.measure == "root" else 2

    @jax.jit
    def draw(keys):
        noise = jax.vmap(env.reset_noise)(keys)
        few = jax.tree.map(lambda x: x[:3], noise)
        # Each reset comes right after a step of a body sunk into the floor, so that stale contact
        # forces and velocities in the engine's MjData would show.
        sunk = few.replace(qpos=few.qpos.at[:, height].add(-0.7))
        action = jnp.ones((3, env.spec.action_size))
        stepped, fresh = engine.step_and_reset(
            jax.vmap(engine.reset)(sunk).state, action, jnp.ones(3, bool), few
        )
        obs = jax.vmap(env.task.observe)(fresh.quantities)
        return noise, obs, fresh, stepped, jax.vmap(env.reset)(keys[:3])

    keys = jax.random.split(jax.random.key(0), NUM_RESETS)
    noise, obs, fresh, stepped, reset = jax.device_get(with_users_loops(draw, keys)(keys))
    unwrapped = gymnasium.make(env.spec.gymnasium_id).unwrapped
    yield SimpleNamespace(
        name=request.param,
        env=env,
        noise=noise,
        obs=obs,
        fresh=fresh,
        stepped=stepped,
        reset=reset,
        unwrapped=unwrapped,
    )
    unwrapped.close()


def cdf_of(law: str, scale: float):
    return (stats.norm(0, scale) if law == "normal" else stats.uniform(-scale, 2 * scale)).cdf


def test_reset_noise_follows_gymnasiums_law(resets):
    qpos_scale, qvel_law, qvel_scale = RESET_LAWS[resets.name]
    for noise, law, scale in (
        (resets.noise.qpos, "uniform", qpos_scale),
        (resets.noise.qvel, qvel_law, qvel_scale),
    ):
        if law == "uniform":
            assert np.max(np.abs(noise)) <= np.float32(scale)
        else:
            assert np.max(np.abs(noise)) > 3 * scale  # a normal has no such bound
        for coordinate in noise.T:
            assert stats.kstest(coordinate, cdf_of(law, scale)).pvalue > 1e-4
        assert stats.kstest(noise.ravel(), cdf_of(law, scale)).pvalue > 1e-3
    # Coordinates are drawn apart, and so are positions and velocities.
    correlation = np.corrcoef(np.hstack([resets.noise.qpos, resets.noise.qvel]).T)
    assert np.max(np.abs(correlation - np.eye(len(correlation)))) < 6 / np.sqrt(NUM_RESETS)


def test_the_law_is_what_gymnasium_draws(resets):
    unwrapped, draws = resets.unwrapped, []
    unwrapped.reset(seed=0)
    for _ in range(300):
        unwrapped.reset_model()
        draws.append(
            np.concatenate([unwrapped.data.qpos - unwrapped.init_qpos, unwrapped.data.qvel])
        )
    theirs = np.split(np.array(draws), [unwrapped.model.nq], axis=1)
    for ours, gymnasiums in zip((resets.noise.qpos, resets.noise.qvel), theirs, strict=True):
        assert ours.shape[1] == gymnasiums.shape[1]
        assert stats.ks_2samp(ours.ravel(), gymnasiums.ravel()).pvalue > 1e-3


def test_reset_with_given_noise_is_gymnasiums_reset(resets):
    unwrapped, fresh = resets.unwrapped, resets.fresh
    if "cfrc_ext" in resets.env.task.derived:
        assert np.any(resets.stepped.quantities.derived["cfrc_ext"] != 0)  # or nothing is stale
        assert not np.any(fresh.quantities.derived["cfrc_ext"])
    for i in range(3):
        qpos, qvel = (x[i].astype(np.float64) for x in (resets.noise.qpos, resets.noise.qvel))
        mujoco.mj_resetData(unwrapped.model, unwrapped.data)
        unwrapped.set_state(unwrapped.init_qpos + qpos, unwrapped.init_qvel + qvel)
        expected = unwrapped._get_obs()
        np.testing.assert_array_equal(resets.obs[i], expected.astype(np.float32))
        # And in double precision, before it is rounded for JAX.
        physics, measured = resets.env.engine.unpack_state(fresh.state[i])
        np.testing.assert_array_equal(physics[: 1 + qpos.size], [0, *unwrapped.data.qpos])
        np.testing.assert_array_equal(
            physics[1 + qpos.size : 1 + qpos.size + qvel.size], unwrapped.data.qvel
        )
        if resets.env.task.measure == "torso":
            np.testing.assert_array_equal(measured, unwrapped.data.body("torso").xpos[:2])
        assert not np.any(fresh.quantities.displacement[i])
        assert not fresh.bad[i]


def test_reset_of_the_environment_uses_that_noise(resets):
    words, obs = resets.reset
    np.testing.assert_array_equal(obs, resets.obs)
    np.testing.assert_array_equal(words, resets.fresh.state)
    assert np.unique(obs[:, 0]).size == 3

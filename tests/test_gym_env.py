"""``gym:ID``: equal to Gymnasium's own loop, pure though the environments are not, and refusals."""

from __future__ import annotations

import shutil
import warnings
from types import SimpleNamespace

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from gymnasium import spaces
from run_states import state_digest
from trees import unequal

from sacformer_jax import (
    Config,
    ConfigError,
    evaluate,
    make_program,
    resume,
    train,
)
from sacformer_jax.cli import main
from sacformer_jax.envs import VectorEnv, gym_live, make_env
from sacformer_jax.envs.gym_live import LiveEnvs
from sacformer_jax.envs.native_host import STATE_SPEC

# --- an environment that does what it is told -----------------------------------------------------

GO, TERMINATE, TRUNCATE, NAN_OBS, INF_REWARD, RAISE, BOTH = range(7)
LIMIT, NUM_ENVS, NUM_STEPS = 6, 3, 20


class Told(gymnasium.Env):
    """Observes a random number of its episode and its count of steps; the action is a command."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = spaces.Box(0.0, 13.0, (1,), np.float64)
    deterministic = True

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        self.number = self.np_random.random()
        if not self.deterministic:
            self.number = np.random.default_rng().random()
        return np.array([self.number, 0.0]), {}

    def step(self, action):
        assert action.dtype == self.action_space.dtype
        command = int(action[0])
        if command == RAISE:
            raise ZeroDivisionError("told to raise")
        self.count += 1
        obs = np.array([np.nan if command == NAN_OBS else self.number, self.count])
        action[:] = -1  # its own copy
        info = {"reward_count": self.count, "reward_if_told": 1.0, "other": 3.0}
        if self.count > 1:
            del info["reward_if_told"]
        reward = 1e300 if command == INF_REWARD else 100.0 + self.count
        return obs, reward, command in (TERMINATE, BOTH), command in (TRUNCATE, BOTH), info


class Astray(Told):
    """Does not go the same way twice."""

    deterministic = False


def _spaces(obs: spaces.Space, action: spaces.Space) -> type[Told]:
    return type("Shaped", (Told,), {"observation_space": obs, "action_space": action})


def _missing(**kwargs):
    raise gymnasium.error.DependencyNotInstalled("Box3D is not installed")


_BOX = Told.observation_space
REFUSED = {
    "Discrete": (_spaces(_BOX, spaces.Discrete(3)), "action_space is Discrete.*continuous"),
    "Unbounded": (_spaces(_BOX, spaces.Box(-np.inf, 1, (2,))), "action_space.*bounded Box"),
    "Integers": (_spaces(_BOX, spaces.Box(0, 9, (2,), np.int32)), "action_space.*Box of floats"),
    "Table": (_spaces(_BOX, spaces.Box(-1, 1, (2, 3))), "action_space.*one axis"),
    "Empty": (_spaces(_BOX, spaces.Box(1, 1, (2,))), "action_space.*above the lower"),
    "Image": (
        _spaces(spaces.Box(0, 255, (8, 8, 3), np.uint8), Told.action_space),
        "no networks for images",
    ),
    "Dict": (
        _spaces(spaces.Dict({"a": _BOX}), Told.action_space),
        "observation_space is Dict.*FlattenObservation",
    ),
    "Matrix": (
        _spaces(spaces.Box(0, 1, (2, 2)), Told.action_space),
        "one axis.*FlattenObservation",
    ),
    "Missing": (_missing, "cannot make it: DependencyNotInstalled: Box3D"),
    "Broken": (_spaces(_BOX, spaces.Box(4.5, 5.6, (1,), np.float64)), "first step fails.*told to"),
}  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def _registered():
    ids = {f"Tests/{name}-v0": entry for name, (entry, _) in REFUSED.items()}
    ids |= {"Tests/Told-v0": Told, "Tests/Astray-v0": Astray}
    for env_id, entry in ids.items():
        gymnasium.register(env_id, entry_point=entry)
    yield
    for env_id in ids:
        del gymnasium.registry[env_id]


def _scanned(env: VectorEnv):
    """``(state, actions [T, N, A]) -> (state, (steps, states before each))``, jitted."""

    def body(state, action):
        next_state, step = env.step(state, action)
        return next_state, (step, next_state.env.seed, next_state.env.length)

    return jax.jit(lambda state, actions: jax.lax.scan(body, state, actions))


@pytest.fixture(scope="module")
def told():
    env = VectorEnv(make_env("gym:Tests/Told-v0", max_episode_steps=LIMIT), NUM_ENVS)
    return SimpleNamespace(env=env, host=env.env.host, init=jax.jit(env.init), scan=_scanned(env))


def _commands(*scripts: dict[int, int]) -> jax.Array:
    actions = np.zeros((NUM_STEPS, NUM_ENVS, 1), np.float32)
    for env, script in enumerate(scripts):
        for step, command in script.items():
            actions[step, env] = command
    return jnp.asarray(actions)


def _where(mask: np.ndarray) -> list[int]:
    return np.flatnonzero(mask).tolist()


# --- equal to Gymnasium's own loop ----------------------------------------------------------------


@pytest.mark.parametrize(
    ("env_id", "limit"),
    [("Pendulum-v1", None), ("MountainCarContinuous-v0", 40), ("HalfCheetah-v5", 30)],
)
def test_trajectories_are_gymnasiums(env_id, limit):
    env = VectorEnv(make_env(f"gym:{env_id}", max_episode_steps=limit), 2)
    assert env.max_episode_steps == (limit or gymnasium.spec(env_id).max_episode_steps)
    num = env.max_episode_steps + 15
    actions = jax.vmap(env.random_action)(jax.random.split(jax.random.key(1), num))
    state = jax.jit(env.init)(jax.random.key(0))
    _, (steps, seeds, _) = jax.device_get(_scanned(env)(state, actions))
    theirs = gymnasium.make(env_id, max_episode_steps=limit)
    assert env.env.spec.action_low == tuple(theirs.action_space.low.tolist())
    for i in range(2):
        obs, _ = theirs.reset(seed=int(state.env.seed[i]))
        np.testing.assert_array_equal(state.obs[i], obs.astype(np.float32))
        for t in range(num):
            obs, reward, terminated, truncated, info = theirs.step(np.asarray(actions[t, i]))
            np.testing.assert_array_equal(steps.obs[t, i], obs.astype(np.float32))
            assert steps.reward[t, i] == np.float32(reward)
            assert (steps.terminated[t, i], steps.truncated[t, i]) == (terminated, truncated)
            for name, values in steps.reward_terms.items():
                assert values[t, i] == np.float32(info[name])
            if truncated:
                obs, _ = theirs.reset(seed=int(seeds[t, i]))
            np.testing.assert_array_equal(steps.next_obs[t, i], obs.astype(np.float32))
        assert _where(steps.truncated[:, i]) == [env.max_episode_steps - 1]
    theirs.close()
    assert np.unique([*state.env.seed, *seeds[-1]]).size == 4


def test_halfcheetah_is_the_one_of_the_native_engine():
    ours, native = make_env("gym:HalfCheetah-v5"), make_env("HalfCheetah", "native")
    actions = jax.random.uniform(jax.random.key(2), (30, 6), minval=-1, maxval=1)
    state, _ = jax.jit(ours.reset)(jax.random.key(0))
    theirs = gymnasium.make("HalfCheetah-v5").unwrapped
    theirs.reset(seed=int(state.seed))
    physics = np.empty(mujoco.mj_stateSize(theirs.model, STATE_SPEC))
    mujoco.mj_getState(theirs.model, theirs.data, physics, STATE_SPEC)
    words = native.engine.pack_state(physics, np.array([theirs.data.qpos[0], 0.0]))
    mine = jax.jit(lambda s: jax.lax.scan(ours.step, s, actions)[1])(state)
    expected = jax.jit(lambda s: jax.lax.scan(native.step, s, actions)[1])(jnp.asarray(words))
    np.testing.assert_array_equal(mine.obs, expected.obs)
    # Theirs is summed in float64 and then rounded.
    np.testing.assert_allclose(mine.reward, expected.reward, rtol=1e-5, atol=1e-6)
    assert set(mine.reward_terms) == set(expected.reward_terms)
    theirs.close()


def test_terminated_truncated_and_bad_are_kept_apart(told):
    state = told.init(jax.random.key(0))
    commands = _commands({2: TERMINATE}, {1: TRUNCATE, 4: NAN_OBS}, {0: BOTH, 3: INF_REWARD})
    _, (step, _, length) = jax.device_get(told.scan(state, commands))
    assert [_where(column) for column in step.terminated.T] == [[2], [], [0]]
    assert [_where(column) for column in step.truncated.T] == [
        [8, 14], [1, 4, 10, 16], [3, 9, 15],
    ]  # fmt: skip
    assert [_where(column) for column in step.bad.T] == [[], [4], [3]]
    np.testing.assert_array_equal(step.done, length == 0)
    np.testing.assert_array_equal(step.reward[~step.bad], 100 + step.obs[~step.bad, 1])
    assert np.all(np.isfinite(step.obs))
    # Every episode has a number of its own: resets are random.
    starts = [state.obs[:, 0], step.next_obs[step.done][:, 0]]
    assert np.unique(np.concatenate(starts)).size == 3 + step.done.sum()
    # Parts of the reward are what one step has shown of them.
    assert set(step.reward_terms) == {"reward_count", "reward_if_told"}
    np.testing.assert_array_equal(
        step.reward_terms["reward_if_told"], (step.obs[..., 1] == 1) & ~step.bad
    )


# --- pure -----------------------------------------------------------------------------------------


def test_a_state_may_be_stepped_again_and_copies_do_not_disturb(told):
    state = told.init(jax.random.key(3))
    plain = _commands({9: TERMINATE})
    end, expected = jax.device_get(told.scan(state, plain))
    middle, _ = told.scan(state, plain[:10])
    copy = jax.tree.map(jnp.copy, middle)
    told.scan(copy, _commands({1: TERMINATE}, {0: TRUNCATE}, {2: NAN_OBS}))
    before = told.host.replayed
    again, rest = jax.device_get(told.scan(middle, plain[10:]))
    assert told.host.replayed > before
    jax.tree.map(np.testing.assert_array_equal, rest, jax.tree.map(lambda x: x[10:], expected))
    jax.tree.map(np.testing.assert_array_equal, again.env, end.env)


def test_one_host_call_for_a_step_and_no_more_environments_than_needed(told):
    state = told.init(jax.random.key(4))
    made, calls = [], told.host.live.calls
    for _ in range(8):
        state, _ = told.scan(state, _commands({2: TERMINATE}, {1: TRUNCATE}))
        made.append(told.host.live.made)
    jax.block_until_ready(state)
    assert told.host.live.calls - calls == 8 * NUM_STEPS
    assert made[-1] == made[0]
    before = told.host.replayed
    jax.block_until_ready(told.scan(state, _commands()))
    assert told.host.replayed == before  # those running are there


def test_seeds_under_vmap_equal_each_alone(told):
    keys = jax.random.split(jax.random.key(5), 2)
    actions = jnp.stack([_commands({3: TERMINATE}), _commands({}, {5: TRUNCATE})])
    calls = told.host.live.calls
    states = jax.jit(jax.vmap(told.env.init))(keys)
    together = jax.jit(jax.vmap(lambda s, a: told.scan(s, a)))(states, actions)
    together = jax.device_get(together)
    assert told.host.live.calls - calls == 2 + NUM_STEPS
    for i in range(2):
        alone = jax.device_get(told.scan(told.init(keys[i]), actions[i]))
        mine = jax.tree.map(lambda x, i=i: x[i], together)
        jax.tree.map(np.testing.assert_array_equal, mine[1], alone[1])
        jax.tree.map(np.testing.assert_array_equal, mine[0].env, alone[0].env)


def test_what_an_environment_raises_is_told_and_others_go_on(told):
    state = told.init(jax.random.key(6))
    with pytest.raises((jax.errors.JaxRuntimeError, ValueError), match="told to raise"):
        jax.block_until_ready(told.scan(state, _commands({4: RAISE})))
    _, (step, _, _) = told.scan(state, _commands())
    assert not np.any(step.bad)
    assert step.obs[:6, :, 1].tolist() == [[count] * 3 for count in range(1, 7)]


def test_one_that_is_not_deterministic_is_cut_off_where_it_would_have_to_be():
    env = VectorEnv(make_env("gym:Tests/Astray-v0", max_episode_steps=LIMIT), 2)
    scan = _scanned(env)
    state, _ = scan(jax.jit(env.init)(jax.random.key(0)), jnp.zeros((3, 2, 1)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _, (step, _, _) = jax.device_get(scan(state, jnp.zeros((5, 2, 1))))
    assert not np.any(step.bad)
    with pytest.warns(RuntimeWarning, match="Astray-v0 did not go the same way"):
        _, (step, _, _) = jax.device_get(scan(state, jnp.zeros((5, 2, 1))))
    # The running episode, and the prepared one, which the run before went on with.
    assert step.bad[:, 0].tolist() == [True, True, False, False, False]
    np.testing.assert_array_equal(step.truncated, step.bad)
    np.testing.assert_array_equal(step.obs[0], state.obs)


# --- refusals and defaults ------------------------------------------------------------------------


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_taken_is_refused_with_what_can(name):
    with pytest.raises(ConfigError, match=f"(?s)^env='gym:Tests/{name}-v0': .*{REFUSED[name][1]}"):
        make_env(f"gym:Tests/{name}-v0")


def test_unknown_ids_are_refused_with_those_that_are_close():
    for env in ("gym:Pendulum-v7", "gym:Pendulum"):
        with pytest.raises(ConfigError, match=f"env='{env}': .* close ones are .*Pendulum-v1"):
            Config.from_preset("cpu", env=env)
    with pytest.raises(ConfigError, match=r"cannot import 'no_such_module'.*'X-v0'"):
        make_env("gym:no_such_module:X-v0")
    with pytest.raises(ConfigError, match=r"phys2d/Pendulum-v0': runs JAX itself"):
        make_env("gym:phys2d/Pendulum-v0")


def test_the_command_line_refuses_before_anything_is_written(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["train", "--env", "gym:CartPole-v1"]) == 2
    assert "action_space is Discrete(2)" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_the_ids_own_limit_and_threshold_are_the_defaults():
    task = Config.from_preset("cpu", env="gym:Pendulum-v1")
    assert task.task.max_episode_steps == 200
    assert task.context.target_return == "auto"
    asked = {"max_episode_steps": 77, "target_return": -200.0}
    config = Config.from_preset("cpu", env="gym:Pendulum-v1", **asked)
    assert (config.task.max_episode_steps, config.context.target_return) == (77, -200.0)
    car = Config.from_preset("cpu", env="gym:MountainCarContinuous-v0", agent="sac")
    assert (car.context.target_return, car.context.return_scale) == (90.0, 9.0)
    assert car.task.max_episode_steps == 999
    # An agent that looks at no return, and one told not to.
    Config.from_preset("cpu", env="gym:Pendulum-v1", agent="sac")
    Config.from_preset("cpu", env="gym:Pendulum-v1", return_conditioning="none")
    Config.from_preset("best", env="gym:Pendulum-v1")
    assert Config.from_preset("cpu", env="gym:Tests/Told-v0").task.max_episode_steps == 1000


def test_spec_and_room():
    env = make_env("gym:Pendulum-v1")
    spec = env.spec
    assert (spec.name, spec.gymnasium_id) == ("gym:Pendulum-v1", "Pendulum-v1")
    assert (spec.obs_size, spec.action_size, spec.max_episode_steps) == (3, 1, 200)
    assert (spec.action_low, spec.action_high) == ((-2.0,), (2.0,))
    with pytest.raises(ConfigError, match=r"max_episode_steps=201: .*made for at most 200"):
        VectorEnv(env, 2, 201)
    assert VectorEnv(make_env("gym:Pendulum-v1", max_episode_steps=201), 2).max_episode_steps == 201


# --- runs -----------------------------------------------------------------------------------------

TINY = {
    "env": "gym:Pendulum-v1", "num_envs": 2, "max_episode_steps": 70, "prefill_env_steps": 200,
    "chunk_env_steps": 100, "total_env_steps": 600, "eval_every": 200, "eval_episodes": 2,
    "checkpoint_every": 200, "actor_width": 8, "actor_heads": 1, "actor_layers": 1,
    "critic_width": 8, "batch_size": 4, "buffer_capacity": 2000,
}  # fmt: skip


def _pendulums_forgotten():
    """The host of the runs below, with nothing alive, as in another process."""
    host = make_env(TINY["env"], max_episode_steps=TINY["max_episode_steps"]).host
    host.live = LiveEnvs(gym_live.make("Pendulum-v1"), host.facts)
    return host


@pytest.mark.slow
def test_a_train_state_goes_on_the_same_where_nothing_is_alive():
    program = make_program(Config.from_preset("cpu", agent="sac", **TINY))
    state, _ = program.prefill(program.init(jax.random.key(0)))
    kept = jax.tree.map(jnp.copy, state)
    straight = jax.block_until_ready(program.train_chunk(state)[0])
    host = _pendulums_forgotten()
    before = host.replayed
    resumed, _ = program.train_chunk(kept)
    assert not unequal(straight, resumed)
    # Prefill had taken 100 steps in each of 2 environments.
    assert host.replayed - before == 2 * (100 % 70)


@pytest.mark.slow
@pytest.mark.parametrize("agent", ["sac", "sacformer"])
def test_resuming_equals_never_having_stopped(agent, tmp_path):
    settings = {**TINY, "agent": agent, "run_dir": str(tmp_path / "straight"), "seeds": 2}
    paths = [train(Config.from_preset("cpu", **settings), quiet=True).path, tmp_path / "killed"]
    shutil.copytree(*paths)
    shutil.rmtree(paths[1] / "checkpoints" / "600")
    host = _pendulums_forgotten()
    before = host.replayed
    resume(paths[1], quiet=True)
    # Each of 2 environments of 2 seeds had taken 200 steps by the checkpoint.
    assert host.replayed - before == 4 * (200 % 70)
    assert state_digest(paths[0]) == state_digest(paths[1])
    for name in ("seed-0", "seed-1"):
        metrics = [(path / name / "metrics.jsonl").read_bytes() for path in paths]
        assert metrics[0] == metrics[1]
    record = evaluate(paths[0], episodes=2, gymnasium=True, member="seed-1")
    assert (record["env"], record["length_mean"]) == ("Pendulum-v1", 200)
    assert record["return_mean"] < 0


@pytest.mark.slow
@pytest.mark.parametrize("agent", ["sac", "sacformer"])
def test_pendulum_is_learnt(agent, tmp_path):
    """Random actions reach -1200; CleanRL and SB3 call about -150 solved."""
    settings = {"total_env_steps": 10_000, "prefill_env_steps": 2_000, "updates_per_env_step": 1.0}
    config = Config.from_preset(
        "cpu", env="gym:Pendulum-v1", agent=agent, run_dir=str(tmp_path / "run"), **settings
    )
    path = train(config, quiet=True).path
    assert evaluate(path, episodes=20, gymnasium=True)["return_mean"] > -250

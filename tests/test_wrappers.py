"""Hidden velocities, delayed actions and stacked observations, here and in Gymnasium."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from policies import small_policy
from probe import PointEnv
from untrained import untrained_run

from sacformer_jax import (
    Config,
    ConfigError,
    MujocoEnv,
    VectorEnv,
    as_brax,
    check_env,
    cli,
    gymnasium_env,
    load_policy,
    make_env,
    make_program,
    train,
    wrapped,
)
from sacformer_jax.acting_step import ActingStep, manifest
from sacformer_jax.envs import (
    TASKS,
    ActionDelay,
    EngineChoice,
    EnvSpec,
    EnvStep,
    HiddenVelocities,
    JaxEnv,
    Quantities,
    StackedObs,
    Wrapping,
)
from sacformer_jax.envs.gym_wrappers import gym_wrapped
from sacformer_jax.envs.native_host import STATE_SPEC
from sacformer_jax.frames import frame_source
from sacformer_jax.model_renderer import View
from sacformer_jax.report import reading
from sacformer_jax.train import make_training_env

ALL_THREE = {"hide_velocities": True, "action_delay": 2, "stack_obs": 3}

# --- an environment whose observation tells everything ---------------------------------------

LIMIT, NUM_ENVS, NUM_STEPS = 4, 3, 23
NEUTRAL = np.array([0.0, 2.0], np.float32)


class TellingEnv(JaxEnv):
    """Observes which episode this is (a random number), its step, and the action applied there.

    The reward is the sum of that action. An episode terminates after two to five steps, by its
    number.
    """

    spec = EnvSpec(
        name="telling",
        obs_size=4,
        action_size=2,
        action_low=(-1.0, 1.0),
        action_high=(1.0, 3.0),
        max_episode_steps=1000,
        engine="none",
        engine_reason="a test",
        velocities=((1, 2),),
    )

    def reset(self, key):
        state = jnp.concatenate([jax.random.uniform(key, (1,)), jnp.zeros(3)])
        return state, state

    def step(self, state, action):
        state = jnp.concatenate([state[:1], state[1:2] + 1.0, action])
        no = jnp.zeros((), bool)
        reward = action.sum()
        terminated = state[1] >= 2 + jnp.floor(4 * state[0])
        return state, EnvStep(state, reward, terminated, no, {"reward_sum": reward})


def roll(env: VectorEnv, key: jax.Array, actions: jax.Array):
    """The first observation, and all steps."""
    state = env.init(key)
    return state.obs, jax.lax.scan(env.step, state, actions)[1]


class Expected:
    """One environment under wrappers, in NumPy."""

    def __init__(self, hide: bool, delay: int, stack: int):
        self.places = [0, 2, 3] if hide else [0, 1, 2, 3]
        self.delay, self.stack = delay, stack

    def reset(self, number: np.float32) -> np.ndarray:
        self.number, self.time_step, self.chosen = number, 0, []
        self.seen = [np.array([number, 0, 0, 0], np.float32)[self.places]]
        return self.obs()

    def step(self, action: np.ndarray) -> SimpleNamespace:
        self.chosen.append(action)
        before = self.time_step - self.delay
        applied = self.chosen[before] if before >= 0 else NEUTRAL
        self.time_step += 1
        told = np.array([self.number, self.time_step, *applied], np.float32)
        self.seen.append(told[self.places])
        return SimpleNamespace(
            obs=self.obs(),
            reward=applied.sum(),
            terminated=self.time_step >= 2 + np.floor(4 * self.number),
            limit=self.time_step >= LIMIT,
        )

    def obs(self) -> np.ndarray:
        last = range(self.time_step - self.stack + 1, self.time_step + 1)
        seen = [self.seen[max(0, step)] for step in last]
        between = [self.chosen[step] if step >= 0 else np.zeros(2) for step in last[:-1]]
        return np.concatenate([*seen, *between]).astype(np.float32)


@pytest.mark.parametrize(
    ("hide", "delay", "stack"),
    [(True, 2, 3), (True, 0, 1), (False, 6, 2), (False, 0, 5)],
)
def test_all_steps_are_those_of_an_oracle(hide: bool, delay: int, stack: int) -> None:
    env = VectorEnv(wrapped(TellingEnv(), hide, delay, stack), NUM_ENVS, LIMIT)
    assert env.spec.obs_size == stack * (3 if hide else 4) + (stack - 1) * 2
    draw = np.random.default_rng(1).uniform
    actions = draw(env.spec.action_low, env.spec.action_high, (2, NUM_STEPS, NUM_ENVS, 2))
    actions = actions.astype(np.float32)
    keys = jax.random.split(jax.random.key(3), 2)
    # Two seeds side by side, as a population has them.
    several = jax.device_get(jax.jit(jax.vmap(lambda k, a: roll(env, k, a)))(keys, actions))
    if (hide, delay, stack) == (True, 2, 3):
        alone = jax.device_get(roll(env, keys[1], jnp.asarray(actions[1])))
        jax.tree.map(np.testing.assert_array_equal, alone, jax.tree.map(lambda x: x[1], several))

    newest = (stack - 1) * (3 if hide else 4)  # where the number of the episode stands
    numbers: list[float] = []
    ends = {"terminated": 0, "truncated": 0}
    for seed in range(2):
        first, steps = jax.tree.map(lambda x, seed=seed: x[seed], several)
        for n in range(NUM_ENVS):
            oracle = Expected(hide, delay, stack)
            numbers.append(first[n, newest])
            np.testing.assert_array_equal(first[n], oracle.reset(first[n, newest]))
            for t in range(NUM_STEPS):
                expected, got = oracle.step(actions[seed, t, n]), steps.next_obs[t, n]
                np.testing.assert_array_equal(steps.obs[t, n], expected.obs)
                np.testing.assert_allclose(steps.reward[t, n], expected.reward, rtol=1e-6)
                assert steps.reward_terms["reward_sum"][t, n] == steps.reward[t, n]
                assert steps.terminated[t, n] == expected.terminated
                assert steps.truncated[t, n] == (expected.limit and not expected.terminated)
                if not steps.done[t, n]:
                    np.testing.assert_array_equal(got, expected.obs)
                    continue
                ends["terminated"] += bool(steps.terminated[t, n])
                ends["truncated"] += bool(steps.truncated[t, n])
                numbers.append(got[newest])
                np.testing.assert_array_equal(got, oracle.reset(got[newest]))
    assert min(ends.values()) > 5
    assert len(set(numbers)) == len(numbers)  # every reset is new


def test_one_step_is_one_call_to_the_host() -> None:
    env = VectorEnv(wrapped(make_env("Hopper", "native"), **ALL_THREE), 2, 2)
    step, state = jax.jit(env.step), env.init(jax.random.key(0))
    done = 0
    before = env.env.engine.host_calls
    for _ in range(6):
        state, taken = step(state, jnp.zeros((2, 3)))
        done += int(np.sum(taken.done))
    assert done == 6
    assert env.env.engine.host_calls == before + 6


def test_velocities_that_are_not_finite_are_bad_physics_though_hidden() -> None:
    class Broken(TellingEnv):
        def step(self, state, action):
            state, step = super().step(state, action)
            return state, dataclasses.replace(step, obs=step.obs.at[1].set(jnp.nan))

    env = wrapped(Broken(), hide_velocities=True)
    _, step = env.step(env.reset(jax.random.key(0))[0], jnp.asarray(NEUTRAL))
    assert np.isfinite(step.obs).all()
    assert step.bad


def test_wrapped_environments_keep_to_the_contract() -> None:
    check_env(wrapped(TellingEnv(), **ALL_THREE), num_steps=3)
    check_env(wrapped(make_env("Ant", "native"), **ALL_THREE), num_steps=3)
    check_env(wrapped(make_env("gym:Pendulum-v1"), action_delay=1, stack_obs=2), num_steps=3)


@pytest.mark.slow
def test_engine_mjx_has_the_same_shapes() -> None:
    env = wrapped(make_env("Hopper", "mjx"), **ALL_THREE)
    assert env.spec.obs_size == 3 * 5 + 2 * 3
    check_env(env, num_steps=0)


# --- which are the velocities ----------------------------------------------------------------

SIZES = {"HalfCheetah": 8, "Hopper": 5, "Walker2d": 8, "Ant": 91, "Humanoid": 247}
MODELS = {"HalfCheetah": (9, 9), "Hopper": (6, 6), "Walker2d": (9, 9), "Ant": (15, 14)}


@pytest.mark.parametrize("name", TASKS)
def test_sizes(name: str) -> None:
    plain = make_env(name, "native")
    size, actions = SIZES[name], plain.spec.action_size
    hidden = wrapped(plain, hide_velocities=True)
    assert hidden.spec.obs_size == size == hidden.reset(jax.random.key(0))[1].size
    spec = wrapped(plain, **ALL_THREE).spec
    assert spec.obs_size == 3 * size + 2 * actions
    assert spec.gymnasium_id == f"{name}-v5"
    assert spec.name == name


@pytest.mark.parametrize("name", TASKS)
def test_what_is_hidden_is_what_depends_on_velocities(name: str) -> None:
    task = TASKS[name]
    num_q, num_v = MODELS.get(name, (24, 23))
    shapes = {"cinert": (14, 10), "cvel": (14, 6), "qfrc_actuator": (23,), "cfrc_ext": (14, 6)}

    def quantities(velocity_seed: int) -> Quantities:
        fixed, of_seed = np.random.default_rng(0), np.random.default_rng(velocity_seed)
        derived = {k: fixed.normal(size=shapes[k]).astype(np.float32) for k in task.derived}
        if "cvel" in derived:
            derived["cvel"] = of_seed.normal(size=shapes["cvel"]).astype(np.float32)
        return Quantities(
            qpos=fixed.normal(size=num_q).astype(np.float32),
            qvel=of_seed.normal(size=num_v).astype(np.float32),
            displacement=np.zeros(2, np.float32),
            derived=derived,
        )

    one, other = (np.asarray(task.observe(quantities(seed))) for seed in (1, 2))
    said = [place for start, stop in task.velocities for place in range(start, stop)]
    assert np.flatnonzero(one != other).tolist() == said


@pytest.mark.parametrize("name", ["HalfCheetah", "Hopper", "Walker2d"])
def test_velocities_alone_do_not_change_what_is_seen(name: str) -> None:
    def reset(key, initial):
        return initial.replace(qvel=jax.random.uniform(key, initial.qvel.shape))

    plain = MujocoEnv(dataclasses.replace(TASKS[name], reset=reset), EngineChoice("native"))
    hidden = wrapped(plain, hide_velocities=True)
    keys = jax.random.split(jax.random.key(0), 2)
    assert np.all(plain.reset(keys[0])[1][-6:] != plain.reset(keys[1])[1][-6:])
    np.testing.assert_array_equal(hidden.reset(keys[0])[1], hidden.reset(keys[1])[1])


def test_the_default_observation_knows_its_velocities() -> None:
    def reward_terms(q, action, x_velocity):
        return {"reward_forward": x_velocity}

    task = dataclasses.replace(
        TASKS["Hopper"], name="Own", reward_terms=reward_terms, velocities=()
    )
    assert MujocoEnv(task, EngineChoice("native")).spec.velocities == ()
    default = {field.name: field.default for field in dataclasses.fields(task)}["observe"]
    plain = MujocoEnv(dataclasses.replace(task, observe=default), EngineChoice("native"))
    assert plain.spec.velocities == ((6, 12),)
    assert MujocoEnv(dataclasses.replace(task, velocities=[[1, 3]])).spec.velocities == ((1, 3),)


# --- the same in Gymnasium -------------------------------------------------------------------


@pytest.mark.parametrize("name", ["Hopper", "Humanoid"])
def test_steps_equal_those_of_gymnasium_under_its_wrappers(name: str) -> None:
    plain = make_env(name, "native")
    env = wrapped(plain, **ALL_THREE)
    state, first_obs = env.reset(jax.random.key(0))
    theirs = gym_wrapped(gymnasium.make(f"{name}-v5"), env.spec.wrapping)
    unwrapped: Any = theirs.unwrapped
    data = mujoco.MjData(plain.engine.model)
    words = np.asarray(state.env.env.env)
    mujoco.mj_setState(plain.engine.model, data, plain.engine.unpack_state(words)[0], STATE_SPEC)

    def reset_model() -> np.ndarray:
        unwrapped.set_state(data.qpos.copy(), data.qvel.copy())
        return unwrapped._get_obs()

    unwrapped.reset_model = reset_model
    obs, _ = theirs.reset(seed=0)
    assert theirs.observation_space.contains(obs)
    assert theirs.observation_space.shape == (env.spec.obs_size,) == obs.shape
    np.testing.assert_allclose(first_obs, obs, rtol=1e-5, atol=1e-6)
    rng = np.random.default_rng(4)
    draw = rng.uniform(plain.spec.action_low, plain.spec.action_high, (8, plain.spec.action_size))
    actions = draw.astype(np.float32)
    _, steps = jax.jit(lambda state: jax.lax.scan(env.step, state, jnp.asarray(actions)))(state)
    for t, action in enumerate(actions):
        given = action.copy()
        obs, reward, terminated, _, info = theirs.step(given)
        given += 100.0  # what the caller does with its array afterwards is nobody's business
        np.testing.assert_allclose(steps.obs[t], obs, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(steps.reward[t], reward, rtol=1e-4, atol=1e-4)
        # The cost is of what was applied: of the first two steps nothing.
        ctrl = steps.reward_terms["reward_ctrl"][t]
        np.testing.assert_allclose(ctrl, info["reward_ctrl"], rtol=1e-5, atol=1e-7)
        assert (ctrl == 0) == (t < 2)
        assert steps.terminated[t] == terminated


@pytest.fixture(scope="module")
def untrained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return untrained_run(tmp_path_factory.mktemp("untrained"), agent="sac", **ALL_THREE)


def test_gymnasium_makes_the_wrapped_environment_of_its_spec_again(untrained: Path) -> None:
    policy = load_policy(untrained)
    env = gymnasium_env(policy, max_episode_steps=5)
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert env.observation_space == again.observation_space
    assert env.observation_space.shape == policy.observation_space.shape
    (obs, _), (other, _) = env.reset(seed=1), again.reset(seed=1)
    np.testing.assert_array_equal(obs, other)
    for _ in range(4):
        action = policy.action_space.sample()
        np.testing.assert_array_equal(env.step(action)[0], again.step(action)[0])


# --- runs ------------------------------------------------------------------------------------

TINY = {
    "env": "Hopper", "max_episode_steps": 20, "num_envs": 2, "batch_size": 4, "actor_layers": 1,
    "actor_width": 8, "critic_width": 8, "buffer_capacity": 400, "total_env_steps": 100,
    "prefill_env_steps": 60, "chunk_env_steps": 20, "eval_every": 40, "eval_episodes": 1,
    "checkpoint_every": 100, "updates_per_env_step": 0.5, "engine": "native",
}  # fmt: skip


@pytest.mark.parametrize("agent", ["sac", "sacformer", "ppo"])
def test_the_training_program_has_the_wrapped_sizes(agent: str) -> None:
    own = {"prefill_env_steps": 0} if agent == "ppo" else {}
    config = Config.from_preset("cpu", agent=agent, **{**TINY, **ALL_THREE, **own})
    program = make_program(config)
    state = jax.eval_shape(program.init, jax.random.key(0))
    after, _ = jax.eval_shape(program.train_chunk, state)
    assert jax.tree.map(jnp.shape, after) == jax.tree.map(jnp.shape, state)
    assert after.env.obs.shape == (2, 21)


@pytest.mark.parametrize("agent", ["sac", pytest.param("sacformer", marks=pytest.mark.slow)])
def test_evaluation_in_gymnasium_wraps_it(
    agent: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = untrained_run(tmp_path / "run", agent=agent, **ALL_THREE)
    arguments = ["evaluate", str(run), "--gymnasium", "--episodes", "2", "--seed", "3"]
    assert cli.main(arguments) == 0
    table = capsys.readouterr().out.splitlines()
    policy = load_policy(run)
    env = gym_wrapped(gymnasium.make("Hopper-v5"), Wrapping(((5, 11),), 2, 3))
    returns = []
    for seed in (3, None):
        obs, _ = env.reset(seed=seed)
        state, reward, done, total = None, None, False, 0.0
        while not done:
            action, state = policy.predict(obs, state, reward=reward)
            obs, reward, terminated, truncated, _ = env.step(action)
            total, done = total + reward, terminated or truncated
        returns.append(total)
    assert f"return {np.mean(returns):9.1f} ± {np.std(returns):.1f}" in table[1]
    assert "random actions" in table[2]


@pytest.mark.slow
@pytest.mark.parametrize("agent", ["sac", "sacformer"])
def test_a_run_under_all_three(
    agent: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = {"tokens": "gsa", "context_length": 2, "actor_heads": 1} if agent == "sacformer" else {}
    run = tmp_path / "run"
    config = Config.from_preset("cpu", agent=agent, run_dir=str(run), **TINY, **ALL_THREE, **own)
    result = train(config)
    assert result.env_steps == 100
    said = capsys.readouterr().out
    wrappers = "6 velocities hidden, actions delayed by 2 steps, 3 observations stacked"
    assert f"wrappers     {wrappers}" in said
    assert cli.main(["evaluate", str(run), "--gymnasium", "--episodes", "2"]) == 0
    table = capsys.readouterr().out
    assert "best policy" in table
    assert "random actions" in table
    assert reading.read_run(run, "it").task == f"Hopper, {wrappers}"


def test_what_is_exported_says_how_it_is_wrapped(untrained: Path) -> None:
    about = manifest(ActingStep(load_policy(untrained), True), 1, True)
    expected = {"hidden": [[5, 11]], "action_delay": 2, "stack_obs": 3}
    assert json.loads(json.dumps(about))["wrappers"] == expected
    assert about["inputs"]["obs"]["shape"] == [1, 21]
    assert manifest(ActingStep(small_policy("sac"), True), 1, True)["wrappers"] is None


def test_collected_episodes_are_what_the_policy_saw(
    untrained: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    arguments = ["--to", "test/wrapped-v0", "--episodes", "2", "--actions", "random"]
    assert cli.main(["collect", str(untrained), *arguments]) == 0
    said = capsys.readouterr().out
    assert "3 observations stacked" in said
    assert "--dataset" not in said  # which would be refused
    dataset = minari.load_dataset("test/wrapped-v0")
    env = dataset.recover_environment()
    assert env.observation_space.shape == (21,)
    for episode in dataset.iterate_episodes():
        # The newest observation but one, and the action that led from it to the newest.
        obs, actions = episode.observations, episode.actions
        np.testing.assert_array_equal(obs[1:, 5:10], obs[:-1, 10:15])
        np.testing.assert_array_equal(obs[1:, -3:], actions)


def test_pictures_are_of_what_is_within() -> None:
    class Drawn(TellingEnv):
        def frame_source(self, view: View) -> Any:
            return SimpleNamespace(
                dt=0.5,
                snapshot=lambda state: state[1],
                draw=lambda snapshot: np.full((2, 2, 3), int(snapshot), np.uint8),
                close=lambda: None,
                **pages,
            )

    pages = {"html": lambda states, heading: heading}
    env = wrapped(Drawn(), **ALL_THREE)
    source = frame_source(env, View())
    state = env.reset(jax.random.key(0))[0]
    for _ in range(2):
        state, _ = env.step(state, jnp.asarray(NEUTRAL))
    assert source.dt == 0.5
    assert source.draw(source.snapshot(state)).max() == 2
    assert source.html([], "its page") == "its page"
    pages = {}
    assert not hasattr(frame_source(env, View()), "html")


def test_brax_sees_the_wrapped_environment() -> None:
    env = wrapped(TellingEnv(), **ALL_THREE)
    view = as_brax(env)
    assert view.observation_size == env.spec.obs_size
    key = jax.random.key(0)
    theirs, (state, obs) = view.reset(key), env.reset(key)
    np.testing.assert_array_equal(theirs.obs, obs)
    for unit in np.random.default_rng(0).uniform(-1, 1, (5, 2)).astype(np.float32):
        theirs = view.step(theirs, jnp.asarray(unit))
        state, step = env.step(state, view.to_bounds(jnp.asarray(unit)))
        np.testing.assert_array_equal(theirs.obs, step.obs)
        assert theirs.reward == step.reward


# --- without wrappers, and what is refused ---------------------------------------------------


def test_without_wrappers_the_environment_is_itself() -> None:
    env = PointEnv()
    assert wrapped(env) is env
    made = make_training_env(Config.from_preset("cpu", env="Hopper", engine="native"))
    assert type(made.env) is MujocoEnv
    assert made.spec.wrapping == Wrapping()
    gym = gymnasium.make("Pendulum-v1")
    assert gym_wrapped(gym, Wrapping()) is gym


def test_facts_survive_json_also_those_of_earlier_versions() -> None:
    spec = wrapped(TellingEnv(), **ALL_THREE).spec
    values = json.loads(json.dumps(dataclasses.asdict(spec)))
    assert EnvSpec.from_dict(values) == spec
    plain = dataclasses.asdict(TellingEnv.spec)
    old = {name: plain[name] for name in plain if name not in ("velocities", "wrapping")}
    assert EnvSpec.from_dict(old) == dataclasses.replace(TellingEnv.spec, velocities=())


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"action_delay": -1}, "action_delay=-1: must not be negative"),
        ({"stack_obs": 0}, "stack_obs=0: must be at least 1"),
        (
            {"action_delay": 1000},
            "action_delay=1000: must be below max_episode_steps=1000",
        ),
        ({"stack_obs": 30, "max_episode_steps": 30}, "stack_obs=30: must be below max_episode"),
        ({"hide_velocities": 1}, "hide_velocities=1"),
        ({"action_delay": 1.5}, "action_delay=1.5"),
        ({"dataset": "some", "action_delay": 2}, "under action_delay=2; use action_delay=0, or"),
        ({"dataset": "some", "stack_obs": 2}, "under stack_obs=2; use stack_obs=1, or"),
        ({"dataset": "some", "hide_velocities": True}, "use hide_velocities=False, or"),
    ],
)
def test_settings_that_cannot_work(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Config.from_preset("cpu", env="Hopper", **fields)


def test_an_episode_of_one_step_needs_no_wrappers() -> None:
    fields = {"max_episode_steps": 1, "context_length": 1, "tokens": "gs"}
    assert Config.from_preset("cpu", env="Hopper", **fields).task.stack_obs == 1


def test_environments_whose_velocities_nobody_knows_are_refused() -> None:
    config = Config.from_preset("cpu", env="gym:Pendulum-v1", agent="sac", hide_velocities=True)
    with pytest.raises(ConfigError, match="hide_velocities=True: env='gym:Pendulum-v1' does not"):
        make_training_env(config)

    def telling(**facts: Any) -> TellingEnv:
        env = TellingEnv()
        env.spec = dataclasses.replace(env.spec, **facts)
        return env

    for velocities in (((2, 1),), ((1, 5),), ((1, 3), (2, 4)), (1, 2), ((1, 2, 3),), ((-2, 1),)):
        env = telling(velocities=velocities)
        for refuse in (HiddenVelocities, lambda env: check_env(env, num_steps=0)):
            with pytest.raises(ConfigError, match=r"velocities.*must be pairs"):
                refuse(env)
    with pytest.raises(ConfigError, match="observes nothing but velocities"):
        HiddenVelocities(telling(velocities=((0, 4),)))


def test_there_is_one_order() -> None:
    env = TellingEnv()
    for inner, outer in (
        (StackedObs(env, 2), lambda env: ActionDelay(env, 1)),
        (StackedObs(env, 2), lambda env: StackedObs(env, 2)),
        (ActionDelay(env, 1), HiddenVelocities),
        (ActionDelay(env, 1), lambda env: ActionDelay(env, 1)),
        (HiddenVelocities(env), HiddenVelocities),
    ):
        with pytest.raises(ConfigError, match="is wrapped already"):
            outer(inner)
    for refused in (lambda: ActionDelay(env, -1), lambda: StackedObs(env, 0)):
        with pytest.raises(ConfigError, match="must"):
            refused()


def test_only_wrappers_that_are_there_are_named() -> None:
    assert Wrapping().words() == ()
    assert Wrapping(action_delay=1).words() == ("actions delayed by 1 step",)

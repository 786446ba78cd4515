"""``predict`` by Stable-Baselines3's convention; loops over vector environments."""

from __future__ import annotations

import dataclasses
import importlib.util
import pickle
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from policies import ACT, LIMIT, OBS, small_policy

from sacformer_jax import context as contexts
from sacformer_jax.policy import ActingState, Policy
from sacformer_jax.reward_in_obs import PolicyOfRewardInObs, RewardInObs

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture(scope="module")
def policy() -> Policy:
    return small_policy()


@pytest.fixture(scope="module")
def ppo() -> Policy:
    return small_policy("ppo")


def _observations(*shape: int) -> np.ndarray:
    return np.random.default_rng(1).normal(size=(*shape, OBS)).astype(np.float32)


def _equal(one: Any, other: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, one, other)


# --- states ------------------------------------------------------------------------------------


@pytest.mark.parametrize("acting_context", ["window", "episode"])
def test_a_state_may_be_used_again_and_kept_elsewhere(acting_context: str) -> None:
    policy = small_policy(acting_context=acting_context)
    first, second = _observations(2, 2)
    _, state = policy.predict(first)
    before = jax.tree.map(np.array, state)
    action, after = policy.predict(second, state, reward=1.0)
    other, _ = policy.predict(second, state, reward=300.0)  # a branch
    assert np.abs(other - action).max() > 1e-3
    _equal(state, before)
    kept = pickle.loads(pickle.dumps(jax.device_get(state)))
    assert all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(kept))
    again, after_again = policy.predict(second, kept, reward=1.0)
    np.testing.assert_array_equal(again, action)
    _equal(after_again, after)


def test_an_initial_state_begins_episodes_whatever_the_flag(policy: Policy) -> None:
    obs = _observations(2)
    action, after = policy.predict(obs)
    for state in (None, policy.initial_state(2)):
        for episode_start in (None, False, True, [False, True]):
            got, got_after = policy.predict(obs, state, episode_start)
            np.testing.assert_array_equal(got, action)
            _equal(got_after, after)


def test_one_environment_and_a_vector_of_one_are_the_same(policy: Policy) -> None:
    first, second = _observations(2)
    alone, state = policy.predict(first)
    rows, _ = policy.predict(first[None])
    assert (alone.shape, rows.shape) == ((ACT,), (1, ACT))
    np.testing.assert_array_equal(rows[0], alone)
    _equal(
        policy.predict(second, state, reward=2.0)[0],
        policy.predict(second[None], state, reward=[2.0])[0][0],
    )


# --- what is refused ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"obs": np.zeros(2)}, r"obs of shape \(2,\): must be \(3,\) or \(N, 3\)"),
        ({"obs": np.zeros(())}, r"obs of shape \(\): must be \(3,\) or \(N, 3\)"),
        ({"obs": np.zeros((0, 3))}, r"obs of shape \(0, 3\): must be"),
        ({"obs": np.zeros((1, 2, 3))}, r"obs of shape \(1, 2, 3\): must be"),
        ({"reward": np.zeros(2)}, r"reward of shape \(2,\): must be \(3,\), or a scalar"),
        ({"episode_start": [True]}, r"episode_start of shape \(1,\): must be \(3,\), or a scalar"),
        ({"obs": np.zeros(3), "reward": [0.0]}, r"reward of shape \(1,\): must be a scalar"),
        ({"obs": np.zeros((2, 3)), "state": "of 3"}, "state of 3 environments, obs of 2: must be"),
        ({"state": ()}, "state of type tuple: must be what the previous predict"),
        ({"state": "of ppo"}, "state of another policy"),
    ],
    ids=str,
)
def test_bad_arguments_are_refused(
    policy: Policy, ppo: Policy, arguments: dict[str, Any], message: str
) -> None:
    obs = _observations(3)
    states = {"of 3": policy.initial_state(3), "of ppo": ppo.initial_state(3)}
    if arguments.get("state") in states:
        arguments = {**arguments, "state": states[arguments["state"]]}
    with pytest.raises(ValueError, match=message):
        policy.predict(**{"obs": obs, **arguments})


def test_initial_states_of_nobody_are_refused(policy: Policy) -> None:
    with pytest.raises(ValueError, match="num_envs=0: must be at least 1"):
        policy.initial_state(0)


def test_a_missing_reward_is_an_error_only_within_an_episode(policy: Policy, ppo: Policy) -> None:
    obs = _observations(2)
    action, state = policy.predict(obs)
    for episode_start in (None, [True, False]):
        with pytest.raises(ValueError, match=r"predict\(obs, state, reward=reward\)"):
            policy.predict(obs, state, episode_start)
    np.testing.assert_array_equal(policy.predict(obs, state, episode_start=True)[0], action)
    # Who is told no return needs no reward, and none changes anything.
    for blind in (ppo, small_policy(return_conditioning="none")):
        assert not blind.uses_reward
        _, state = blind.predict(obs)
        _equal(blind.predict(obs, state)[0], blind.predict(obs, state, reward=1e3)[0])


# --- drawing -----------------------------------------------------------------------------------


@pytest.mark.parametrize("agent", ["sacformer", "td3", "ppo"])
def test_a_drawn_action_is_the_agents_own(agent: str) -> None:
    policy = small_policy(agent)
    obs = _observations(2)
    words = np.array([0, 7], np.uint32)  # of the key of seed 7
    _, act_key = jax.random.split(jax.random.wrap_key_data(words, impl="threefry2x32"))
    length = policy.config.context.context_length
    context = contexts.start(jnp.asarray(obs), length, ACT, {})
    act = jax.jit(policy.agent.act, static_argnames="explore")
    expected = act(policy.state, context, act_key, explore=True).action
    action, state = policy.predict(obs, policy.initial_state(2, seed=7), deterministic=False)
    np.testing.assert_allclose(action, expected, atol=1e-5)
    assert np.abs(action - policy.predict(obs)[0]).max() > 1e-3
    assert (np.abs(action) <= LIMIT).all()
    # The state goes on, to either kind of step.
    policy.predict(obs, state, deterministic=True, reward=0.0)
    policy.predict(obs, state, deterministic=False, reward=0.0)


def test_draws_differ_from_call_to_call_and_repeat_from_a_seed(ppo: Policy) -> None:
    obs = _observations()

    def drawn(num: int) -> list[float]:
        return [float(ppo.predict(obs, deterministic=False)[0][0]) for _ in range(num)]

    ppo.set_random_seed(3)
    first = drawn(4)
    assert len(set(first)) == 4
    ppo.set_random_seed(3)
    assert drawn(4) == first
    ppo.set_random_seed(4)
    assert not set(drawn(4)) & set(first)

    state: ActingState | None = ppo.initial_state(seed=5)
    along = []
    for _ in range(4):
        action, state = ppo.predict(obs, state, deterministic=False)
        along.append(float(action[0]))
    assert len(set(along)) == 4


def test_spaces_are_gymnasiums(policy: Policy) -> None:
    obs = policy.observation_space.sample()
    assert obs.shape == (OBS,)
    action, _ = policy.predict(obs)
    assert policy.action_space.contains(action)
    assert policy.action_space == gymnasium.make("Pendulum-v1").action_space


# --- loops -------------------------------------------------------------------------------------


def _example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class _Recording(gymnasium.Wrapper):
    """Remembers the actions of each episode."""

    def __init__(self, env: gymnasium.Env):
        super().__init__(env)
        self.episodes: list[list[np.ndarray]] = []

    def reset(self, **kwargs: Any) -> Any:
        self.episodes.append([])
        return self.env.reset(**kwargs)

    def step(self, action: Any) -> Any:
        self.episodes[-1].append(np.array(action))
        return self.env.step(action)


LENGTHS = (7, 5, 10)
"""Of the episodes of three environments."""
EPISODES = 3


def _recording(length: int) -> _Recording:
    return _Recording(gymnasium.make("Pendulum-v1", max_episode_steps=length))


def _actions(env: _Recording) -> np.ndarray:
    return np.concatenate(env.episodes[:EPISODES])


@dataclasses.dataclass(frozen=True)
class _Alone:
    """What each environment saw by itself."""

    returns: list[list[float]]
    actions: list[np.ndarray]


@pytest.fixture(scope="module", params=["window", "episode"])
def acting(request: pytest.FixtureRequest) -> tuple[Policy, _Alone]:
    """A policy, and the plain loop of the example in each environment alone, seeds 5, 6, 7."""
    policy = small_policy(acting_context=request.param)
    play, envs = _example("deploy_gymnasium").play, [_recording(length) for length in LENGTHS]
    returns = [play(policy, env, EPISODES, seed=5 + number) for number, env in enumerate(envs)]
    return policy, _Alone(returns, [_actions(env) for env in envs])


def _together(mode: AutoresetMode) -> SyncVectorEnv:
    return SyncVectorEnv([lambda n=n: _recording(n) for n in LENGTHS], autoreset_mode=mode)


def _same(envs: SyncVectorEnv, alone: _Alone) -> None:
    for env, actions in zip(envs.envs, alone.actions, strict=True):
        assert len(_actions(env)) == len(actions)
        np.testing.assert_allclose(_actions(env), actions, atol=1e-3)


def test_the_vector_example_equals_single_environments(acting: tuple[Policy, _Alone]) -> None:
    policy, alone = acting
    envs = _together(AutoresetMode.NEXT_STEP)
    returns = _example("deploy_vector").play(policy, envs, EPISODES, seed=5)
    np.testing.assert_allclose(returns, alone.returns, rtol=1e-4)
    _same(envs, alone)


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
def test_starts_at_the_end_of_an_episode_are_right_in_one_mode_alone(
    acting: tuple[Policy, _Alone], mode: AutoresetMode
) -> None:
    policy, alone = acting
    envs = _together(mode)
    obs, _ = envs.reset(seed=5)
    state, reward, done = None, None, np.ones(3, bool)
    for _ in range(EPISODES * (max(LENGTHS) + 1)):
        action, state = policy.predict(obs, state, done, reward=reward)
        obs, reward, terminated, truncated, _ = envs.step(action)
        done = terminated | truncated
    if mode == AutoresetMode.SAME_STEP:
        _same(envs, alone)
    else:  # the comparison does see a flag that comes a step too early
        with pytest.raises(AssertionError, match="Not equal to tolerance"):
            _same(envs, alone)


def test_rewards_in_the_observation_equal_rewards_passed(acting: tuple[Policy, _Alone]) -> None:
    """A loop that passes no reward, as ``evaluate_policy`` of Stable-Baselines3 calls it."""
    policy, alone = acting
    model = PolicyOfRewardInObs(policy)
    envs = SyncVectorEnv(
        [lambda n=n: RewardInObs(_recording(n)) for n in LENGTHS],
        autoreset_mode=AutoresetMode.SAME_STEP,
    )
    assert envs.single_observation_space.shape == (OBS + 1,)
    obs, _ = envs.reset(seed=5)
    states, starts = None, np.ones(3, bool)
    for _ in range(EPISODES * max(LENGTHS)):
        actions, states = model.predict(obs, state=states, episode_start=starts, deterministic=True)
        obs, _, terminated, truncated, _ = envs.step(actions)
        starts = terminated | truncated
    for env, expected in zip(envs.envs, alone.actions, strict=True):
        np.testing.assert_allclose(_actions(env.env), expected, atol=1e-3)
    with pytest.raises(ValueError, match="must be a Box of one axis"):
        RewardInObs(gymnasium.make("CliffWalking-v1"))

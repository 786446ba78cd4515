"""Advantages and reward scale against slow NumPy ones that follow the definitions."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sacformer_jax import normalizer
from sacformer_jax.advantages import discounted_returns, gae, scale_reward

T, N, DISCOUNT, LAMBDA = 40, 6, 0.9, 0.8


def random_steps(seed: int = 0) -> dict[str, np.ndarray]:
    """Episodes of random lengths that end in every way, some at the very end."""
    rng = np.random.default_rng(seed)
    ended, how = rng.random((T, N)) < 0.2, rng.integers(0, 3, (T, N))
    return {
        "reward": rng.normal(size=(T, N)).astype(np.float32),
        "value": rng.normal(size=(T, N)).astype(np.float32),
        "next_value": rng.normal(size=(T, N)).astype(np.float32),
        "terminated": ended & (how == 0),
        "truncated": ended & (how > 0),
        "bad": ended & (how == 2),
    }


def advantage_by_definition(steps: dict[str, np.ndarray], t: int, n: int) -> float:
    """``Σ_l (γλ)^l δ_{t+l}`` up to the end of the episode, or of the steps (Eq. 16)."""
    total, factor = 0.0, 1.0
    for later in range(t, T):
        here = {name: values[later, n] for name, values in steps.items()}
        if here["bad"]:
            break  # it says nothing
        following = 0.0 if here["terminated"] else float(here["next_value"])
        total += factor * (float(here["reward"]) + DISCOUNT * following - float(here["value"]))
        factor *= DISCOUNT * LAMBDA
        if here["terminated"] or here["truncated"]:
            break
    return total


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_gae_is_the_sum_of_its_definition(seed: int) -> None:
    steps = random_steps(seed)
    assert all(steps[name].sum() > 5 for name in ("terminated", "truncated", "bad"))
    ours = jax.jit(gae)(**steps, discount=DISCOUNT, gae_lambda=LAMBDA)
    expected = [[advantage_by_definition(steps, t, n) for n in range(N)] for t in range(T)]
    np.testing.assert_allclose(ours, expected, rtol=1e-5, atol=1e-5)


def by_hand(**changes: Any) -> np.ndarray:
    """γ = 1/2, λ = 1/2, three steps of one environment; rewards 1, 2, 4, values all 8."""
    steps: dict[str, Any] = {
        "reward": jnp.array([[1.0], [2.0], [4.0]]),
        "value": jnp.full((3, 1), 8.0),
        "next_value": jnp.full((3, 1), 8.0),
        **{name: jnp.zeros((3, 1), bool) for name in ("terminated", "truncated", "bad")},
    }
    steps.update({name: steps[name].at[1].set(value) for name, value in changes.items()})
    return np.asarray(gae(**steps, discount=jnp.float32(0.5), gae_lambda=0.5))[:, 0]


def test_gae_by_hand() -> None:
    # δ = r + 8/2 - 8 = -3, -2, 0.
    assert by_hand().tolist() == [-3.5, -2.0, 0.0]
    # The second step ends the task: δ = 2 - 8.
    assert by_hand(terminated=True).tolist() == [-4.5, -6.0, 0.0]
    # It is the last before the time limit and came to a state of value 6: δ = 2 + 3 - 8.
    assert by_hand(truncated=True, next_value=6.0).tolist() == [-3.75, -3.0, 0.0]
    # It means nothing: the first one stands on the value of the state that it led to.
    assert by_hand(truncated=True, bad=True, next_value=6.0, reward=99.0).tolist() == [-3, 0, 0]


def test_nothing_comes_from_a_later_episode() -> None:
    steps = random_steps()
    done = steps["terminated"] | steps["truncated"]
    t, n = map(int, np.argwhere(done[:-1])[3])
    steps["reward"][t + 1 :, n] = 1e6
    steps["value"][t + 1 :, n] = -1e6
    changed = gae(**steps, discount=DISCOUNT, gae_lambda=LAMBDA)
    before = gae(**random_steps(), discount=DISCOUNT, gae_lambda=LAMBDA)
    np.testing.assert_array_equal(changed[: t + 1, n], before[: t + 1, n])


def test_the_ends_of_lambda() -> None:
    steps = random_steps()
    terminated, truncated = steps["terminated"], steps["truncated"]
    steps["bad"][:] = False
    # Within an episode a step leads to the state that the next one acts on.
    goes_on = ~(terminated | truncated)[:-1]
    steps["next_value"][:-1][goes_on] = steps["value"][1:][goes_on]
    following = np.where(terminated, 0.0, steps["next_value"])
    one_step = steps["reward"] + DISCOUNT * following - steps["value"]
    advantage = gae(**steps, discount=DISCOUNT, gae_lambda=0.0)
    np.testing.assert_allclose(advantage, one_step, rtol=1e-5, atol=1e-6)
    # λ = 1: the discounted return that follows, with a value where it breaks off.
    later, returned = steps["next_value"][-1], np.zeros((T, N))
    for t in reversed(range(T)):
        later = np.where(truncated[t], steps["next_value"][t], later)
        later = steps["reward"][t] + DISCOUNT * np.where(terminated[t], 0.0, later)
        returned[t] = later
    advantage = gae(**steps, discount=DISCOUNT, gae_lambda=1.0)
    np.testing.assert_allclose(advantage + steps["value"], returned, rtol=1e-4, atol=1e-5)


# --- the scale of rewards -------------------------------------------------------------------------


def returns_one_by_one(reward: np.ndarray, done: np.ndarray, discount: float) -> np.ndarray:
    returns, running = np.zeros_like(reward), np.zeros(reward.shape[1])
    for t in range(len(reward)):
        running = discount * running + reward[t]
        returns[t] = running
        running = np.where(done[t], 0.0, running)
    return returns


def test_discounted_returns_go_on_in_the_next_rollout() -> None:
    steps = random_steps()
    reward, done = steps["reward"], steps["terminated"] | steps["truncated"]
    first, between = discounted_returns(reward[:15], done[:15], jnp.zeros(N), DISCOUNT)
    second, after = discounted_returns(reward[15:], done[15:], between, DISCOUNT)
    expected = returns_one_by_one(reward, done, DISCOUNT)
    np.testing.assert_allclose(np.concatenate([first, second]), expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(after, np.where(done[-1], 0.0, expected[-1]), rtol=1e-5, atol=1e-6)


def test_rewards_are_divided_by_the_spread_of_returns_so_far() -> None:
    rng, statistics, running = np.random.default_rng(3), normalizer.init(1), jnp.zeros(N)
    rewards, dones = rng.normal(3.0, 5.0, (3, T, N)).astype(np.float32), rng.random((3, T, N)) < 0.1
    for number, (reward, done) in enumerate(zip(rewards, dones, strict=True), start=1):
        returns, running = discounted_returns(reward, done, running, DISCOUNT)
        statistics = normalizer.update(statistics, returns[..., None])
        seen = returns_one_by_one(
            rewards[:number].reshape(-1, N), dones[:number].reshape(-1, N), DISCOUNT
        )
        assert int(statistics.count) == seen.size
        expected = np.clip(reward / np.sqrt(seen.var() + 1e-8), -10, 10)
        np.testing.assert_allclose(scale_reward(statistics, reward), expected, rtol=1e-4)


def test_scaled_rewards_are_clipped_and_keep_their_sign() -> None:
    statistics = normalizer.update(normalizer.init(1), jnp.array([[-2.0], [2.0]]) + 7.0)
    reward = jnp.array([-1e6, -4.0, 0.0, 4.0, 1e6])
    np.testing.assert_allclose(scale_reward(statistics, reward), [-10, -2, 0, 2, 10], rtol=1e-6)


def test_rewards_that_never_differ_stay_finite() -> None:
    statistics = normalizer.update(normalizer.init(1), jnp.zeros((5, 1)))
    assert scale_reward(statistics, jnp.zeros(3)).tolist() == [0.0, 0.0, 0.0]

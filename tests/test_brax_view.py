"""Our tasks as brax sees them: the same steps, under brax's own training wrappers."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax import envs as brax_envs
from probe import PointEnv

from sacformer_jax.envs import make_env
from sacformer_jax.envs.brax_view import as_brax

NUM_ENVS, STEPS, LIMIT = 3, 40, 30


def test_a_wrapped_task_takes_the_tasks_own_steps_and_resets_where_brax_does():
    ours = make_env("Hopper", "native")
    wrapped = brax_envs.training.wrap(as_brax(ours), episode_length=LIMIT)
    keys = jax.random.split(jax.random.PRNGKey(0), NUM_ENVS)
    actions = jax.random.uniform(jax.random.key(1), (STEPS, NUM_ENVS, 3), minval=-1.0)
    state = jax.jit(wrapped.reset)(keys)
    env_state, obs = jax.jit(jax.vmap(ours.reset))(keys)
    np.testing.assert_array_equal(state.obs, obs)
    first_state, first_obs = env_state, obs
    brax_step, step = jax.jit(wrapped.step), jax.jit(jax.vmap(ours.step))
    age, ends = np.zeros(NUM_ENVS, int), {"terminated": 0, "truncated": 0}
    for t in range(STEPS):
        state = brax_step(state, actions[t])
        env_state, expected = step(env_state, actions[t])  # Hopper's bounds are the unit box
        np.testing.assert_allclose(state.reward, expected.reward, rtol=1e-6)
        for name, value in expected.reward_terms.items():
            np.testing.assert_allclose(state.metrics[name], value, rtol=1e-6)
        age += 1
        truncated = (age >= LIMIT) & ~np.asarray(expected.terminated)
        done = np.asarray(expected.terminated) | truncated
        np.testing.assert_array_equal(state.done, done)
        np.testing.assert_array_equal(state.info["truncation"], truncated)
        ends["terminated"] += int((done & ~truncated).sum())
        ends["truncated"] += int(truncated.sum())

        def reset(new, first, done=done):
            return jnp.where(done.reshape(-1, *[1] * (new.ndim - 1)), first, new)

        env_state = jax.tree.map(reset, env_state, first_state)
        np.testing.assert_array_equal(state.obs, reset(expected.obs, first_obs))
        age[done] = 0
    assert ends["terminated"] > 0
    assert ends["truncated"] > 0


def test_the_unit_box_is_scaled_to_the_actions_bounds():
    ours = make_env("Humanoid", "native")
    env = as_brax(ours)
    assert (env.observation_size, env.action_size, env.backend) == (348, 17, "native")
    state = jax.jit(env.reset)(jax.random.key(0))
    after = jax.jit(env.step)(state, jnp.full(17, 0.5))
    _, expected = jax.jit(ours.step)(state.pipeline_state, jnp.full(17, 0.2))  # bounds ±0.4
    np.testing.assert_array_equal(after.obs, expected.obs)
    np.testing.assert_array_equal(after.reward, expected.reward)


class BreakingEnv(PointEnv):
    """Its physics breaks down at the third step."""

    def reset(self, key):
        state, obs = super().reset(key)
        return (state, jnp.zeros((), jnp.int32)), obs

    def step(self, state, action):
        point, count = state
        point, step = super().step(point, action)
        bad = count == 2
        step = dataclasses.replace(
            step, bad=bad, obs=jnp.where(bad, jnp.nan, step.obs), reward=step.reward / (1 - bad)
        )
        return (point, count + 1), step


class ForgetfulEnv(BreakingEnv):
    """The same, and does not say so."""

    def step(self, state, action):
        state, step = super().step(state, action)
        return state, dataclasses.replace(step, bad=jnp.zeros((), bool))


@pytest.mark.parametrize("breaking", [BreakingEnv, ForgetfulEnv])
def test_bad_physics_ends_the_episode_without_a_trace_in_the_values(breaking):
    env = as_brax(breaking())
    state = env.reset(jax.random.key(0))
    for count in range(3):
        before, state = state, env.step(state, jnp.ones(1))
        assert float(state.done) == float(state.metrics["bad_physics"]) == (count == 2)
    assert float(state.reward) == float(state.metrics["r"]) == 0.0
    np.testing.assert_array_equal(state.obs, before.obs)


@pytest.mark.parametrize("make_key", [jax.random.key, jax.random.PRNGKey])
def test_both_kinds_of_key_give_the_same_episode(make_key):
    env = as_brax(PointEnv())
    np.testing.assert_array_equal(env.reset(make_key(3)).obs, env.reset(jax.random.key(3)).obs)

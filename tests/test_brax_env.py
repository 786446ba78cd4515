"""The brax adapter against brax itself, on all of its backends."""

from __future__ import annotations

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax import envs as brax_envs

from sacformer_jax.envs import VectorEnv, make_env
from sacformer_jax.envs.brax_env import BACKENDS, BraxEnv, brax_names

LIMIT, NUM_ENVS, NUM_STEPS = 12, 2, 40


def test_unknown_names_and_backends_are_refused_with_what_there_is():
    with pytest.raises(ValueError, match=r"env='brax:cheetah'.*brax:ant, .*brax:halfcheetah"):
        BraxEnv("cheetah")
    with pytest.raises(
        ValueError, match=r"'bullet': must be one of spring, positional, generalized, mjx"
    ):
        make_env("brax:inverted_pendulum", brax_backend="bullet")
    assert {"ant", "halfcheetah", "hopper", "humanoid", "walker2d"} <= set(brax_names())


# The default backend quickly; the others compile for half a minute each.
@pytest.fixture(
    scope="module",
    params=["spring", *(pytest.param(b, marks=pytest.mark.slow) for b in BACKENDS[1:])],
)
def pendulum(request):
    """Two pendulums pushed one way until they fall, with automatic resets; and brax's own."""
    backend = request.param
    env = VectorEnv(make_env("brax:inverted_pendulum", brax_backend=backend), NUM_ENVS, LIMIT)
    theirs = brax_envs.get_environment("inverted_pendulum", backend=backend)
    # The first is pushed hard and falls; the second is left alone and meets the time limit.
    actions = jnp.broadcast_to(jnp.array([[1.0], [0.0]]), (NUM_STEPS, NUM_ENVS, 1))

    @jax.jit
    def rollout(key):
        def body(state, action):
            next_state, step = env.step(state, action)
            return next_state, (state, step, next_state.time_step)

        state = env.init(key)
        return state.obs, *jax.lax.scan(body, state, actions)[1]

    first_obs, states, step, time_step = jax.device_get(rollout(jax.random.key(0)))
    return SimpleNamespace(
        backend=backend,
        spec=env.env.spec,
        theirs=theirs,
        rollout=rollout,
        actions=np.asarray(actions),
        first_obs=first_obs,
        states=states,
        step=step,
        time_step=time_step,
    )


def test_spec(pendulum):
    spec = pendulum.spec
    assert (spec.name, spec.engine) == ("brax:inverted_pendulum", f"brax {pendulum.backend}")
    assert (spec.obs_size, spec.action_size) == (4, 1)
    assert (spec.action_low, spec.action_high) == ((-1.0,), (1.0,))
    assert spec.max_episode_steps == 1000
    assert spec.gymnasium_id is None


def test_steps_are_finite_and_move(pendulum):
    step = pendulum.step
    for leaf in jax.tree.leaves(step):
        assert np.all(np.isfinite(leaf))
    assert step.obs.shape == (NUM_STEPS, NUM_ENVS, 4)
    assert step.obs.dtype == step.reward.dtype == np.float32
    assert step.terminated.dtype == step.truncated.dtype == bool
    assert not np.any(step.bad)
    assert np.all(step.reward == 1)
    # A push to the right moves the cart to the right.
    assert step.obs[3, 0, 0] > pendulum.first_obs[0, 0]


def test_terminated_is_braxs_done_and_truncated_is_our_limit(pendulum):
    step = pendulum.step
    # Brax's rule for this task: an angle beyond 0.2.
    np.testing.assert_array_equal(step.terminated, np.abs(step.obs[..., 1]) > 0.2)
    assert np.any(step.terminated[:, 0])
    assert not np.any(step.terminated[:LIMIT, 1])
    assert step.truncated[LIMIT - 1, 1]
    np.testing.assert_array_equal(pendulum.time_step == 0, step.done)


def test_resets_are_freshly_random(pendulum):
    step = pendulum.step
    fresh = [pendulum.first_obs, step.next_obs[step.done]]
    fresh.append(jax.device_get(pendulum.rollout(jax.random.key(1)))[0])
    fresh = np.concatenate(fresh)
    assert np.unique(fresh[:, 0]).size == len(fresh) >= 8
    assert np.all(np.abs(fresh) <= 0.01 + 1e-6)
    assert np.all(pendulum.time_step[step.done] == 0)
    np.testing.assert_array_equal(step.next_obs[~step.done], step.obs[~step.done])


def test_step_is_braxs_own_step_from_the_same_state(pendulum):
    their_step = jax.jit(pendulum.theirs.step)
    falls = np.flatnonzero(pendulum.step.terminated[:, 0])[0]
    for t, env in ((0, 0), (1, 1), (falls, 0), (NUM_STEPS - 1, 1)):
        state = jax.tree.map(lambda x, i=(t, env): jnp.asarray(x[i]), pendulum.states.env)
        expected = their_step(state, pendulum.actions[t, env])
        ours = jax.tree.map(lambda x, i=(t, env): x[i], pendulum.step)
        # Another program (no vmap, no scan), so another rounding.
        np.testing.assert_allclose(ours.obs, expected.obs, rtol=1e-4, atol=1e-5)
        assert ours.reward == expected.reward
        assert bool(ours.terminated) is bool(expected.done > 0.5)

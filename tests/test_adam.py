"""Adam: optax's, step by step; a step that is not sound changes nothing."""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from sacformer_jax.agents.adam import Adam
from sacformer_jax.types import Params

RATE = 1e-2


def random_params(seed: int, scale: float = 1.0) -> Params:
    rng = np.random.default_rng(seed)
    return {
        "kernel": jnp.asarray(scale * rng.normal(size=(5, 3)), jnp.float32),
        "bias": jnp.asarray(scale * rng.normal(size=3), jnp.float32),
    }


@pytest.mark.parametrize("eps", [1e-8, 1e-5, 1e-1])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e4])
def test_steps_are_those_of_optax(eps: float, scale: float) -> None:
    adam, reference = Adam(eps), optax.adam(RATE, eps=eps)
    params = expected = random_params(0)
    state, reference_state = adam.init(params), reference.init(params)
    step = jax.jit(adam.step_where)
    for seed in range(1, 30):
        grads = random_params(seed, scale)
        params, state = step(jnp.array(True), params, grads, state, jnp.float32(RATE))
        changes, reference_state = reference.update(grads, reference_state)
        expected = optax.apply_updates(expected, changes)
        chex.assert_trees_all_close(params, expected, rtol=1e-5, atol=1e-6)
    chex.assert_trees_all_close(state, reference_state[0], rtol=1e-5)
    assert state.count == 29


def test_a_step_that_is_not_sound_leaves_everything_as_it_is() -> None:
    adam, params = Adam(), random_params(0)
    _, state = adam.step_where(
        jnp.array(True), params, random_params(1), adam.init(params), jnp.float32(RATE)
    )
    broken = jax.tree.map(lambda grad: grad.at[0].set(jnp.nan), random_params(2))
    after = adam.step_where(jnp.array(False), params, broken, state, jnp.float32(RATE))
    chex.assert_trees_all_equal(after, (params, state))


def test_rates_may_differ_between_the_parts_of_a_tree() -> None:
    adam, params, grads = Adam(), random_params(0), random_params(1)
    state, sound = adam.init(params), jnp.array(True)
    rates = {"kernel": jnp.float32(RATE), "bias": jnp.float32(0.0)}
    after, _ = adam.step_where(sound, params, grads, state, rates)
    together, _ = adam.step_where(sound, params, grads, state, jnp.float32(RATE))
    chex.assert_trees_all_equal(after["bias"], params["bias"])
    chex.assert_trees_all_equal(after["kernel"], together["kernel"])

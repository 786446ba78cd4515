"""Return-to-go arithmetic and the acting context, by hand."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sacformer_jax import context as contexts
from sacformer_jax.types import Acted


def test_context_keeps_the_last_k_pairs_and_clears_at_a_reset():
    # Two environments; the second one's episode ends at the second step.
    context = contexts.start(jnp.array([[10.0], [20.0]]), 3, action_size=1, cache={})
    assert context.mask.tolist() == [[False, False, True]] * 2
    assert context.obs[:, -1, 0].tolist() == [10.0, 20.0]
    steps = [
        ([[0.1], [0.4]], [[11.0], [21.0]], [1.0, 5.0], [False, False]),
        ([[0.2], [0.5]], [[12.0], [90.0]], [2.0, 6.0], [False, True]),
        ([[0.3], [0.6]], [[13.0], [91.0]], [3.0, 7.0], [False, False]),
    ]
    for step in steps:
        action, *rest = map(jnp.array, step)
        context = jax.jit(contexts.advance)(Acted(action, context), *rest)
    assert context.obs[..., 0].tolist() == [[11.0, 12.0, 13.0], [21.0, 90.0, 91.0]]
    # An action stands beside the state it was done in; the newest is still to come.
    np.testing.assert_allclose(context.action[0, :, 0], [0.2, 0.3, 0.0])
    np.testing.assert_allclose(context.action[1, 1:, 0], [0.6, 0.0])
    assert context.mask.tolist() == [[True, True, True], [False, True, True]]
    assert context.time_step.tolist()[0] == [1, 2, 3]
    assert context.time_step.tolist()[1][1:] == [0, 1]
    assert context.return_so_far.tolist()[0] == [1.0, 3.0, 6.0]
    assert context.return_so_far.tolist()[1][1:] == [0.0, 7.0]


def test_commanded_return_to_go_is_equation_1_unrolled():
    rewards = [3.0, -1.0, 2.5]
    return_to_go, expected = 10.0, [10.0]
    for reward in rewards:  # G_t = G_{t-1} - R_{t-1}
        return_to_go -= reward
        expected.append(return_to_go)
    so_far = jnp.array([0.0, 3.0, 2.0, 4.5])
    scaled = contexts.commanded_return_to_go(so_far, jnp.float32(10.0), jnp.float32(4.0))
    np.testing.assert_allclose(scaled, np.array(expected) / 4.0)


def test_suffix_sums_against_float64_and_far_from_the_origin():
    rng = np.random.default_rng(0)
    # A large reward long ago must not cost precision: prefix sums would lose it.
    rewards = rng.normal(size=(4, 1006))
    rewards[:, 0] = 1e6
    for discount in (0.99, 1.0):
        expected = np.zeros((4, 1006))
        running = np.zeros(4)
        for i in reversed(range(1006)):
            running = rewards[:, i] + discount * running
            expected[:, i] = running
        got = contexts.discounted_suffix_sums(
            jnp.asarray(rewards, jnp.float32), 7, jnp.float32(discount)
        )
        np.testing.assert_allclose(got[:, 1:], expected[:, 1:7], rtol=1e-4, atol=1e-4)


def test_suffix_sums_of_a_single_position():
    got = contexts.discounted_suffix_sums(jnp.array([[1.0, 2.0, 4.0]]), 1, jnp.float32(0.5))
    assert got.tolist() == [[3.0]]


@pytest.mark.parametrize("length", [1, 2, 7, 8, 9])
@pytest.mark.parametrize("discount", [0.0, 0.9, 1.0])
def test_all_suffix_sums_are_backward_sums(length, discount):
    rewards = np.random.default_rng(length).normal(size=(3, length)).astype(np.float32)
    expected = np.zeros((3, length))
    total = np.zeros(3)
    for i in reversed(range(length)):
        total = rewards[:, i] + discount * total
        expected[:, i] = total
    got = jax.jit(contexts.all_discounted_suffix_sums)(rewards, jnp.float32(discount))
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-5)

"""The window contract: every field of every possible window against a NumPy oracle.

Data is id-encoded (each stored step has a number of its own in every field), and windows are
enumerated rather than sampled, so expected weights are exact and nothing is left to chance.
"""

from __future__ import annotations

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from replay import (
    GAMMA,
    MAX_EPISODE,
    Step,
    filled,
    make_buffer,
    oracle_return_to_go,
    simulate,
    stored,
)

from sacformer_jax.buffer import TrajectoryBuffer
from sacformer_jax.types import Window


def eligible(steps: list[Step], hindsight: bool) -> int:
    """How many of the oldest steps may be drawn."""
    if not hindsight:
        return len(steps)
    ends = [i for i, s in enumerate(steps) if s.terminated or s.truncated]
    return ends[-1] + 1 if ends else 0


def every_window(
    buffer: TrajectoryBuffer, columns: list[list[Step]]
) -> tuple[list[tuple[int, int, int]], Window]:
    """All (column, anchor, slot) and the windows they give."""
    ring = stored(columns, buffer.length)
    places = [
        (column, anchor, slot)
        for column, steps in enumerate(ring)
        for anchor in range(eligible(steps, buffer.hindsight))
        for slot in range(buffer.burn_in, buffer.burn_in + buffer.context_length)
    ]
    column, anchor, slot = (jnp.asarray(x) for x in zip(*places, strict=True))
    window = jax.jit(buffer.window)(filled(buffer, columns), column, anchor, slot, GAMMA)
    return places, jax.tree.map(np.asarray, window)


CASES = [
    *itertools.product((1, 2, 5), (False, True), (17, 25, 61), (0,)),
    (2, False, 61, 1),
    (3, True, 25, 4),
]
CASE = ("context_length", "hindsight", "num_steps", "burn_in")


@pytest.mark.parametrize(CASE, CASES)
def test_every_window_against_the_oracle(context_length, hindsight, num_steps, burn_in):
    buffer = make_buffer(context_length, hindsight, burn_in=burn_in)
    length = burn_in + context_length
    columns = simulate(num_steps, num_steps)
    ring = stored(columns, buffer.length)
    places, window = every_window(buffer, columns)
    for b, (column, anchor, slot) in enumerate(places):
        steps = ring[column]
        indices = [anchor - slot + i for i in range(length + 1)]
        real = [0 <= i < len(steps) and steps[i].episode == steps[anchor].episode for i in indices]
        for i, (index, is_real) in enumerate(zip(indices, real, strict=True)):
            assert window.state_mask[b, i] == is_real
            if not is_real:
                assert not window.obs[b, i].any()
                continue
            step = steps[index]
            assert window.obs[b, i].tolist() == [step.number, -step.number]
            assert window.time_step[b, i] == step.time_step
            assert window.return_so_far[b, i] == pytest.approx(step.return_so_far, abs=1e-6)
            expected = oracle_return_to_go(steps, index) if hindsight else 0.0
            assert window.return_to_go[b, i] == pytest.approx(expected, abs=1e-5)
            if i == length:
                continue
            learnt = not step.bad and i >= burn_in
            assert window.mask[b, i] == learnt
            knows_next = step.terminated or real[i + 1]
            assert window.bootstrap_mask[b, i] == (knows_next and learnt)
            if not step.bad:
                assert window.action[b, i, 0] == step.number + 0.5
            if learnt:
                assert window.reward[b, i] == np.float32(step.reward)
                assert window.discount[b, i] == 1.0 - step.terminated
        num_real = sum(real[burn_in:length])
        assert window.weight[b] == pytest.approx(1.0 / num_real)
        assert not window.mask[b][~window.state_mask[b, :-1]].any()


@pytest.mark.parametrize(CASE, CASES)
def test_every_stored_step_has_the_same_expected_weight(
    context_length, hindsight, num_steps, burn_in
):
    buffer = make_buffer(context_length, hindsight, burn_in=burn_in)
    columns = simulate(num_steps + 100, num_steps)
    places, window = every_window(buffer, columns)
    actor: dict[int, float] = {}
    critic: dict[int, float] = {}
    for b in range(len(places)):
        for i in range(burn_in + context_length):
            number = int(window.obs[b, i, 0])
            share = float(window.weight[b]) / len(places)  # places are equally likely
            if window.mask[b, i]:
                actor[number] = actor.get(number, 0.0) + share
            if window.bootstrap_mask[b, i]:
                critic[number] = critic.get(number, 0.0) + share
    may_learn, may_bootstrap = set(), set()
    for steps in stored(columns, buffer.length):
        for i, step in enumerate(steps[: eligible(steps, hindsight)]):
            if step.bad:
                continue
            may_learn.add(step.number)
            # Left out: a truncated episode's last step and the column's newest step.
            if step.terminated or (not step.truncated and i + 1 < len(steps)):
                may_bootstrap.add(step.number)
    assert set(actor) == may_learn
    assert set(critic) == may_bootstrap
    num_drawable = len(places) / context_length
    np.testing.assert_allclose(list(actor.values()), 1.0 / num_drawable, rtol=1e-5)
    np.testing.assert_allclose(list(critic.values()), 1.0 / num_drawable, rtol=1e-5)


@pytest.mark.parametrize("hindsight", [False, True])
def test_sample_draws_anchors_and_slots_uniformly(hindsight):
    buffer = make_buffer(2, hindsight)
    columns = simulate(3, 61)
    state = filled(buffer, columns)
    num = 40_000
    window = jax.jit(buffer.sample, static_argnums=2)(state, jax.random.key(0), num, GAMMA)
    window = jax.tree.map(np.asarray, window)
    drawable = [
        steps[i]
        for steps in stored(columns, buffer.length)
        for i in range(eligible(steps, hindsight))
    ]
    weights = (window.weight[:, None] * window.state_mask[:, :-1]).reshape(-1)
    numbers = window.obs[:, :-1, 0].reshape(-1).astype(int)
    totals = {step.number: 0.0 for step in drawable}
    for number, weight in zip(numbers, weights, strict=True):
        if weight > 0:
            totals[number] += weight / num  # KeyError: drawn though not eligible
    expected = 1.0 / len(drawable)
    # Each total is a mean of `num` draws in [0, 1]: five standard errors.
    bound = 5 * np.sqrt(expected / num)
    assert np.abs(np.array(list(totals.values())) - expected).max() < bound


def test_can_sample_only_what_is_eligible():
    plain, hindsight = make_buffer(2, False), make_buffer(2, True)
    assert not plain.can_sample(plain.init())
    columns = [steps[:1] for steps in simulate(0, 1)]
    for steps in columns:
        steps[0] = dataclasses.replace(steps[0], terminated=False, truncated=False, bad=False)
    assert plain.can_sample(filled(plain, columns))
    assert not hindsight.can_sample(filled(hindsight, columns))
    columns[1][0].truncated = True
    state = filled(hindsight, columns)
    assert hindsight.can_sample(state)
    assert hindsight.eligible(state).tolist() == [0, 1, 0]


def test_vmapped_buffers_equal_single_ones():
    buffer = make_buffer(5, True)
    states = [filled(buffer, simulate(seed, 61)) for seed in (1, 2)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *states)
    keys = jax.random.split(jax.random.key(5), 2)

    def sample(state, key):
        return buffer.sample(state, key, 16, jnp.float32(GAMMA))

    together = jax.jit(jax.vmap(sample))(stacked, keys)
    alone_jitted = jax.jit(sample)
    for i, state in enumerate(states):
        alone = alone_jitted(state, keys[i])
        for a, b in zip(jax.tree.leaves(alone), jax.tree.leaves(together), strict=True):
            np.testing.assert_allclose(a, b[i], rtol=1e-6)


def test_memory_is_one_copy_of_each_step():
    buffer = TrajectoryBuffer(4, 5_000, 17, 6, 6, 1000)
    state = jax.eval_shape(buffer.init)
    num_bytes = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(state))
    one_step = 4 * (17 + 6 + 1 + 1 + 1) + 3  # obs, action, reward, time step, return; three flags
    assert num_bytes <= 1.1 * 4 * 5_000 * one_step


def test_refuses_a_ring_shorter_than_an_episode_and_a_window():
    make_buffer(5, False, length=MAX_EPISODE + 5)
    with pytest.raises(ValueError, match=r"buffer_capacity=33 over num_envs=3 .*>= 36"):
        make_buffer(5, False, length=MAX_EPISODE + 4)
    with pytest.raises(ValueError, match=r"buffer_capacity=36 over num_envs=3 .*>= 39"):
        make_buffer(5, False, length=MAX_EPISODE + 5, burn_in=1)

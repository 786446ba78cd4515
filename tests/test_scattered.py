"""Scattered windows: the table of episodes, every field of every window, and how they are drawn."""

from __future__ import annotations

import dataclasses
import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import with_users_loops
from replay import (
    GAMMA,
    MAX_EPISODE,
    NUM_ENVS,
    Step,
    filled,
    make_buffer,
    oracle_return_to_go,
    simulate,
    stored,
    transitions,
)

from sacformer_jax import episodes
from sacformer_jax.buffer import TrajectoryBuffer
from sacformer_jax.types import BufferState

make = partial(make_buffer, hindsight=True, scattered=True)


def finished(steps: list[Step], shortest: int) -> list[list[Step]]:
    """A column's finished episodes that are all there, without bad last steps, if long enough."""
    found = []
    for _, group in itertools.groupby(steps, key=lambda step: step.episode):
        episode = list(group)
        whole = episode[0].time_step == 0 and (episode[-1].terminated or episode[-1].truncated)
        if episode[-1].bad:
            episode.pop()
        if whole and len(episode) >= shortest:
            found.append(episode)
    return found


def listed(state: BufferState) -> list[list[list[int]]]:
    """The number of every step of every episode in the table, oldest first, by column."""
    state = jax.tree.map(np.asarray, state)
    table, ring = state.episodes, state.steps.obs[..., 0]
    columns = []
    for column in range(NUM_ENVS):
        entries = []
        for rank in range(table.count[column]):
            place = (table.first[column] + rank) % table.start.shape[1]
            start, length = table.start[column, place], table.length[column, place]
            positions = (start + np.arange(length)) % ring.shape[1]
            entries.append(ring[column, positions].astype(int).tolist())
        columns.append(entries)
    return columns


@pytest.mark.parametrize("shortest", [1, 2, 5])
def test_the_table_after_every_single_step(shortest):
    """Over several turns of the ring, with episodes of every length, bad last steps among them."""
    buffer, num_steps = make(shortest), 120
    columns = simulate(7, num_steps)
    assert any(s.bad for steps in columns for s in steps)
    add = jax.jit(buffer.add)
    state, every_step = buffer.init(), transitions(columns)
    for now in range(num_steps):
        state = add(state, jax.tree.map(lambda x, now=now: x[now], every_step))
        rings = stored([steps[: now + 1] for steps in columns], buffer.length)
        expected = [
            [[step.number for step in episode] for episode in finished(steps, shortest)]
            for steps in rings
        ]
        assert listed(state) == expected, now


@pytest.mark.parametrize(
    ("context_length", "hindsight"), [(1, True), (2, True), (3, True), (3, False)]
)
def test_every_window_against_the_oracle(context_length, hindsight):
    buffer, columns = make(context_length, hindsight=hindsight), simulate(11, 61)
    cases = [
        (column, episode, places)
        for column, steps in enumerate(stored(columns, buffer.length))
        for episode in finished(steps, context_length)
        for places in itertools.combinations(range(len(episode)), context_length)
    ]
    assert len(cases) > 30
    drawn = episodes.Drawn(
        column=jnp.array([column for column, _, _ in cases]),
        start=jnp.array(
            [(columns[column].index(episode[0])) % buffer.length for column, episode, _ in cases]
        ),
        length=jnp.array([len(episode) for _, episode, _ in cases]),
        exists=jnp.ones(len(cases), bool),
    )
    chosen = jnp.array([places for _, _, places in cases])
    window = jax.jit(buffer.scattered_window)(filled(buffer, columns), drawn, chosen, GAMMA)
    window = jax.tree.map(np.asarray, window)
    unknown = 0
    for b, (column, episode, places) in enumerate(cases):
        assert window.weight[b] == 1.0
        assert window.mask[b].all()
        assert window.state_mask[b].all()
        for i, place in enumerate(places):
            step, after = episode[place], window.following
            whole = columns[column]
            index = whole.index(step)
            assert window.obs[b, i].tolist() == [step.number, -step.number]
            assert window.action[b, i, 0] == step.number + 0.5
            assert window.reward[b, i] == np.float32(step.reward)
            assert window.discount[b, i] == 1.0 - step.terminated
            assert window.time_step[b, i] == step.time_step
            assert window.return_so_far[b, i] == pytest.approx(step.return_so_far, abs=1e-6)
            expected = oracle_return_to_go(whole, index) if hindsight else 0.0
            assert window.return_to_go[b, i] == pytest.approx(expected, abs=1e-5)
            knows_next = not (step.terminated or step.truncated)
            assert after.mask[b, i] == knows_next
            assert window.bootstrap_mask[b, i] == (knows_next or step.terminated)
            assert after.time_step[b, i] == step.time_step + 1
            if not knows_next:
                assert not after.obs[b, i].any()
                unknown += 1
                continue
            following = whole[index + 1]
            assert after.obs[b, i].tolist() == [following.number, -following.number]
            assert after.return_so_far[b, i] == pytest.approx(following.return_so_far, abs=1e-5)
            expected = oracle_return_to_go(whole, index + 1) if hindsight else 0.0
            assert after.return_to_go[b, i] == pytest.approx(expected, abs=1e-5)
    assert unknown > 5


def test_distinct_sorted_draws_every_set_equally_often():
    num = 30_000
    drawn = jax.jit(episodes.distinct_sorted, static_argnums=2)(
        jax.random.key(0), jnp.full(num, 5), 3
    )
    sets, counts = np.unique(np.asarray(drawn), axis=0, return_counts=True)
    assert sets.tolist() == [list(c) for c in itertools.combinations(range(5), 3)]
    expected = num / len(sets)
    assert np.abs(counts - expected).max() < 5 * np.sqrt(expected)  # five standard deviations
    # A set of all there is, and different lengths in one batch.
    lengths = jnp.array([3, 4, 1000])
    drawn = np.asarray(episodes.distinct_sorted(jax.random.key(1), lengths, 3))
    assert drawn[0].tolist() == [0, 1, 2]
    assert (np.diff(drawn, axis=1) > 0).all()
    assert (drawn.max(1) < lengths).all()


def test_sample_draws_episodes_uniformly_and_steps_within_them():
    buffer, columns = make(2), simulate(3, 61)
    num = 40_000
    state = filled(buffer, columns)
    window = jax.jit(buffer.sample, static_argnums=2)(state, jax.random.key(0), num, GAMMA)
    all_episodes = [e for steps in stored(columns, buffer.length) for e in finished(steps, 2)]
    assert len({len(e) for e in all_episodes}) > 3  # short ones count as much as long ones
    owner = {step.number: i for i, episode in enumerate(all_episodes) for step in episode}
    numbers = np.asarray(window.obs[..., 0]).astype(int)
    first = np.array([owner[n] for n in numbers[:, 0]])  # KeyError: not of a finished episode
    assert (first == np.array([owner[n] for n in numbers[:, 1]])).all()
    assert (np.diff(np.asarray(window.time_step), axis=1) > 0).all()
    counts = np.bincount(first, minlength=len(all_episodes))
    expected = num / len(all_episodes)
    assert np.abs(counts - expected).max() < 5 * np.sqrt(expected)


def test_an_empty_table_gives_windows_without_weight():
    buffer = make(5)
    columns = simulate(0, 4)
    for steps in columns:  # episodes too short, one after the other
        for i, step in enumerate(steps):
            steps[i] = dataclasses.replace(step, time_step=0, terminated=True, truncated=False)
    for state in (buffer.init(), filled(buffer, columns)):
        assert not buffer.can_sample(state)
        window = buffer.sample(state, jax.random.key(0), 3, jnp.float32(GAMMA))
        assert not window.mask.any()
        assert not window.bootstrap_mask.any()
        assert not window.following.mask.any()
        assert not window.weight.any()
        assert np.isfinite(window.return_to_go).all()
    assert buffer.can_sample(filled(buffer, simulate(0, 61)))


def test_vmapped_buffers_equal_single_ones():
    buffer = make(3)
    states = [filled(buffer, simulate(seed, 61)) for seed in (1, 2)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *states)
    keys = jax.random.split(jax.random.key(5), 2)

    def sample(state, key):
        return buffer.sample(state, key, 16, jnp.float32(GAMMA))

    together = with_users_loops(jax.jit(jax.vmap(sample)), stacked, keys)(stacked, keys)
    for i, state in enumerate(states):
        compiled = with_users_loops(jax.jit(sample), state, keys[i])
        for alone in (compiled(state, keys[i]), sample(state, keys[i])):
            for a, b in zip(jax.tree.leaves(alone), jax.tree.leaves(together), strict=True):
                np.testing.assert_allclose(a, b[i], rtol=1e-6)


def test_a_fresh_replay_can_be_donated():
    buffer = make(2)
    add = jax.jit(buffer.add, donate_argnums=0)
    step = jax.tree.map(lambda x: x[0], transitions(simulate(0, 1)))
    assert int(add(buffer.init(), step).size) == 1  # an alias would be donated twice


def test_the_shortest_ring_always_holds_an_episode():
    """All columns in step, every episode as long as can be: the worst case."""
    buffer = make(5, length=2 * MAX_EPISODE)
    with pytest.raises(ValueError, match=r"must be at least 14 each"):
        make(5, length=2 * MAX_EPISODE - 1)
    columns = simulate(0, 5 * MAX_EPISODE)
    for steps in columns:
        for i, step in enumerate(steps):
            last = i % MAX_EPISODE == MAX_EPISODE - 1
            steps[i] = dataclasses.replace(
                step, time_step=i % MAX_EPISODE, truncated=last, terminated=False, bad=False
            )
    add, state, every_step = jax.jit(buffer.add), buffer.init(), transitions(columns)
    for now in range(5 * MAX_EPISODE):
        state = add(state, jax.tree.map(lambda x, now=now: x[now], every_step))
        assert bool(buffer.can_sample(state)) == (now >= MAX_EPISODE - 1), now


def test_the_table_takes_little_memory():
    plain = TrajectoryBuffer(4, 5_000, 17, 6, 6, 1000)
    scattered = dataclasses.replace(plain, scattered=True)
    sizes = [
        sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(jax.eval_shape(buffer.init)))
        for buffer in (plain, scattered)
    ]
    assert sizes[1] < 1.02 * sizes[0]

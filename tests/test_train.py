"""The training program: it learns, counts, compiles once, and vmaps over seeds."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probe import EPISODE, PointEnv, point_config, point_env

from sacformer_jax.envs.core import VectorEnv
from sacformer_jax.evaluate import make_evaluator
from sacformer_jax.train import make_program, policy_of

# Returns on the point task: doing nothing about -25, random actions far below, the best about -4.
LEARNT = -14.0


class CountingEnv(PointEnv):
    """Counts how often its step is traced."""

    traces = 0

    def step(self, state, action):
        CountingEnv.traces += 1
        return super().step(state, action)


def learning_curve(program, state, chunks=4) -> list[float]:
    """Evaluation returns after each chunk."""
    evaluator = make_evaluator(point_env(32), program.agent, program.config.context.context_length)
    returns = []
    for _ in range(chunks):
        state, metrics = program.train_chunk(state)
        assert all(np.isfinite(value) for value in metrics.values())
        result = evaluator(policy_of(state), jax.random.key(123))
        assert (np.asarray(result.lengths) == EPISODE).all()
        returns.append(float(result.returns.mean()))
    return returns


@pytest.fixture(scope="module")
def program():
    return make_program(point_config(), VectorEnv(CountingEnv(), 4))


def started(program, seed=0):
    state, _ = program.prefill(program.init(jax.random.key(seed)))
    return state


BROKEN = {
    "actor frozen": {"actor_learning_rate": 1e-12},
    "future ignored": {"discount": 0.0},
    "critics frozen": {"critic_learning_rate": 1e-12},
    "targets frozen": {"tau": 1e-12},
}


@pytest.mark.parametrize(
    "broken",
    [list(BROKEN)[:2], pytest.param(list(BROKEN)[2:], marks=pytest.mark.slow)],
    ids=" and ".join,
)
def test_learns_and_a_broken_update_does_not(program, broken):
    """The threshold is out of reach when any part of the update is broken."""
    medians = {}
    for name, changed in {"working": {}, **{name: BROKEN[name] for name in broken}}.items():
        state = started(program, seed=1)
        changes = {field: jnp.float32(value) for field, value in changed.items()}
        state = dataclasses.replace(state, hyper=dataclasses.replace(state.hyper, **changes))
        medians[name] = float(np.median(learning_curve(program, state)[1:]))
    working = medians.pop("working")
    assert working > LEARNT, medians
    assert max(medians.values()) < LEARNT, medians


def test_counts_and_compiles_once(program):
    state = started(program)
    assert int(state.counters.env_steps) == 200
    state, _ = program.train_chunk(state)
    traces = CountingEnv.traces
    for chunk in range(2, 4):
        state, metrics = program.train_chunk(state)
        counters = jax.tree.map(int, state.counters)
        assert counters.env_steps == 200 + 400 * chunk
        assert counters.updates == 400 * chunk
        assert counters.episodes == 4 * ((50 + 100 * chunk) // EPISODE)  # in step
        assert int(metrics["episodes"]) == 400 // EPISODE
        assert float(metrics["episode_length_mean"]) == EPISODE
    assert CountingEnv.traces == traces
    assert program.train_chunk._cache_size() == 1


class ShortEnv(PointEnv):
    """Terminates at once: no episode is as long as a window."""

    def step(self, state, action):
        state, step = super().step(state, action)
        return state, dataclasses.replace(step, terminated=jnp.ones((), bool))


def test_nothing_moves_where_there_is_nothing_to_learn_from():
    config = point_config(window="scattered", chunk_env_steps=40)
    program = make_program(config, VectorEnv(ShortEnv(), 4))
    state = started(program)
    assert not program.buffer.can_sample(state.buffer)
    before = jax.tree.map(np.asarray, state.learner)
    state, metrics = program.train_chunk(state)
    for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(state.learner), strict=True):
        np.testing.assert_array_equal(a, b)
    assert int(state.counters.updates) == 0
    assert int(state.counters.env_steps) == 240
    assert float(metrics["critic_loss"]) == 0.0


def test_seeds_vmap_to_the_same_runs(program):
    keys = jnp.stack([jax.random.key(seed) for seed in (3, 4)])
    together, _ = jax.jit(jax.vmap(program.prefill))(jax.jit(jax.vmap(program.init))(keys))
    for i, seed in enumerate((3, 4)):
        alone = started(program, seed)
        np.testing.assert_array_equal(
            together.buffer.steps.obs[i], alone.buffer.steps.obs
        )  # exactly, through prefill
        assert (jax.random.key_data(together.key[i]) == jax.random.key_data(alone.key)).all()


@pytest.mark.parametrize(
    ("num_envs", "utd", "updates"), [(4, 0.25, 100), (4, 0.125, 50), (2, 1.5, 600)]
)
def test_updates_per_env_step(num_envs, utd, updates):
    config = point_config(num_envs=num_envs, updates_per_env_step=utd)
    steps, per_iteration = config.steps_and_updates
    assert per_iteration / (steps * num_envs) == utd
    assert config.iterations_per_chunk * per_iteration == updates
    assert config.env_steps_per_chunk == 400


@pytest.mark.slow
def test_every_option_runs():
    """Hindsight, dropout, normalization, fixed temperature, LayerNorm: together, finite."""
    config = point_config(
        return_conditioning="hindsight",
        actor_dropout=0.1,
        normalize_obs=True,
        tune_alpha=False,
        alpha=0.2,
        critic_layer_norm=True,
        context_length=3,
        actor_heads=2,
        chunk_env_steps=80,
        updates_per_env_step=0.5,
    )
    program = make_program(config, point_env(4))
    state, metrics = program.train_chunk(started(program))
    assert all(np.isfinite(value) for value in metrics.values())
    assert float(metrics["alpha"]) == pytest.approx(0.2)
    assert int(state.learner.normalizer.count) == 200 + 80
    counted = np.asarray(state.buffer.steps.obs[:, : int(state.buffer.size)])
    np.testing.assert_allclose(state.learner.normalizer.mean, counted.mean(axis=(0, 1)), atol=1e-4)


def test_sac_is_the_same_update_with_an_mlp():
    config = point_config(agent="sac", context_length=1, return_conditioning="none")
    program = make_program(config, point_env(4))
    assert np.median(learning_curve(program, started(program, seed=1))[1:]) > LEARNT


OPTIONS = (
    {"tokens": "gsa"},
    {"critic": "transformer", "critic_width": 16},
    {"compute_dtype": "bfloat16"},
    {"acting_context": "episode"},
    {"window": "scattered"},
    {"policy": "deterministic", "tune_alpha": False},
)


@pytest.mark.parametrize("options", OPTIONS, ids=lambda options: next(iter(options)))
def test_each_option_arrives_where_it_works(options):
    program = make_program(point_config(**options), point_env(4))
    state = jax.eval_shape(program.init, jax.random.key(0))
    assert ("bf16" in program.train_chunk.lower(state).as_text()) == ("compute_dtype" in options)
    actor, critic = (p["params"] for p in (state.learner.actor_params, state.learner.critic_params))
    assert ("embed_action" in actor) == ("tokens" in options)
    assert ("embed_candidate" in critic) == ("critic" in options)
    assert (state.context.cache != {}) == ("acting_context" in options)
    assert (state.buffer.episodes is not None) == ("window" in options)


@pytest.mark.slow
@pytest.mark.parametrize("options", OPTIONS, ids=lambda options: next(iter(options)))
def test_each_option_learns(options):
    program = make_program(point_config(**options), point_env(4))
    assert np.median(learning_curve(program, started(program), chunks=5)[2:]) > LEARNT


def test_what_the_authors_program_does_runs_together():
    config = point_config(
        window="scattered",
        return_conditioning="hindsight",
        hindsight_scale=500.0,
        next_rtg_decrement=0.002,
        acting_context="episode",
        acting_context_limit=12,
        actor_dropout=0.1,
        acting_dropout=True,
        critic_init="xavier",
        tune_alpha=False,
        context_length=4,
        chunk_env_steps=80,
    )
    program = make_program(config, point_env(4))
    state, metrics = program.train_chunk(started(program))
    assert all(np.isfinite(value) for value in metrics.values())
    cache = jax.tree.leaves(state.context.cache)
    assert {x.shape for x in cache} == {(4, 1, 2 * 12, 16)}
    assert all(np.abs(x).max() > 0 for x in cache)
    assert int(state.buffer.episodes.count.sum()) == int(state.counters.episodes)


class GenerousEnv(PointEnv):
    """Positive rewards."""

    def step(self, state, action):
        state, step = super().step(state, action)
        return state, dataclasses.replace(step, reward=step.reward + 10.0)


def test_an_automatic_target_is_the_best_return_so_far_and_enters_the_policy():
    program = make_program(point_config(target_return="auto"), VectorEnv(GenerousEnv(), 4))
    state = program.init(jax.random.key(0))
    assert float(state.hyper.target_return) == 0.0
    state, metrics = program.prefill(state)
    seen = [float(metrics["episode_return_max"])]
    assert float(state.hyper.target_return) == seen[0] > 0.0
    for _ in range(3):
        state, metrics = program.train_chunk(state)
        seen.append(float(metrics["episode_return_max"]))
        assert float(state.hyper.target_return) == max(seen)
    assert seen[0] < max(seen)
    assert float(policy_of(state).target_return) == max(seen)

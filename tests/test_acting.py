"""Acting on the whole episode through the key-value cache equals computing all of it again."""

from __future__ import annotations

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gpt2 import gaussian_of, randomized
from probe import EPISODE, PointEnv, point_config, point_env

from sacformer_jax import agents, rollout
from sacformer_jax import context as contexts
from sacformer_jax.cache import cache_places
from sacformer_jax.config import Config, ConfigError
from sacformer_jax.context import commanded_return_to_go
from sacformer_jax.envs.core import EnvSpec, VectorEnv
from sacformer_jax.evaluate import make_evaluator
from sacformer_jax.networks import TransformerActor
from sacformer_jax.policy import Policy
from sacformer_jax.train import hyperparameters, make_program, policy_of, policy_state
from sacformer_jax.transformer import TransformerConfig
from sacformer_jax.types import Acted

OBS, ACT, ENVS = 3, 2, 2


@pytest.mark.parametrize("kinds", ["J", "GS", "GSA"])
@pytest.mark.parametrize("band", [1, 3, 20])
def test_places_in_the_ring_by_simulation(kinds, band):
    """A ring kept token by token in Python, over two episodes of one environment."""
    n, state = len(kinds), min(1, len(kinds) - 1)
    ring = [None] * (band + (n == 3)) * n  # (episode, step, kind) at each place
    for episode, length in enumerate((11, 9)):
        for t in range(length):
            places = cache_places(jnp.array([t]), n, state, band)
            positions, mask = np.asarray(places.positions)[0], np.asarray(places.mask)[0]
            new = [(t - 1, kind) for kind in kinds[state + 1 :]]
            new += [(t, kind) for kind in kinds[: state + 1]]
            for place, (step, kind) in zip(positions, new, strict=True):
                ring[place] = (episode, step, kind)
            for row, (step, kind) in enumerate(new):
                if step < 0:  # an action before the first state: nobody's
                    continue
                seen = {token for place, token in enumerate(ring) if mask[row, place]}
                expected = {
                    (episode, s, k)
                    for s in range(max(0, step - band + 1), step + 1)
                    for k in kinds
                    if s < step or kinds.index(k) <= kinds.index(kind)
                }
                assert seen == expected, (t, kind)


def acting_config(**fields) -> Config:
    settings = {
        "context_length": 4,
        "actor_layers": 2,
        "actor_width": 16,
        "actor_heads": 2,
        "normalize_obs": True,
        "acting_context": "episode",
        "target_return": 500.0,
        "return_scale": 100.0,
        "head_init_scale": 1.0,
    }
    return Config.from_preset("paper", **{**settings, **fields})


def make_agent(config: Config, episode_steps: int):
    """An agent, and a policy whose parameters and normalizer are far from their start."""
    spec = EnvSpec("test", OBS, ACT, (-2.0, -1.0), (1.0, 3.0), episode_steps, "jax", "a test")
    agent = agents.make(config, spec)
    learner = jax.jit(agent.init)(jax.random.key(0))
    normalizer = dataclasses.replace(
        learner.normalizer,
        count=jnp.int32(10),
        mean=jnp.array([0.1, -0.2, 0.3]),
        m2=jnp.array([20.0, 5.0, 10.0]),
    )
    params = randomized(learner.actor_params, scale=0.3)
    learner = dataclasses.replace(learner, actor_params=params, normalizer=normalizer)
    return agent, spec, policy_state(learner, hyperparameters(config, ACT))


def all_at_once(config, spec, policy, obs, actions, rewards, band):
    """Mean actions ``[L, A]`` of one episode by a single pass over all of it: no cache."""
    settings = config.actor
    actor = TransformerActor(
        TransformerConfig(settings.actor_layers, settings.actor_width, settings.actor_heads, 4, 0.0,
                          settings.actor_activation, rotary=settings.time_embedding == "rotary"),
        ACT, band, spec.max_episode_steps + 1 if settings.time_embedding == "absolute" else None,
        1.0, config.context.tokens,
        (settings.state_path_width,) * 2 if settings.state_path_width else None,
        given=settings.transformer_loss == "prediction",
    )  # fmt: skip
    steps = len(obs)
    so_far = np.concatenate([[0.0], np.cumsum(rewards[: steps - 1], dtype=np.float32)])
    count = int(policy.normalizer.count)
    std = np.sqrt(np.asarray(policy.normalizer.m2) / count)
    gaussian = jax.jit(gaussian_of(actor))(
        policy.actor_params,
        jnp.asarray(np.clip((obs - policy.normalizer.mean) / std, -10, 10))[None],
        jnp.asarray(actions)[None],
        commanded_return_to_go(so_far, policy.target_return, policy.return_scale)[None],
        jnp.arange(steps)[None],
        jnp.ones((1, steps), bool),
    )
    low, high = np.array(spec.action_low), np.array(spec.action_high)
    return (low + high) / 2 + (high - low) / 2 * np.tanh(np.asarray(gaussian.mean[0]))


@pytest.mark.parametrize(
    ("tokens", "limit", "fields"),
    [
        ("gs", 100, {}),
        pytest.param("gs", 1000, {}, marks=pytest.mark.slow),
        pytest.param("gsa", 1000, {}, marks=pytest.mark.slow),
        ("gsa", 100, {"time_embedding": "rotary", "state_path_width": 8}),
        ("joint", 100, {"time_embedding": "rotary"}),
        pytest.param("joint", 1000, {}, marks=pytest.mark.slow),
        pytest.param(
            "gsa",
            100,
            {
                "state_path_width": 8,
                "transformer_loss": "prediction",
                "prediction_weight": 1.0,
            },
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_thousand_steps_equal_full_recomputation(tokens, limit, fields):
    """Two environments whose episodes end at different steps; explored actions in the tokens."""
    config = acting_config(tokens=tokens, acting_context_limit=limit, **fields)
    agent, spec, policy = make_agent(config, 1000)
    steps, ends = 1_100, {(0, 999), (1, 37), (1, 600)}
    rng = np.random.default_rng(0)
    obs = rng.normal(size=(steps, ENVS, OBS)).astype(np.float32)
    reward = rng.normal(1.0, 2.0, (steps, ENVS)).astype(np.float32)
    noise = rng.uniform(-1, 1, (steps, ENVS, ACT)).astype(np.float32)
    done = np.array([[(env, t) in ends for env in range(ENVS)] for t in range(steps)])

    def step(context, inputs):
        acted = agent.act(policy, context, jax.random.key(0), explore=False)
        done_there = Acted(inputs["noise"], acted.context)
        context = contexts.advance(done_there, inputs["next_obs"], inputs["reward"], inputs["done"])
        return context, acted.action

    start = contexts.start(obs[0], 4, ACT, agent.init_cache(ENVS))
    inputs = {"noise": noise[:-1], "next_obs": obs[1:], "reward": reward[:-1], "done": done[:-1]}
    _, mean_actions = jax.jit(lambda start: jax.lax.scan(step, start, inputs))(start)
    for env in range(ENVS):
        bounds = [0, *(t + 1 for e, t in sorted(ends) if e == env), steps - 1]
        for first, last in itertools.pairwise(bounds):
            part = slice(first, last)
            expected = all_at_once(
                config, spec, policy, obs[part, env], noise[part, env], reward[part, env], limit
            )
            np.testing.assert_allclose(mean_actions[part, env], expected, atol=1e-5)
            # It is no matter of course: a context of K tells another story.
            short = all_at_once(
                config, spec, policy, obs[part, env], noise[part, env], reward[part, env], 4
            )
            assert np.abs(short - expected).max() > 0.01


def test_the_cache_holds_the_episode_and_no_more():
    agent, _, _ = make_agent(acting_config(), 30)
    shapes = {x.shape for x in jax.tree.leaves(agent.init_cache(5))}
    assert shapes == {(5, 2, 60, 8)}  # N, heads, two tokens a step, width of a head
    agent, _, _ = make_agent(acting_config(acting_context_limit=10, tokens="gsa"), 30)
    assert {x.shape for x in jax.tree.leaves(agent.init_cache(5))} == {(5, 2, 33, 8)}
    agent, _, _ = make_agent(acting_config(acting_context_limit=10, tokens="joint"), 30)
    assert {x.shape for x in jax.tree.leaves(agent.init_cache(5))} == {(5, 2, 10, 8)}
    agent, _, _ = make_agent(acting_config(acting_context="window"), 30)
    assert jax.tree.leaves(agent.init_cache(5)) == []


def test_a_policy_object_acts_on_its_whole_episode():
    config = acting_config(tokens="gsa")
    agent, spec, state = make_agent(config, 60)
    policy = Policy(config, spec, agent, state)
    rng = np.random.default_rng(1)
    for steps in (60, 25):  # the second episode must know nothing of the first
        obs = rng.normal(size=(steps, OBS)).astype(np.float32)
        rewards = rng.normal(size=steps).astype(np.float32)
        acting, actions = None, np.zeros((steps, ACT), np.float32)
        for t in range(steps):
            actions[t], acting = policy.predict(obs[t], acting, reward=rewards[t - 1])
        expected = all_at_once(config, spec, state, obs, actions, rewards, 60)
        np.testing.assert_allclose(actions, expected, atol=1e-5)
    assert policy._act._cache_size() == 1  # the same program, whatever the step


def test_a_policy_object_acts_in_many_environments_at_once():
    """Each as if alone, whenever their episodes start."""
    config = acting_config()
    agent, spec, state = make_agent(config, 60)
    policy = Policy(config, spec, agent, state)
    rng = np.random.default_rng(2)
    obs = rng.normal(size=(30, 3, OBS)).astype(np.float32)
    rewards = rng.normal(size=(30, 3)).astype(np.float32)
    starts = np.zeros((30, 3), bool)
    starts[12, 1] = starts[20, 1] = starts[7, 2] = True
    acting, together = None, np.zeros((30, 3, ACT), np.float32)
    for t in range(30):
        together[t], acting = policy.predict(obs[t], acting, starts[t], reward=rewards[t - 1])
    for env in range(3):
        for t in range(30):
            acting = None if t == 0 or starts[t, env] else acting
            alone, acting = policy.predict(obs[t, env], acting, reward=rewards[t - 1, env])
            assert alone.shape == (ACT,)
            np.testing.assert_allclose(together[t, env], alone, atol=1e-5)
    # A single environment's episodes may be told apart by the flag, too.
    _, acting = policy.predict(obs[0, 0])
    action, _ = policy.predict(obs[7, 2], acting, episode_start=True, reward=5.0)
    np.testing.assert_allclose(action, together[7, 2], atol=1e-5)


class HurriedEnv(PointEnv):
    """Terminates near the origin, so that episodes differ in length."""

    def step(self, state, action):
        state, step = super().step(state, action)
        return state, dataclasses.replace(step, terminated=jnp.abs(state[0]) < 0.3)


@pytest.fixture(scope="module")
def program():
    config = point_config(acting_context="episode", actor_layers=2, tokens="gsa")
    return make_program(config, VectorEnv(HurriedEnv(), 4))


def test_in_training_the_policy_acts_on_the_episode_from_before_it_took_over(program):
    """Prefill, then collecting with the same parameters: what the replay holds tells the rest."""
    state, _ = program.prefill(program.init(jax.random.key(3)))
    prefilled = int(state.buffer.size)
    policy = policy_of(state)
    taken_over, _, _ = jax.jit(
        lambda start: rollout.collect(
            program.env,
            program.buffer,
            lambda context, key: program.agent.act(policy, context, key, explore=False),
            start,
            jax.random.key(1),
            15,
        )
    )(rollout.RolloutState(state.env, state.context, state.buffer))
    steps = jax.tree.map(np.asarray, taken_over.buffer.steps)
    actor = TransformerActor(
        TransformerConfig(2, 16, 1, 4, 0.0, "relu"), 1, EPISODE, EPISODE + 1, 0.01, "gsa"
    )
    apply, scale = jax.jit(gaussian_of(actor)), float(policy.return_scale)
    checked = continued = 0
    for env in range(4):
        for now in range(prefilled, prefilled + 15):
            first = now - steps.time_step[env, now]
            part = np.minimum(np.arange(first, first + EPISODE), now)[None]  # its end repeated
            gaussian = apply(
                policy.actor_params,
                steps.obs[env, part],
                steps.action[env, part],
                (float(policy.target_return) - steps.return_so_far[env, part]) / scale,
                steps.time_step[env, part],
                np.ones((1, EPISODE), bool),
            )
            expected = np.tanh(gaussian.mean[0, now - first])
            np.testing.assert_allclose(steps.action[env, now], expected, atol=1e-5)
            checked += 1
            continued += first < prefilled
    assert checked == 60
    assert 10 < continued < 60


def test_it_trains_and_repeats(program):
    def trained():
        state, _ = program.prefill(program.init(jax.random.key(0)))
        state, metrics = program.train_chunk(state)
        assert np.isfinite(metrics["critic_loss"])
        evaluate = make_evaluator(point_env(3), program.agent, 2)
        return evaluate(policy_of(state), jax.random.key(0)).returns

    np.testing.assert_array_equal(trained(), trained())


def test_the_cache_keeps_bfloat16_products_in_bfloat16():
    config = acting_config(compute_dtype="bfloat16")
    agent, spec, state = make_agent(config, 30)
    assert all(x.dtype == jnp.bfloat16 for x in jax.tree.leaves(agent.init_cache(2)))
    obs = np.random.default_rng(0).normal(size=(30, OBS)).astype(np.float32)
    rewards, policy = np.ones(30, np.float32), Policy(config, spec, agent, state)
    acting, actions = None, np.zeros((30, ACT), np.float32)
    for t in range(30):
        actions[t], acting = policy.predict(obs[t], acting, reward=rewards[t])
    expected = all_at_once(config, spec, state, obs, actions, rewards, 30)  # in float32
    np.testing.assert_allclose(actions, expected, atol=0.05)
    assert np.abs(actions - expected).max() > 1e-4


@pytest.mark.parametrize("acting_context", ["window", "episode"])
def test_dropout_in_acting_is_drawn_from_the_key(acting_context):
    settings = {"acting_context": acting_context, "actor_dropout": 0.4}
    agent, _, policy = make_agent(acting_config(**settings, acting_dropout=True), 30)
    plain, _, _ = make_agent(acting_config(**settings), 30)
    obs = jnp.ones((2, OBS))

    def mean_action(agent, seed):
        start = contexts.start(obs, 4, ACT, agent.init_cache(2))
        act = jax.jit(agent.act, static_argnames="explore")
        return np.asarray(act(policy, start, jax.random.key(seed), explore=False).action)

    np.testing.assert_array_equal(mean_action(agent, 0), mean_action(agent, 0))
    assert (mean_action(agent, 0) != mean_action(agent, 1)).any()
    assert (mean_action(agent, 0)[0] != mean_action(agent, 0)[1]).any()  # each its own mask
    np.testing.assert_array_equal(mean_action(plain, 0), mean_action(plain, 1))


def test_a_policy_with_dropout_draws_anew_at_every_step_and_repeats_in_each_episode():
    config = acting_config(acting_context="window", acting_dropout=True, actor_dropout=0.4)
    agent, spec, state = make_agent(config, 30)
    policy = Policy(config, spec, agent, state)
    obs, nothing = jnp.ones((1, OBS)), jnp.zeros(1)
    # The two steps by hand, with a key of their own each.
    key, first_key = jax.random.split(jax.random.key(0))
    _, second_key = jax.random.split(key)
    act = jax.jit(agent.act, static_argnames="explore")
    first = act(state, contexts.start(obs, 4, ACT, {}), first_key, explore=False)
    context = contexts.advance(first, obs, nothing, nothing > 0)
    second, stale = (act(state, context, k, explore=False) for k in (second_key, first_key))
    assert np.abs(second.action - stale.action).max() > 1e-3
    for _ in range(2):
        acting = None
        for acted in (first, second):
            action, acting = policy.predict(obs[0], acting, reward=0.0)
            np.testing.assert_allclose(action, acted.action[0], atol=1e-5)
    other, _ = policy.predict(obs[0], policy.initial_state(seed=1))
    assert np.abs(other - first.action[0]).max() > 1e-3


def test_evaluation_draws_its_dropout_from_its_key_at_every_step():
    """In a task without any other chance: returns differ only by the masks."""
    env = VectorEnv(SameStartEnv(), 3)
    config = point_config(actor_dropout=0.4, acting_dropout=True, head_init_scale=1.0)
    agent = agents.make(config, env.spec)
    learner = jax.jit(agent.init)(jax.random.key(0))
    params = randomized(learner.actor_params, scale=0.3)
    policy = policy_state(
        dataclasses.replace(learner, actor_params=params), hyperparameters(config, 1)
    )
    evaluate = make_evaluator(env, agent, 2)
    returns = [np.asarray(evaluate(policy, jax.random.key(seed)).returns) for seed in (0, 0, 1)]
    np.testing.assert_array_equal(returns[0], returns[1])
    assert (returns[0] != returns[2]).all()
    assert len(set(returns[0].tolist())) == 3


class SameStartEnv(PointEnv):
    """Every episode begins at the same place."""

    def reset(self, key):
        return super().reset(jax.random.key(0))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"agent": "sac"}, "acting_context='episode': agent=sac sees one state"),
        ({"acting_context_limit": 3}, "acting_context_limit=3: is below context_length=4"),
        ({"acting_context_limit": 0}, "acting_context_limit=0: must be at least 1"),
        ({"acting_context": "whole"}, "acting_context='whole': must be one of window, episode"),
    ],
)
def test_what_makes_no_sense_is_refused(fields, message):
    sac = {"context_length": 1, "return_conditioning": "none"} if "agent" in fields else {}
    with pytest.raises(ConfigError, match=message):
        acting_config(**{**sac, **fields}).validated()

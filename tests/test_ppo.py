"""PPO: losses by hand, updates and rounds against oracles, and that it learns and resumes."""

from __future__ import annotations

import dataclasses
import json
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import scipy.stats
from probe import EPISODE, PointEnv, point_env
from test_advantages import returns_one_by_one
from trees import largest_difference, unequal

from sacformer_jax import (
    Config,
    ConfigError,
    Devices,
    agents,
    cli,
    launch,
    load_policy,
    make_evaluator,
    make_population,
    make_program,
    normalizer,
    policy_of,
    resume,
    seed_members,
    train,
)
from sacformer_jax import context as contexts
from sacformer_jax.agents import ppo_update
from sacformer_jax.agents.core import Agent
from sacformer_jax.agents.ppo_policy import PpoParts, entropy, log_prob
from sacformer_jax.agents.ppo_update import (
    CHECKED,
    Samples,
    clipped_surrogate,
    learning_rate_factor,
    normalized_advantage,
    value_loss,
)
from sacformer_jax.config import PpoConfig
from sacformer_jax.envs import VectorEnv
from sacformer_jax.networks import GaussianParams
from sacformer_jax.on_policy import RolloutLearning
from sacformer_jax.parallel import DATA_AXIS, UNDIVIDED, DataAxis
from sacformer_jax.population import member_state
from sacformer_jax.rollout import RolloutState, collect_rollout
from sacformer_jax.train import hyperparameters
from sacformer_jax.types import LearnerState, Rollout

NUM_ENVS, STEPS = 4, 32


def ppo_config(**fields: Any) -> Config:
    """A small PPO for the point task; the task named in it is not used."""
    settings = {
        "agent": "ppo", "num_envs": NUM_ENVS, "max_episode_steps": EPISODE,
        "total_env_steps": 10 * STEPS * NUM_ENVS, "chunk_env_steps": STEPS * NUM_ENVS,
        "rollout_steps": STEPS, "epochs": 3, "minibatches": 4, "actor_width": 16,
        "critic_width": 16, "actor_learning_rate": 1e-3, "critic_learning_rate": 1e-3,
    }  # fmt: skip
    return Config.from_preset("paper", **{**settings, **fields})


def parts_of(config: Config, data: DataAxis = UNDIVIDED) -> PpoParts:
    """What the agent's functions are bound to."""
    agent = agents.make(config, point_env(1).spec, data)
    assert isinstance(agent.update, partial)
    parts: PpoParts = agent.update.args[0]
    return parts


# --- losses by hand -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ratio", "advantage", "expected"),
    [
        (1.0, 3.0, -3.0),
        (1.1, 3.0, -3.3),
        (1.5, 3.0, -3.6),  # no more than 1.2 is rewarded
        (0.5, 3.0, -1.5),  # but what was lost is not forgiven
        (1.5, -3.0, 4.5),
        (0.5, -3.0, 2.4),
        (0.9, -3.0, 2.7),
    ],
)
def test_clipped_surrogate(ratio: float, advantage: float, expected: float) -> None:
    assert float(clipped_surrogate(jnp.float32(ratio), advantage, 0.2)) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("value", "target", "expected"),
    [
        (1.1, 2.0, 0.5 * 0.9**2),  # within the limit of 0.2 around 1
        (1.5, 2.0, 0.5 * 0.8**2),  # beyond: the error at 1.2 is larger
        (1.5, 1.0, 0.5 * 0.5**2),  # beyond, and the error here is larger
        (0.0, 0.0, 0.5 * 0.8**2),
    ],
)
def test_clipped_value_loss(value: float, target: float, expected: float) -> None:
    given = (jnp.float32(value), jnp.float32(1.0), jnp.float32(target))
    assert float(value_loss(*given, 0.2)) == pytest.approx(expected)
    assert float(value_loss(*given, None)) == pytest.approx(0.5 * (value - target) ** 2)


def test_no_gradient_where_the_loss_is_clipped() -> None:
    slope = jax.grad(lambda ratio: clipped_surrogate(ratio, 3.0, 0.2))
    assert [float(slope(jnp.float32(r))) for r in (0.5, 1.1, 1.5)] == [-3.0, -3.0, 0.0]
    slope = jax.grad(lambda value: value_loss(value, 1.0, 2.0, 0.2))
    np.testing.assert_allclose([slope(jnp.float32(v)) for v in (1.1, 1.5)], [-0.9, 0.0], rtol=1e-5)


def test_the_gaussian_is_scipys() -> None:
    rng = np.random.default_rng(0)
    mean, log_std, sample = (rng.normal(size=(5, 3)).astype(np.float32) for _ in range(3))
    gaussian, theirs = GaussianParams(mean, log_std), scipy.stats.norm(mean, np.exp(log_std))
    np.testing.assert_allclose(
        log_prob(gaussian, sample), theirs.logpdf(sample).sum(-1), rtol=1e-4, atol=1e-5
    )
    np.testing.assert_allclose(entropy(gaussian), theirs.entropy().sum(-1), rtol=1e-5)


def test_advantages_are_normalized_over_what_counts() -> None:
    advantage = np.random.default_rng(0).normal(3.0, 2.0, 10).astype(np.float32)
    weight = jnp.where(jnp.arange(10) < 8, 1 / 8, 0.0)
    ours = normalized_advantage(UNDIVIDED, advantage, weight)
    expected = (advantage[:8] - advantage[:8].mean()) / (advantage[:8].std() + 1e-8)
    np.testing.assert_allclose(ours[:8], expected, rtol=1e-4)


def test_the_learning_rate_falls_as_in_cleanrl() -> None:
    parts = parts_of(ppo_config())  # 10 rounds of 12 updates
    num_rounds, per_round = 10, 12
    for update in range(130):
        iteration = update // per_round + 1  # theirs counts from 1
        expected = max(1.0 - (iteration - 1.0) / num_rounds, 0.0)
        assert float(learning_rate_factor(parts, jnp.int32(update))) == pytest.approx(expected)
    constant = parts_of(ppo_config(anneal_learning_rate=False))
    assert float(learning_rate_factor(constant, jnp.int32(1000))) == 1.0
    # A run ends with a whole chunk: 11 chunks of 2 rounds here.
    longer = ppo_config(chunk_env_steps=256, total_env_steps=10 * 256 + 1)
    assert parts_of(longer).num_rounds == 22


# --- networks and acting --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def config() -> Config:
    return ppo_config()


@pytest.fixture(scope="module")
def learner(config: Config) -> LearnerState:
    agent = agents.make(config, point_env(1).spec)
    made: LearnerState = jax.jit(agent.init)(jax.random.key(0))
    return made


def test_initialization(learner: LearnerState) -> None:
    actor, critic = learner.actor_params["params"], learner.critic_params["params"]
    assert actor["log_std"].tolist() == [0.0]
    for network, head, gain in ((actor, "mean", 0.01), (critic, "value", 1.0)):
        kernels = [(network["mlp"][f"dense_{i}"], np.sqrt(2.0)) for i in (0, 1)]
        for layer, scale in [*kernels, (network[head], gain)]:
            kernel = np.asarray(layer["kernel"])
            if kernel.shape[0] < kernel.shape[1]:
                kernel = kernel.T
            np.testing.assert_allclose(
                kernel.T @ kernel, scale**2 * np.eye(kernel.shape[1]), atol=1e-5
            )
            assert not np.any(layer["bias"])
    assert jax.tree.structure(actor["mlp"]) == jax.tree.structure(critic["mlp"])
    assert not np.allclose(actor["mlp"]["dense_0"]["kernel"], critic["mlp"]["dense_0"]["kernel"])


def _context(obs: jax.Array) -> Any:
    return contexts.start(obs, 1, 1, {})


def test_acting_clips_what_it_drew(config: Config, learner: LearnerState) -> None:
    agent, parts = agents.make(config, point_env(1).spec), parts_of(config)
    policy = policy_of(make_program(config, point_env(4)).init(jax.random.key(0)))
    policy = policy.replace(actor_params=learner.actor_params)
    obs, key = jax.random.normal(jax.random.key(1), (500, 2)), jax.random.key(2)
    acted = agent.act(policy, _context(obs), key, explore=True)
    assert np.abs(acted.sample).max() > 2.0
    np.testing.assert_array_equal(acted.action, np.clip(acted.sample, -1, 1))
    noise = (acted.sample - parts.policy(learner.actor_params, obs).mean)[:, 0]
    assert scipy.stats.kstest(np.asarray(noise), "norm").pvalue > 0.01
    # Without exploring the mean, within the bounds.
    params = jax.tree.map(lambda x: 500 * x, learner.actor_params)
    acted = agent.act(policy.replace(actor_params=params), _context(obs), key, explore=False)
    mean = parts.policy(params, obs).mean
    assert np.abs(mean).max() > 2.0
    np.testing.assert_array_equal(acted.action, np.clip(mean, -1, 1))
    assert acted.sample is None


# --- once a round ---------------------------------------------------------------------------------


def random_rollout(seed: int = 0, num_envs: int = NUM_ENVS) -> Rollout:
    rng = np.random.default_rng(seed)
    ended, how = rng.random((STEPS, num_envs)) < 0.2, rng.integers(0, 3, (STEPS, num_envs))

    def normal(*shape: int) -> jax.Array:
        return jnp.asarray(rng.normal(size=(STEPS, num_envs, *shape)), jnp.float32)

    return Rollout(
        obs=normal(2),
        sample=normal(1),
        reward=5 * normal(),
        terminated=jnp.asarray(ended & (how == 0)),
        truncated=jnp.asarray(ended & (how > 0)),
        bad=jnp.asarray(ended & (how == 2)),
        next_obs=normal(2),
    )


def _forward(params: Any, obs: np.ndarray, head: str) -> np.ndarray:
    """The MLP in NumPy."""
    x = obs
    for i in (0, 1):
        layer = params["params"]["mlp"][f"dense_{i}"]
        x = np.tanh(x @ np.asarray(layer["kernel"]) + np.asarray(layer["bias"]))
    layer = params["params"][head]
    return x @ np.asarray(layer["kernel"]) + np.asarray(layer["bias"])


def test_a_rollout_is_prepared_as_numpy_would(config: Config, learner: LearnerState) -> None:
    rollout = random_rollout()
    statistics = learner.normalizer.replace(
        count=jnp.int32(10), mean=jnp.array([0.5, -1.0]), m2=jnp.array([40.0, 2.5])
    )
    learner = learner.replace(normalizer=statistics)
    hyper = hyperparameters(config, 1)
    prepare = jax.jit(partial(ppo_update.prepare, parts_of(config)))
    running = jnp.array([3.0, 0.0, -2.0, 1.0])
    prepared = prepare(learner, hyper, rollout, running)
    r = jax.tree.map(np.asarray, rollout)
    done = r.terminated | r.truncated

    first = r.reward.copy()
    first[0] += 0.99 * np.asarray(running)
    returns = returns_one_by_one(first, done, 0.99)
    np.testing.assert_allclose(
        prepared.discounted_return, np.where(done[-1], 0.0, returns[-1]), rtol=1e-4, atol=1e-5
    )
    reward = np.clip(r.reward / np.sqrt(returns.var() + 1e-8), -10, 10)
    obs, next_obs = (np.clip((x - [0.5, -1.0]) / [2.0, 0.5], -10, 10) for x in (r.obs, r.next_obs))
    value, next_value = (
        _forward(learner.critic_params, x, "value")[..., 0] for x in (obs, next_obs)
    )
    advantage = np.zeros_like(value)
    for t in reversed(range(STEPS)):
        for n in range(NUM_ENVS):
            if r.bad[t, n]:
                continue
            bootstrap = 0.0 if r.terminated[t, n] else next_value[t, n]
            advantage[t, n] = reward[t, n] + 0.99 * bootstrap - value[t, n]
            if not done[t, n] and t + 1 < STEPS:
                advantage[t, n] += 0.99 * 0.95 * advantage[t + 1, n]
    mean = _forward(learner.actor_params, obs, "mean")
    expected = {
        "obs": obs.reshape(-1, 2),
        "sample": r.sample.reshape(-1, 1),
        "log_prob": scipy.stats.norm(mean, 1.0).logpdf(r.sample)[..., 0].reshape(-1),
        "advantage": advantage.reshape(-1),
        "value": value.reshape(-1),
        "value_target": (advantage + value).reshape(-1),
        "mask": ~r.bad.reshape(-1),
    }
    for name, values in expected.items():
        ours = getattr(prepared.samples, name)
        np.testing.assert_allclose(ours, values, rtol=1e-4, atol=1e-4, err_msg=name)
    counts = ~r.bad
    target = (advantage + value)[counts]
    explained = 1 - (target - value[counts]).var() / target.var()
    assert float(prepared.metrics["explained_variance"]) == pytest.approx(explained, abs=1e-4)


def test_what_bad_physics_gives_is_learnt_from_by_nobody(
    config: Config, learner: LearnerState
) -> None:
    rollout, hyper = random_rollout(), hyperparameters(config, 1)
    bad = rollout.bad
    changed = rollout.replace(
        sample=jnp.where(bad[..., None], 7.0, rollout.sample),
        next_obs=jnp.where(bad[..., None], -3.0, rollout.next_obs),
    )
    prepare = jax.jit(partial(ppo_update.prepare, parts_of(config)))
    update = jax.jit(partial(ppo_update.update, parts_of(config)))
    samples, others = (
        prepare(learner, hyper, steps, jnp.zeros(NUM_ENVS)).samples for steps in (rollout, changed)
    )
    assert set(unequal(samples, others)) == {".sample", ".log_prob"}
    garbage = {
        name: jnp.where(samples.mask, getattr(samples, name), 99.0)
        for name in ("advantage", "value", "value_target")
    }
    news = [update(learner, hyper, each, jax.random.key(0)) for each in (samples, others)]
    news.append(update(learner, hyper, others.replace(**garbage), jax.random.key(0)))
    assert unequal(news[0], news[1]) == unequal(news[0], news[2]) == {}


def test_a_rollout_holds_the_last_state_of_each_episode(config: Config) -> None:
    """The state after a step is where the physics led, also where an episode was cut off."""
    env, agent = point_env(NUM_ENVS), agents.make(config, point_env(1).spec)
    state = make_program(config, env).init(jax.random.key(0))
    collect = jax.jit(
        lambda state: collect_rollout(
            env,
            lambda context, key: agent.act(policy_of(state), context, key, explore=True),
            RolloutState(state.env, state.context, None),
            jax.random.key(5),
            STEPS,
        )
    )
    _, stats, rollout = collect(state)
    x, v = np.moveaxis(np.asarray(rollout.obs), -1, 0)
    action = np.clip(rollout.sample[..., 0], -1, 1)
    led_to = np.stack([x + 0.4 * v, 0.8 * v + 0.5 * action], axis=-1)
    np.testing.assert_allclose(rollout.next_obs, led_to, atol=1e-6)
    assert rollout.truncated[EPISODE - 1].all()
    assert int(rollout.truncated.sum()) == int(stats.episodes) == NUM_ENVS
    went_on = ~rollout.done[:-1]
    np.testing.assert_array_equal(rollout.obs[1:][went_on], rollout.next_obs[:-1][went_on])
    np.testing.assert_array_equal(rollout.obs[EPISODE, :, 1], 0.0)  # a fresh start
    assert (np.abs(rollout.next_obs[EPISODE - 1, :, 1]) > 0).all()


# --- one update -----------------------------------------------------------------------------------


def random_samples(seed: int = 0, num: int = 64) -> Samples:
    """Some of them far from the policy and values at hand, so that everything is clipped."""
    rng = np.random.default_rng(seed)

    def normal(*shape: int) -> jax.Array:
        return jnp.asarray(rng.normal(size=(num, *shape)), jnp.float32)

    return Samples(
        obs=normal(2),
        sample=normal(1),
        log_prob=-1.4 + 0.3 * normal(),
        advantage=1.0 + 2.0 * normal(),
        value=0.3 * normal(),
        value_target=normal(),
        mask=jnp.asarray(rng.permutation(num) < 50),
    )


def reference_loss(params: Any, batch: Samples, settings: PpoConfig, parts: PpoParts) -> Any:
    """CleanRL's total loss, and its metrics."""
    gaussian = parts.policy(params[0], batch.obs)
    mean, std = gaussian.mean[:, 0], jnp.exp(gaussian.log_std[:, 0])
    new_log_prob = -0.5 * ((batch.sample[:, 0] - mean) / std) ** 2 - jnp.log(std)
    ratio = jnp.exp(new_log_prob - 0.5 * jnp.log(2 * jnp.pi) - batch.log_prob)
    advantage = batch.advantage
    if settings.normalize_advantages:
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    clipped = jnp.clip(ratio, 1 - settings.clip_range, 1 + settings.clip_range)
    policy_loss = jnp.maximum(-advantage * ratio, -advantage * clipped).mean()
    value = parts.value(params[1], batch.obs)
    error = (value - batch.value_target) ** 2
    if settings.clip_value_loss:
        moved = jnp.clip(value - batch.value, -settings.clip_range, settings.clip_range)
        error = jnp.maximum(error, (batch.value + moved - batch.value_target) ** 2)
    critic_loss = 0.5 * error.mean()
    spread = (jnp.log(std) + 0.5 * jnp.log(2 * jnp.pi * jnp.e)).mean()
    loss = policy_loss - settings.entropy_coefficient * spread
    loss += settings.value_coefficient * critic_loss
    outside = jnp.abs(ratio - 1) > settings.clip_range
    return loss, {
        "actor_loss": policy_loss,
        "critic_loss": critic_loss,
        "entropy": spread,
        "clip_fraction": outside.mean(),
        "approx_kl": (ratio - 1 - jnp.log(ratio)).mean(),
    }


@pytest.mark.parametrize(
    "fields",
    [
        {"entropy_coefficient": 0.02},
        {"clip_value_loss": False, "normalize_advantages": False, "max_grad_norm": 1e3},
        {"clip_range": 0.05, "value_coefficient": 2.0, "max_grad_norm": 0.01},
    ],
    ids=str,
)
def test_updates_are_those_of_one_adam_on_the_total_loss(
    learner: LearnerState, fields: dict[str, Any]
) -> None:
    config = ppo_config(**fields)
    parts, hyper, rate = parts_of(config), hyperparameters(config, 1), 1e-3
    update = jax.jit(partial(ppo_update.update, parts))
    optimizer = optax.chain(
        optax.clip_by_global_norm(config.ppo.max_grad_norm), optax.scale_by_adam(eps=1e-5)
    )
    params: Any = (learner.actor_params, learner.critic_params)
    opt_state = optimizer.init(params)
    differentiated = jax.grad(
        partial(reference_loss, settings=config.ppo, parts=parts), has_aux=True
    )
    reference = jax.jit(differentiated)
    for number in range(14):  # into the second round
        samples = random_samples(number)
        real = np.flatnonzero(samples.mask)
        learner, metrics = update(learner, hyper, samples, jax.random.key(0))
        grads, expected = reference(params, jax.tree.map(lambda x, rows=real: x[rows], samples))
        changes, opt_state = optimizer.update(grads, opt_state)
        step = rate * (1.0 if number < 12 else 0.9)
        params = jax.tree.map(lambda p, c, step=step: p - step * c, params, changes)
        expected["actor_grad_norm"], expected["critic_grad_norm"] = map(optax.global_norm, grads)
        expected["learning_rate"] = step
        for name, value in expected.items():
            np.testing.assert_allclose(
                metrics[name], value, rtol=1e-3, atol=1e-5, err_msg=f"{name} of {number}"
            )
        ours = (learner.actor_params, learner.critic_params)
        assert largest_difference(ours, params) < 2e-5, number
    assert int(learner.num_updates) == 14
    assert 0.1 < float(metrics["clip_fraction"]) < 1.0


# --- updates that are not finite ------------------------------------------------------------------


@pytest.fixture(scope="module")
def update(config: Config) -> Any:
    return jax.jit(partial(ppo_update.update, parts_of(config)))


@pytest.mark.parametrize("what", CHECKED[:7])
def test_a_tensor_that_is_not_finite_leaves_the_networks_as_they_were(
    config: Config, learner: LearnerState, update: Any, what: str
) -> None:
    samples = random_samples().replace(mask=jnp.ones(64, bool))
    start = learner
    if what in ("obs", "advantage", "value_target"):
        values = getattr(samples, what)
        samples = samples.replace(**{what: values.at[3].set(jnp.nan)})
    elif what == "policy":
        samples = samples.replace(log_prob=samples.log_prob.at[3].set(jnp.inf))
    elif what == "value":
        broken = jax.tree.map(lambda x: x.at[(0,) * x.ndim].set(jnp.nan), learner.critic_params)
        start = learner.replace(critic_params=broken)
    elif what == "actor_loss":  # the ratio overflows
        samples = samples.replace(log_prob=samples.log_prob - 200.0, advantage=-jnp.arange(64.0))
    else:
        samples = samples.replace(value_target=jnp.full(64, 1e25))
    new, metrics = update(start, hyperparameters(config, 1), samples, jax.random.key(0))
    assert CHECKED[int(metrics["fault"])] == what
    assert set(unequal(new, start)) == {".num_updates"}


# --- a round --------------------------------------------------------------------------------------


def round_of(config: Config, agent: Agent, env: VectorEnv | None = None) -> Any:
    """``state -> (metrics of the round's updates [E P], what was acted on)``, not advancing it."""
    env = env or point_env(config.task.num_envs)
    learning = RolloutLearning(agent, config.ppo.epochs, config.ppo.minibatches, env.data)

    @jax.jit
    def learn(state: Any) -> Any:
        policy = policy_of(state)
        _, _, rollout = collect_rollout(
            env,
            lambda context, key: agent.act(policy, context, key, explore=True),
            RolloutState(state.env, state.context, None),
            jax.random.key(5),
            config.ppo.rollout_steps,
        )
        seen = normalizer.update(policy.normalizer, rollout.obs)
        after = state.replace(learner=state.learner.replace(normalizer=seen))
        after, metrics = learning.learn(after, policy.normalizer, rollout, jax.random.key(6))
        return after, metrics, rollout, seen

    return learn


def test_the_ratio_is_1_at_first_and_that_of_the_policy_that_acted(config: Config) -> None:
    program, parts = make_program(config, point_env(NUM_ENVS)), parts_of(config)
    agent = program.agent

    def update(learner: Any, hyper: Any, samples: Samples, key: jax.Array) -> Any:
        """Which also tells the ratios, and the samples' log-probabilities."""
        gaussian = parts.policy(learner.actor_params, samples.obs)
        ratio = jnp.exp(log_prob(gaussian, samples.sample) - samples.log_prob)
        learner, metrics = agent.update(learner, hyper, samples, key)
        return learner, {**metrics, "ratio": ratio, "obs": samples.obs}

    learn = round_of(config, dataclasses.replace(agent, update=update))
    state = program.init(jax.random.key(0))
    for number in range(3):
        policy = policy_of(state)
        after, metrics, rollout, seen = learn(state)
        np.testing.assert_allclose(metrics["ratio"][0], 1.0, atol=1e-6)
        assert np.abs(metrics["ratio"][-1] - 1.0).max() > 1e-3
        assert float(metrics["approx_kl"][0]) < 1e-6
        assert float(metrics["clip_fraction"][0]) == 0.0
        # The statistics of acting, but in the first round, where there are none.
        statistics = seen if number == 0 else policy.normalizer
        learnt_from = np.asarray(metrics["obs"][:4]).reshape(-1, 2)
        given = parts.normalized(statistics, rollout.obs).reshape(-1, 2)
        np.testing.assert_allclose(
            learnt_from[np.lexsort(learnt_from.T)], given[np.lexsort(given.T)], atol=1e-6
        )
        assert unequal(after.learner.normalizer, seen) == {}
        state, _ = program.train_chunk(state)
    # What that costs: how far the first round's policy is from the one that acted, in deviations.
    state = program.init(jax.random.key(0))
    _, _, rollout, seen = learn(state)
    means = [
        parts.policy(state.learner.actor_params, obs).mean
        for obs in (rollout.obs, parts.normalized(seen, rollout.obs))
    ]
    assert np.abs(means[0] - means[1]).max() < 0.03


def test_every_epoch_has_every_step_once() -> None:
    config = ppo_config()
    agent = make_program(config, point_env(NUM_ENVS)).agent

    def prepare(learner: Any, hyper: Any, rollout: Rollout, running: jax.Array) -> Any:
        prepared = agent.prepare(learner, hyper, rollout, running)
        return prepared.replace(samples={"id": jnp.arange(STEPS * NUM_ENVS)})

    def update(learner: Any, hyper: Any, samples: Any, key: jax.Array) -> Any:
        return learner, {"id": samples["id"], "fault": jnp.int32(-1)}

    learn = round_of(config, dataclasses.replace(agent, prepare=prepare, update=update))
    ids = np.asarray(learn(make_program(config, point_env(4)).init(jax.random.key(0)))[1]["id"])
    assert ids.shape == (3 * 4, STEPS * NUM_ENVS // 4)
    epochs = ids.reshape(3, -1)
    for epoch in epochs:
        np.testing.assert_array_equal(np.sort(epoch), np.arange(STEPS * NUM_ENVS))
    assert len({tuple(epoch) for epoch in epochs}) == 3
    assert not np.array_equal(epochs[0], np.arange(STEPS * NUM_ENVS))


# --- the training program -------------------------------------------------------------------------

LEARNT = -8.0
"""Doing nothing gives about -25 on the point task, random actions less, the best about -4."""


def test_learns_and_a_broken_update_does_not() -> None:
    config = ppo_config(
        num_envs=8, rollout_steps=64, minibatches=8, epochs=10, chunk_env_steps=2048,
        total_env_steps=8192,
    )  # fmt: skip
    program = make_program(config, point_env(8))
    evaluate = make_evaluator(point_env(32), program.agent, 1)
    returns = {}
    for name, broken in {
        "working": {},
        "actor frozen": {"actor_learning_rate": 1e-12},
        "future ignored": {"discount": 0.0},
    }.items():
        state = program.init(jax.random.key(1))
        changes = {field: jnp.float32(value) for field, value in broken.items()}
        state = dataclasses.replace(state, hyper=dataclasses.replace(state.hyper, **changes))
        for _ in range(4):
            state, metrics = program.train_chunk(state)
            assert all(np.isfinite(value) for value in metrics.values())
        returns[name] = float(evaluate(policy_of(state), jax.random.key(123)).returns.mean())
    assert returns.pop("working") > LEARNT, returns
    assert max(returns.values()) < LEARNT - 5, returns


class CountingEnv(PointEnv):
    """Counts how often its step is traced."""

    traces = 0

    def step(self, state: Any, action: jax.Array) -> Any:
        CountingEnv.traces += 1
        return super().step(state, action)


METRICS = {
    "episodes", "episode_return_mean", "episode_return_max", "episode_length_mean", "bad_physics",
    "skipped_updates", "critic_loss", "actor_loss", "entropy", "approx_kl", "clip_fraction",
    "explained_variance", "learning_rate", "actor_grad_norm", "critic_grad_norm",
}  # fmt: skip


def test_counts_and_compiles_once(config: Config) -> None:
    program = make_program(config, VectorEnv(CountingEnv(), NUM_ENVS))
    state = program.init(jax.random.key(0))
    state, metrics = program.prefill(state)  # of which there is none
    assert metrics == {}
    assert unequal(state, program.init(jax.random.key(0))) == {}
    assert state.buffer is None
    state, metrics = program.train_chunk(state)
    assert set(metrics) == METRICS
    traces = CountingEnv.traces
    for chunk in range(2, 4):
        state, metrics = program.train_chunk(state)
        counters = jax.tree.map(int, state.counters)
        assert counters.env_steps == STEPS * NUM_ENVS * chunk
        assert counters.updates == int(state.learner.num_updates) == 12 * chunk
        assert counters.episodes == NUM_ENVS * (STEPS * chunk // EPISODE)
        assert counters.skipped_updates == 0
        assert int(state.learner.normalizer.count) == STEPS * NUM_ENVS * chunk
        assert int(state.learner.reward_scale.count) == STEPS * NUM_ENVS * chunk
        assert float(metrics["learning_rate"]) == pytest.approx(1e-3 * (1.1 - 0.1 * chunk))
    assert CountingEnv.traces == traces
    assert program.train_chunk._cache_size() == 1
    with pytest.raises(ValueError, match="agent=ppo keeps no replay"):
        _ = program.buffer


@pytest.mark.slow
def test_each_switch_arrives() -> None:
    """With everything off: no statistics, no annealing."""
    config = ppo_config(
        normalize_obs=False, normalize_reward=False, anneal_learning_rate=False,
        compute_dtype="bfloat16", critic_layer_norm=True,
    )  # fmt: skip
    program = make_program(config, point_env(NUM_ENVS))
    state = program.init(jax.random.key(0))
    assert "bf16" in program.train_chunk.lower(state).as_text()
    for _ in range(2):
        state, metrics = program.train_chunk(state)
    assert all(np.isfinite(value) for value in metrics.values())
    assert float(metrics["learning_rate"]) == pytest.approx(1e-3)
    assert int(state.learner.normalizer.count) == int(state.learner.reward_scale.count) == 0
    assert not np.any(state.discounted_return)


# --- members and devices --------------------------------------------------------------------------


@pytest.mark.slow
def test_members_are_what_they_are_alone(config: Config) -> None:
    program = make_program(config, point_env(NUM_ENVS))
    for seeds in ((3, 4), (4,)):
        population = make_population(config, seed_members(seeds), env=PointEnv())
        assert population.num_drawable is None
        state, _ = population.prefill(population.init())
        for _ in range(2):
            state, _ = population.train_chunk(state)
        result = population.evaluate(policy_of(state), np.int32(0))
        assert np.isfinite(result.returns).all()
        for index, seed in enumerate(seeds):
            expected = program.init(jax.random.key(seed))
            for _ in range(2):
                expected, _ = program.train_chunk(expected)
            ours = member_state(population, state, index)
            if len(seeds) == 1:
                assert unequal(ours, expected) == {}
            assert unequal(ours.counters, expected.counters) == {}
            assert largest_difference(ours.learner, expected.learner) < 1e-4
            assert largest_difference(ours.discounted_return, expected.discounted_return) < 1e-4


def test_two_shards_update_as_one_does_on_the_same_minibatch(
    config: Config, learner: LearnerState
) -> None:
    hyper, samples, key = hyperparameters(config, 1), random_samples(), jax.random.key(0)
    expected, metrics = ppo_update.update(parts_of(config), learner, hyper, samples, key)
    halves = jax.tree.map(lambda x: x.reshape(2, -1, *x.shape[1:]), samples)
    split = jax.vmap(
        partial(ppo_update.update, parts_of(config, DataAxis(2))),
        in_axes=(None, None, 0, None),
        axis_name=DATA_AXIS,
    )
    ours, our_metrics = jax.jit(split)(learner, hyper, halves, key)
    assert largest_difference(expected, learner) > 1e-4
    for shard in (0, 1):
        one: Any = jax.tree.map(lambda x, i=shard: x[i], (ours, our_metrics))
        assert largest_difference(one[0], expected) < 1e-6
        for name, value in metrics.items():
            np.testing.assert_allclose(one[1][name], value, rtol=1e-4, atol=1e-6, err_msg=name)


@pytest.mark.slow
def test_two_shards_train_as_one_does_where_the_order_does_not_matter() -> None:
    """Whole rounds, with all steps in each minibatch: acting, statistics, advantages, updates."""
    config = ppo_config(epochs=2, minibatches=1)
    whole = make_program(config, point_env(NUM_ENVS))
    data = DataAxis(2)
    half = make_program(config, VectorEnv(PointEnv(), NUM_ENVS, data=data), data)
    over_shards = partial(jax.vmap, axis_name=DATA_AXIS, axis_size=2)
    expected = whole.init(jax.random.key(0))
    state = over_shards(half.init, in_axes=None)(jax.random.key(0))
    chunk = jax.jit(over_shards(half.train_chunk))
    for _ in range(2):
        expected, metrics = whole.train_chunk(expected)
        state, our_metrics = chunk(state)
    for shard in (0, 1):
        ours: Any = jax.tree.map(lambda x, i=shard: x[i], state.learner)
        for part in ("actor_params", "critic_params", "actor_opt", "critic_opt"):
            other = getattr(expected.learner, part)
            assert largest_difference(getattr(ours, part), other) < 1e-4, part
        for part in ("normalizer", "reward_scale"):
            for name, value in vars(getattr(expected.learner, part)).items():
                np.testing.assert_allclose(getattr(getattr(ours, part), name), value, rtol=1e-4)
    both = state.discounted_return.reshape(-1)
    np.testing.assert_allclose(both, expected.discounted_return, rtol=1e-4, atol=1e-4)
    for name, value in metrics.items():
        np.testing.assert_allclose(our_metrics[name][1], value, rtol=1e-3, atol=1e-4, err_msg=name)


def test_shards_shuffle_by_themselves() -> None:
    learning = RolloutLearning(make_program(ppo_config()).agent, 3, 4, DataAxis(2))
    rows = jax.vmap(lambda _: learning.shuffled(jax.random.key(0), 64), axis_name=DATA_AXIS)(
        jnp.arange(2)
    )
    assert rows.shape == (2, 12, 16)
    assert not np.array_equal(rows[0], rows[1])


# --- settings -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"minibatches": 5}, r"minibatches=5: must divide rollout_steps=32 times num_envs=4"),
        ({"minibatches": 128}, r"minibatches=128: .* two steps or more"),
        ({"prefill_env_steps": 100}, r"prefill_env_steps=100: .* use prefill_env_steps=0"),
        ({"policy": "deterministic"}, r"policy='deterministic': agent=ppo needs probabilities"),
        ({"critic_init": "xavier"}, r"critic_init='xavier': .* orthogonally"),
        ({"tune_alpha": True}, r"tune_alpha=True: agent=ppo has no temperature"),
        ({"clip_range": 0.0}, r"clip_range=0.0: must be greater than 0"),
        ({"gae_lambda": 1.1}, r"gae_lambda=1.1: must be at most 1"),
        ({"context_length": 2}, r"context_length=2: agent=ppo sees one state"),
    ],
    ids=str,
)
def test_settings_that_cannot_work_are_refused(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        ppo_config(**fields)


def test_a_minibatch_that_devices_cannot_share_is_refused() -> None:
    config = ppo_config(minibatches=64)  # of 2 steps each
    with pytest.raises(ConfigError, match=r"data_devices=4: .* num_envs \* rollout_steps"):
        make_population(config, seed_members([0]), Devices(data=4), PointEnv())


@pytest.mark.parametrize("preset", ["cpu", "paper", "authors"])
def test_presets_are_cleanrls_numbers(preset: str) -> None:
    config = Config.from_preset(preset, agent="ppo", env="Hopper")
    steps, updates = config.steps_and_updates
    assert steps * config.task.num_envs == config.env_steps_per_chunk == 2048
    assert updates == 320
    assert config.ppo == PpoConfig(rollout_steps=steps)
    assert (config.actor.actor_width, config.critic.critic_width) == (64, 64)
    assert config.actor.actor_activation == config.critic.critic_activation == "tanh"
    assert config.actor.actor_layers == config.critic.critic_layers == 2
    assert config.actor.head_init_scale == 0.01
    assert config.learning.actor_learning_rate == config.learning.critic_learning_rate == 3e-4
    assert config.context.normalize_obs


# --- runs -----------------------------------------------------------------------------------------

TINY = {
    "env": "Hopper", "agent": "ppo", "num_envs": 2, "max_episode_steps": 50, "rollout_steps": 32,
    "minibatches": 4, "epochs": 2, "chunk_env_steps": 64, "total_env_steps": 256,
    "eval_every": 128, "eval_episodes": 2, "checkpoint_every": 128, "actor_width": 8,
    "critic_width": 8,
}  # fmt: skip


def _described(path: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    capsys.readouterr()
    assert cli.main(["describe", str(path), "--json"]) == 0
    facts: dict[str, Any] = json.loads(capsys.readouterr().out)
    return facts


def test_a_run_from_the_command_line_resumes_to_the_bit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # It would decide over the threads of every process that later tests start.
    monkeypatch.setattr(launch, "choose_xla_threads", lambda config: None)
    path = tmp_path / "straight"
    settings = {**TINY, "seeds": 2, "run_dir": path}
    flags = [f"--{name.replace('_', '-')}={value}" for name, value in settings.items()]
    assert cli.main(["train", *flags]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "memory no replay" in printed
    assert "prefill" not in printed
    straight = _described(path, capsys)
    assert straight["counters"]["updates"] == [32, 32]
    assert straight["counters"]["env_steps"] == 256

    killed = tmp_path / "killed"  # after the checkpoint at 128
    shutil.copytree(path, killed)
    shutil.rmtree(killed / "checkpoints" / "256")
    resume(killed, quiet=True)
    assert _described(killed, capsys)["digest"] == straight["digest"]
    for seed in ("seed-0", "seed-1"):
        ours, theirs = (run / seed / "metrics.jsonl" for run in (killed, path))
        assert ours.read_bytes() == theirs.read_bytes()


def test_nothing_of_lapack_is_called() -> None:
    """Its QR waits for XLA's other threads, and several at once for ever (see ``orthogonal``)."""
    population = make_population(Config.from_preset("cpu", **TINY), seed_members(range(2)))
    assert "lapack" not in jax.jit(population.init).lower().as_text()


@pytest.mark.slow
def test_an_exported_policy_is_the_mean_within_the_bounds(tmp_path: Path) -> None:
    path = train(Config.from_preset("cpu", **TINY, run_dir=str(tmp_path / "run")), quiet=True).path
    policy = load_policy(path, "latest")
    obs = np.random.default_rng(0).normal(size=(5, 11)).astype(np.float32)
    action, acting = policy.predict(obs)
    statistics = policy.state.normalizer
    assert int(statistics.count) == 256
    std = np.sqrt(np.maximum(statistics.m2 / statistics.count, 1e-8))
    seen = np.clip((obs - statistics.mean) / std, -10, 10)
    mean = _forward(policy.state.actor_params, seen, "mean")
    np.testing.assert_allclose(action, np.clip(mean, -1, 1), rtol=1e-4, atol=1e-5)
    again, _ = policy.predict(obs, acting)  # no reward is asked for, and nothing remembered
    np.testing.assert_array_equal(again, action)
    records = [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]
    assert {*METRICS, "kind", "env_steps", "updates"} == set(
        next(record for record in records if record["kind"] == "train")
    )

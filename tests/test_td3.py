"""TD3 against NumPy, update by update; that it learns, resumes, and is the same among others."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from probe import PointEnv, point_config, point_env
from run_states import state_digest
from test_runs import TINY
from test_sac_update import make_window as make_sac_window
from test_train import LEARNT
from trees import largest_difference, unequal

from sacformer_jax import (
    Config,
    Member,
    agents,
    make_population,
    make_program,
    policy_of,
    resume,
    seed_members,
    train,
)
from sacformer_jax.agents.core import Agent
from sacformer_jax.agents.faults import NO_FAULT
from sacformer_jax.context import start
from sacformer_jax.critics import MLPCritic, twin
from sacformer_jax.envs.core import EnvSpec
from sacformer_jax.networks import DeterministicActor
from sacformer_jax.parallel import DATA_AXIS, DataAxis
from sacformer_jax.population import member_state
from sacformer_jax.train import hyperparameters, policy_state
from sacformer_jax.types import Hyperparameters, LearnerState, Params, PolicyState, Window

# Two actions, the second within bounds that are not symmetric.
SPEC = EnvSpec(
    name="box", obs_size=3, action_size=2, action_low=(-1.0, 0.0), action_high=(1.0, 6.0),
    max_episode_steps=20, engine="jax", engine_reason="a test",
)  # fmt: skip
LOW, HIGH = (np.array(bound) for bound in (SPEC.action_low, SPEC.action_high))
CENTER, HALF_RANGE = (HIGH + LOW) / 2, (HIGH - LOW) / 2
TAU, GAMMA = 0.005, 0.99
PLAIN = {
    "context_length": 1, "return_conditioning": "none", "tune_alpha": False,
    "head_init_scale": 1.0,
}  # fmt: skip
TERMINATED, TRUNCATED, BAD = (np.arange(20) % 5 == kind for kind in (1, 2, 4))
"""Rows of a window of :func:`make_window`."""
# Smoothing that is cut often, by its own limit and by the bounds.
WILD = {"target_noise": 0.8, "target_noise_clip": 0.5}


@dataclasses.dataclass(frozen=True)
class Setup:
    """An agent for ``SPEC``, a learner all of whose networks differ, and settings."""

    agent: Agent
    update: Any
    learner: LearnerState
    hyper: Hyperparameters


def make_setup(**fields: Any) -> Setup:
    config = point_config(**{**PLAIN, "agent": "td3", **WILD, **fields}).validated()
    agent = agents.make(config, SPEC)
    learner = jax.jit(agent.init)(jax.random.key(0))
    learner = dataclasses.replace(
        learner,
        target_actor_params=shaken(learner.target_actor_params, 1),
        target_critic_params=shaken(learner.target_critic_params, 2),
    )
    return Setup(agent, jax.jit(agent.update), learner, hyperparameters(config, 2))


def shaken(params: Params, seed: int) -> Params:
    """Every number moved."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda p: p + jnp.asarray(rng.normal(0, 0.2, p.shape), p.dtype), params)


def make_window(seed: int = 0) -> Window:
    """20 steps; of each five, two ordinary ones and one of ``TERMINATED``, and so on."""
    rng = np.random.default_rng(seed)
    window = make_sac_window(context_length=1)
    window = jax.tree.map(lambda leaf: jnp.concatenate(4 * [leaf]), window)
    return dataclasses.replace(
        window,
        obs=jnp.asarray(rng.normal(size=(20, 2, 3)), jnp.float32),
        action=jnp.asarray(rng.uniform(LOW, HIGH, (20, 1, 2)), jnp.float32),
        reward=jnp.asarray(rng.normal(size=(20, 1)), jnp.float32),
        mask=window.mask.at[BAD].set(False),
        bootstrap_mask=window.bootstrap_mask.at[BAD].set(False),
        weight=jnp.asarray(rng.uniform(0.5, 2.0, 20), jnp.float32),
    )


@pytest.fixture(scope="module")
def td3() -> Setup:
    """With the paper's delay of two."""
    return make_setup()


@pytest.fixture(scope="module")
def prompt() -> Setup:
    """Without delay."""
    return make_setup(policy_delay=1)


# --- in NumPy --------------------------------------------------------------------------------


def numpy_dense(params: Any, x: np.ndarray) -> np.ndarray:
    return x @ np.asarray(params["kernel"], float) + np.asarray(params["bias"], float)


def numpy_mlp(params: Any, x: np.ndarray) -> np.ndarray:
    for layer in sorted(params):
        x = np.maximum(numpy_dense(params[layer], x), 0.0)
    return x


def numpy_actor(params: Params, obs: Any) -> np.ndarray:
    """The action without noise, as a share of the half range: in [-1, 1]."""
    layers = params["params"]
    return np.tanh(numpy_dense(layers["action"], numpy_mlp(layers["mlp"], np.asarray(obs, float))))


def numpy_critics(params: Params, obs: Any, action: Any) -> np.ndarray:
    """``[C, B, K]``."""
    x = np.concatenate([np.asarray(obs, float), np.asarray(action, float)], axis=-1)
    layers = params["params"]
    each = [jax.tree.map(lambda p, i=i: p[i], layers) for i in range(len(layers["q"]["bias"]))]
    return np.stack([numpy_dense(p["q"], numpy_mlp(p["mlp"], x))[..., 0] for p in each])


def numpy_mean(values: np.ndarray, window: Window, mask: jax.Array) -> float:
    weight = np.asarray(window.weight)[:, None] * np.asarray(mask)
    return float((values * weight).sum() / weight.sum())


def numpy_critic_loss(learner: LearnerState, window: Window, next_action: np.ndarray) -> float:
    obs = np.asarray(window.obs)
    next_q = numpy_critics(learner.target_critic_params, obs[:, 1:], next_action)
    y = np.asarray(window.reward) + GAMMA * np.asarray(window.discount) * next_q.min(0)
    q = numpy_critics(learner.critic_params, obs[:, :-1], window.action)
    return numpy_mean(((q - y) ** 2).sum(0), window, window.bootstrap_mask)


def numpy_actor_loss(actor: Params, critics: Params, window: Window) -> float:
    obs = window.obs[:, :-1]
    q = numpy_critics(critics, obs, CENTER + HALF_RANGE * numpy_actor(actor, obs))
    return numpy_mean(-q[0], window, window.mask)


# --- losses and targets ----------------------------------------------------------------------


def test_the_target_is_the_smaller_critic_at_the_smoothed_action(td3: Setup) -> None:
    window, key = make_window(), jax.random.key(7)
    _, metrics = td3.update(td3.learner, td3.hyper, window, key)
    point = numpy_actor(td3.learner.target_actor_params, window.obs[:, 1:])
    noise = 0.8 * np.asarray(jax.random.normal(key, point.shape), float)
    smoothed = point + np.clip(noise, -0.5, 0.5)
    # Some noise is cut and some is not, and so are some actions.
    assert {*(np.abs(noise) > 0.5).ravel()} == {*(np.abs(smoothed) > 1.0).ravel()} == {True, False}
    next_action = CENTER + HALF_RANGE * np.clip(smoothed, -1.0, 1.0)
    expected = numpy_critic_loss(td3.learner, window, next_action)
    assert float(metrics["critic_loss"]) == pytest.approx(expected, rel=1e-4)
    # It would not be the same without any of it.
    for other in (point, point + noise, smoothed):
        wrong = numpy_critic_loss(td3.learner, window, CENTER + HALF_RANGE * other)
        assert wrong != pytest.approx(expected, rel=2e-3)
    q = numpy_critics(td3.learner.critic_params, window.obs[:, :-1], window.action)
    q_mean = numpy_mean(q.mean(0), window, window.bootstrap_mask)
    assert float(metrics["q_mean"]) == pytest.approx(q_mean, rel=1e-4)


def test_the_actor_is_judged_by_the_first_critic_after_its_step(prompt: Setup) -> None:
    window = make_window()
    new, metrics = prompt.update(prompt.learner, prompt.hyper, window, jax.random.key(7))
    expected = numpy_actor_loss(prompt.learner.actor_params, new.critic_params, window)
    assert float(metrics["actor_loss"]) == pytest.approx(expected, rel=1e-4)


def reference_update(setup: Setup, window: Window, key: jax.Array, num_critics: int) -> Any:
    """New actor and critics: the update written out, with optax's Adam."""
    learner, hyper = setup.learner, setup.hyper
    actor = DeterministicActor((16,), "relu", 2, 1.0)
    critics = twin(MLPCritic, num_critics)((32, 32), "relu", False)
    obs, next_obs = window.obs[:, :-1], window.obs[:, 1:]

    def act(params: Params, obs: jax.Array) -> jax.Array:
        return CENTER + HALF_RANGE * jnp.tanh(actor.apply(params, obs))

    def mean_over(values: jax.Array, mask: jax.Array) -> jax.Array:
        weight = window.weight[:, None] * mask
        return (values * weight).sum() / weight.sum()

    next_action = act(learner.target_actor_params, next_obs)
    if num_critics == 2:
        noise = jnp.clip(0.8 * jax.random.normal(key, next_action.shape), -0.5, 0.5)
        next_action = jnp.clip(next_action + HALF_RANGE * noise, LOW, HIGH)
    next_q = critics.apply(learner.target_critic_params, next_obs, next_action).min(0)
    y = window.reward + GAMMA * window.discount * next_q

    def critic_loss(params: Params) -> jax.Array:
        q = critics.apply(params, obs, window.action)
        return mean_over(((q - y) ** 2).sum(0), window.bootstrap_mask)

    def step(params: Params, grads: Params, learning_rate: jax.Array) -> Params:
        adam = optax.adam(learning_rate)
        return optax.apply_updates(params, adam.update(grads, adam.init(params))[0])

    critic_params = step(
        learner.critic_params,
        jax.grad(critic_loss)(learner.critic_params),
        hyper.critic_learning_rate,
    )

    def actor_loss(params: Params) -> jax.Array:
        return mean_over(-critics.apply(critic_params, obs, act(params, obs))[0], window.mask)

    actor_grads = jax.grad(actor_loss)(learner.actor_params)
    return step(learner.actor_params, actor_grads, hyper.actor_learning_rate), critic_params


def test_parameters_move_as_written_out(prompt: Setup) -> None:
    window, key = make_window(3), jax.random.key(9)
    new, metrics = prompt.update(prompt.learner, prompt.hyper, window, key)
    actor, critics = jax.jit(lambda: reference_update(prompt, window, key, 2))()
    # Adam's first step divides by the gradient's size: rounding shows where it is tiny.
    assert largest_difference((new.actor_params, new.critic_params), (actor, critics)) < 3e-5
    assert largest_difference(new.actor_params, prompt.learner.actor_params) > 5e-4
    assert all(float(metrics[f"{name}_grad_norm"]) > 0 for name in ("actor", "critic"))


def test_what_is_masked_does_not_matter(prompt: Setup) -> None:
    window, key = make_window(), jax.random.key(1)
    before, metrics = prompt.update(prompt.learner, prompt.hyper, window, key)
    garbage = dataclasses.replace(
        window,
        # What the truncated step and the one of bad physics were worth, and where they led to.
        reward=window.reward.at[TRUNCATED | BAD].set(1e3),
        obs=window.obs.at[TERMINATED | TRUNCATED | BAD, 1].set(5.0).at[BAD, 0].set(-3.0),
        action=window.action.at[BAD].set(0.9),
    )
    after, metrics_after = prompt.update(prompt.learner, prompt.hyper, garbage, key)
    for name, value in metrics.items():
        assert float(metrics_after[name]) == pytest.approx(float(value), rel=1e-5), name
    assert largest_difference(before, after) < 1e-6
    # A truncated step is a state for the actor, if not one for the critics.
    moved = dataclasses.replace(window, obs=window.obs.at[TRUNCATED, 0].set(-3.0))
    after, metrics_after = prompt.update(prompt.learner, prompt.hyper, moved, key)
    assert float(metrics_after["critic_loss"]) == pytest.approx(float(metrics["critic_loss"]))
    assert float(metrics_after["actor_loss"]) != pytest.approx(float(metrics["actor_loss"]))


def test_jit_changes_nothing(td3: Setup) -> None:
    window, key = make_window(), jax.random.key(2)
    learner = dataclasses.replace(td3.learner, num_updates=jnp.int32(1))  # the actor's turn
    jitted, metrics = td3.update(learner, td3.hyper, window, key)
    plain, plain_metrics = td3.agent.update(learner, td3.hyper, window, key)
    assert largest_difference(jitted, plain) < 1e-5
    assert int(plain.actor_opt.count) == 1
    for name, value in metrics.items():
        assert float(plain_metrics[name]) == pytest.approx(float(value), rel=1e-4), name


def by_hand(target: Params, online: Params) -> Params:
    return jax.tree.map(
        lambda t, o: (1 - TAU) * np.asarray(t, float) + TAU * np.asarray(o, float), target, online
    )


def check_soft_update(before: LearnerState, after: LearnerState) -> None:
    for name in ("actor", "critic"):
        old, new = (getattr(learner, f"target_{name}_params") for learner in (before, after))
        expected = by_hand(old, getattr(after, f"{name}_params"))
        for a, b in zip(jax.tree.leaves(new), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)
        assert largest_difference(old, new) > 1e-4


# --- the delay -------------------------------------------------------------------------------

POLICY = ("actor_params", "actor_opt", "target_actor_params", "target_critic_params")


@pytest.mark.parametrize("delay", [2, 3])
def test_actor_and_targets_move_every_so_many_updates(td3: Setup, delay: int) -> None:
    setup = td3 if delay == 2 else make_setup(policy_delay=delay)
    learner, losses, reported = setup.learner, [], []
    for number in range(1, 2 * delay + 2):
        window, key = make_window(number), jax.random.key(number)
        new, metrics = setup.update(learner, setup.hyper, window, key)
        reported.append(float(metrics["actor_loss"]))
        assert unequal(new.critic_params, learner.critic_params)
        assert int(new.critic_opt.count) == int(new.num_updates) == number
        assert int(new.actor_opt.count) == number // delay
        if number % delay:
            for name in POLICY:
                assert unequal(getattr(new, name), getattr(learner, name)) == {}, name
            assert reported[-1] == float(metrics["actor_grad_norm"]) == 0.0
        else:
            check_soft_update(learner, new)
            losses.append(numpy_actor_loss(learner.actor_params, new.critic_params, window))
            assert float(metrics["actor_grad_norm"]) > 0
        learner = new
    # The mean over the updates, as it is logged, is that over the actor's.
    assert np.mean(reported[: 2 * delay]) == pytest.approx(np.mean(losses), rel=1e-4)


def test_without_delay_nothing_is_counted(prompt: Setup) -> None:
    new, _ = prompt.update(prompt.learner, prompt.hyper, make_window(), jax.random.key(0))
    assert new.num_updates is None
    check_soft_update(prompt.learner, new)


def products(jaxpr: Any) -> int:
    """Matrix products in it, in everything it calls, and in no conditional."""
    total = 0
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            total += 1
        elif equation.primitive.name != "cond":
            total += sum(products(inner) for inner in jax.core.jaxprs_in_params(equation.params))
    return total


def conditions(jaxpr: Any) -> list[Any]:
    """Those on which products depend; others ask for the platform."""
    return [
        equation
        for equation in jaxpr.eqns
        if equation.primitive.name == "cond"
        and any(products(branch.jaxpr) for branch in equation.params["branches"])
    ]


def traced_for_two_members(setup: Setup) -> Any:
    learners = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), setup.learner)
    both = jax.vmap(setup.agent.update, in_axes=(0, None, None, None))
    return jax.make_jaxpr(both)(learners, setup.hyper, make_window(), jax.random.key(0)).jaxpr


def test_a_delayed_actor_costs_nothing(td3: Setup) -> None:
    traced = traced_for_two_members(td3)
    (condition,) = conditions(traced)
    assert condition.invars[0].aval.shape == ()  # one for both
    resting, moving = (products(branch.jaxpr) for branch in condition.params["branches"])
    # The actor has 2 layers, the critics 3. Backward two products each, those of no use included.
    assert (resting, moving) == (0, (2 + 3) + 2 * (2 + 3))
    # Outside of it: target actor and critics; the critics, and backward.
    assert products(traced) == (2 + 3) + 3 + 2 * 3


# --- acting ----------------------------------------------------------------------------------


def make_policy(setup: Setup) -> PolicyState:
    return policy_state(setup.learner, setup.hyper)


def check_exploration(setup: Setup, noise: float) -> None:
    """4,000 equal states: every deviation is noise; ``noise`` in half ranges, both actions' own."""
    policy = make_policy(setup)
    obs = jnp.tile(jnp.array([0.3, -0.5, 0.2]), (4_000, 1))
    context = start(obs, 1, 2, setup.agent.init_cache(4_000))
    mean = CENTER + HALF_RANGE * numpy_actor(policy.actor_params, obs)
    greedy = setup.agent.act(policy, context, jax.random.key(0), explore=False)
    np.testing.assert_allclose(greedy.action, mean, rtol=1e-5, atol=1e-6)
    assert greedy.context.cache == {}
    action = np.asarray(setup.agent.act(policy, context, jax.random.key(0), explore=True).action)
    np.testing.assert_allclose(
        action,
        np.clip(
            mean + noise * HALF_RANGE * jax.random.normal(jax.random.key(0), mean.shape), LOW, HIGH
        ),
        rtol=1e-4,
        atol=1e-5,
    )
    deviation = (action - mean) / HALF_RANGE
    np.testing.assert_allclose(deviation.mean(0), 0.0, atol=4 * noise / np.sqrt(4_000))
    np.testing.assert_allclose(deviation.std(0), noise, rtol=0.05)
    assert np.abs(deviation).max() > 3 * noise  # it is not cut
    assert abs(np.corrcoef(deviation.T)[0, 1]) < 0.06


def test_exploration_is_gaussian_in_half_ranges(td3: Setup) -> None:
    check_exploration(td3, 0.1)


def test_exploration_stays_within_the_bounds() -> None:
    setup = make_setup(action_noise=2.0)
    context = start(jnp.zeros((500, 3)), 1, 2, {})
    action = np.asarray(
        setup.agent.act(make_policy(setup), context, jax.random.key(0), explore=True).action
    )
    assert (action.min(0) == LOW).all()
    assert (action.max(0) == HIGH).all()
    assert ((action > LOW) & (action < HIGH)).any(0).all()


def test_observations_are_normalized_everywhere(prompt: Setup) -> None:
    """Shifted and scaled observations under statistics that undo it: the same update, action."""
    plain, setup = prompt, make_setup(policy_delay=1, normalize_obs=True)
    shift, scale = jnp.array([3.0, -1.0, 0.5]), jnp.array([2.0, 0.5, 4.0])
    normalizer = dataclasses.replace(
        setup.learner.normalizer, count=jnp.int32(1_000), mean=shift, m2=1_000 * scale**2
    )
    learner = dataclasses.replace(setup.learner, normalizer=normalizer)
    window, key = make_window(), jax.random.key(3)
    expected, _ = plain.update(plain.learner, plain.hyper, window, key)
    shifted = dataclasses.replace(window, obs=shift + scale * window.obs)
    new, _ = setup.update(learner, setup.hyper, shifted, key)
    assert largest_difference(new.critic_params, expected.critic_params) < 1e-4
    assert largest_difference(new.actor_params, expected.actor_params) < 1e-4
    obs = window.obs[:, 0]
    actions = [
        s.agent.act(policy_state(state, s.hyper), start(o, 1, 2, {}), key, explore=True).action
        for s, state, o in ((plain, plain.learner, obs), (setup, learner, shift + scale * obs))
    ]
    np.testing.assert_allclose(*actions, atol=1e-4)


# --- faults ----------------------------------------------------------------------------------


def poisoned(what: str, learner: LearnerState, window: Window) -> tuple[LearnerState, Window]:
    if what in ("obs", "reward", "return_to_go"):
        values = getattr(window, what)
        return learner, window.replace(**{what: values.at[0, 0].set(jnp.nan)})
    name = {
        "policy": "target_actor_params",
        "next_q": "target_critic_params",
        "critic_loss": "critic_params",
        "actor_loss": "actor_params",
    }[what]
    # Of the online networks the products overflow: the targets never get to see a NaN.
    factor = 1e25 if name in ("critic_params", "actor_params") else jnp.nan
    params = jax.tree.map(lambda leaf: factor * leaf, getattr(learner, name))
    return learner.replace(**{name: params}), window


@pytest.mark.parametrize(
    "what", ["obs", "reward", "return_to_go", "policy", "next_q", "critic_loss"]
)
def test_a_tensor_that_is_not_finite_leaves_everything_as_it_was(td3: Setup, what: str) -> None:
    learner, window = poisoned(what, td3.learner, make_window())
    for number in (1, 2):
        new, metrics = td3.update(learner, td3.hyper, window, jax.random.key(1))
        assert td3.agent.checked[int(metrics["fault"])] == what
        # Members stay in step.
        assert set(unequal(new, learner)) == {".num_updates"}
        assert int(new.num_updates) == number
        learner = new


def test_an_actor_that_is_not_finite_stays_and_the_critics_go_on(td3: Setup) -> None:
    learner, window = poisoned("actor_loss", td3.learner, make_window())
    # It is not looked at before its turn.
    learner, metrics = td3.update(learner, td3.hyper, window, jax.random.key(1))
    assert int(metrics["fault"]) == NO_FAULT
    new, metrics = td3.update(learner, td3.hyper, window, jax.random.key(2))
    assert td3.agent.checked[int(metrics["fault"])] == "actor_loss"
    for name in ("actor_params", "actor_opt", "target_actor_params"):
        assert unequal(getattr(new, name), getattr(learner, name)) == {}, name
    for name in ("critic_params", "critic_opt", "target_critic_params"):
        assert unequal(getattr(new, name), getattr(learner, name)), name


# --- members and devices ---------------------------------------------------------------------


def test_a_batch_split_over_devices_is_the_same_update(td3: Setup) -> None:
    shards, config = 4, point_config(**PLAIN, agent="td3", **WILD)
    window = make_window()
    split = jax.tree.map(lambda x: x.reshape(shards, -1, *x.shape[1:]), window)
    many = jax.jit(
        jax.vmap(
            agents.make(config, SPEC, DataAxis(shards)).update,
            in_axes=(None, None, 0, None),
            # Whatever differs between shards shows here.
            out_axes=0,
            axis_name=DATA_AXIS,
        )
    )
    learner = td3.learner
    for number in range(4):
        key = jax.random.key(number)
        everywhere, metrics = many(learner, td3.hyper, split, key)
        learner, expected = td3.update(learner, td3.hyper, window, key)
        for shard in range(shards):
            ours = jax.tree.map(lambda leaf, i=shard: leaf[i], everywhere)
            assert largest_difference(ours, learner) < 1e-5
        for name, value in expected.items():
            np.testing.assert_allclose(metrics[name], value, rtol=1e-4, err_msg=name)


@pytest.fixture(scope="module")
def pair() -> Any:
    """Two members that are delayed by three, and their compiled chunk of 60 updates."""
    config = point_config(**PLAIN, agent="td3", chunk_env_steps=60, policy_delay=3)
    population = make_population(config, seed_members((3, 4)), env=PointEnv())
    return population, population.train_chunk.lower(population.abstract()).compile()


def test_members_share_one_condition(pair: Any) -> None:
    assert pair[1].as_text().count(" conditional(") == 2  # the environment's resets are the other


def test_two_members_are_what_each_is_alone(pair: Any) -> None:
    population, train_chunk = pair
    state, _ = train_chunk(population.prefill(population.init())[0])
    program = make_program(population.config, point_env(4))
    for index, seed in enumerate((3, 4)):
        expected, _ = program.prefill(program.init(jax.random.key(seed)))
        expected, metrics = program.train_chunk(expected)
        assert all(np.isfinite(value) for value in metrics.values())
        ours = member_state(population, state, index)
        assert int(ours.learner.num_updates) == 60
        assert int(ours.learner.actor_opt.count) == 20
        for part in ("learner", "buffer"):
            assert largest_difference(getattr(ours, part), getattr(expected, part)) < 1e-4


# --- learning --------------------------------------------------------------------------------

# More random steps and noise than SAC: a deterministic actor does not get out of a corner itself.
LEARNING = {
    **PLAIN, "prefill_env_steps": 1_000, "actor_learning_rate": 3e-4, "action_noise": 0.3,
    "tau": 0.02, "head_init_scale": 0.01, "eval_episodes": 16,
}  # fmt: skip
BROKEN = {
    "working": {},
    "actor frozen": {"actor_learning_rate": 1e-12},
    "critics frozen": {"critic_learning_rate": 1e-12},
    "future ignored": {"discount": 0.0},
    "targets frozen": {"tau": 1e-12},
}
SEEDS = range(6)


def worst_over_seeds(agent: str) -> dict[str, float]:
    """Evaluation return after 1,600 updates, for each of ``BROKEN``; all in one program."""
    members = [
        Member(f"{name} {seed}", seed, values) for name, values in BROKEN.items() for seed in SEEDS
    ]
    config = point_config(**{**LEARNING, "agent": agent})
    population = make_population(config, members, env=PointEnv())
    state, _ = population.prefill(population.init())
    for _ in range(4):
        state, metrics = population.train_chunk(state)
        assert all(np.isfinite(value).all() for value in metrics.values())
    returns = population.evaluate(policy_of(state), np.int32(123)).returns.mean(axis=1)
    worst = np.asarray(returns).reshape(len(BROKEN), len(SEEDS)).min(axis=1)
    return dict(zip(BROKEN, worst.tolist(), strict=True))


def check_learning(agent: str) -> None:
    """Every seed learns; broken, one or another may be lucky with what its critics make up."""
    worst = worst_over_seeds(agent)
    assert worst.pop("working") > LEARNT, worst
    assert max(worst.values()) < 2 * LEARNT, worst


def test_learns_and_a_broken_update_does_not() -> None:
    check_learning("td3")


# --- a run -----------------------------------------------------------------------------------

RUN = {
    **TINY, "agent": "td3", "context_length": 1, "return_conditioning": "none",
    "tune_alpha": False, "total_env_steps": 500, "checkpoint_every": 100, "eval_every": 500,
}  # fmt: skip


def test_resuming_equals_never_having_stopped(tmp_path: Path) -> None:
    """The delay goes on where it was: 200 updates before, 100 after, and 3 to one of the actor."""
    config = Config.from_preset("cpu", **RUN, policy_delay=3, run_dir=str(tmp_path / "straight"))
    paths = [train(config, quiet=True).path, tmp_path / "killed"]
    shutil.copytree(*paths)
    shutil.rmtree(paths[1] / "checkpoints" / "500")
    resume(paths[1], quiet=True)
    assert state_digest(paths[0]) == state_digest(paths[1])
    assert (paths[0] / "metrics.jsonl").read_bytes() == (paths[1] / "metrics.jsonl").read_bytes()

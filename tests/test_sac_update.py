"""The update against hand-computed NumPy values and an independent two-pass reference."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from gpt2 import gaussian_of
from probe import PointEnv, point_config, point_env

from sacformer_jax import agents
from sacformer_jax.agents import sacformer
from sacformer_jax.agents.sac_update import (
    bellman_target,
    lambda_target,
    make_sac_agent,
    soft_update,
    step_weights,
)
from sacformer_jax.agents.sacformer import predicted_steps
from sacformer_jax.config import Config
from sacformer_jax.critics import CriticInputs, MLPCritic, make_critics, twin
from sacformer_jax.envs import wrapped
from sacformer_jax.envs.wrapping import Wrapping
from sacformer_jax.networks import TransformerActor
from sacformer_jax.parallel import DataAxis
from sacformer_jax.train import hyperparameters
from sacformer_jax.transformer import TransformerConfig
from sacformer_jax.types import States, Window

B, K = 5, 3
EFFECT = {"prediction_steps": "effect"}


def make_window(seed=0, context_length=K) -> Window:
    """Windows with every kind of step: terminated, truncated, newest, padded, bad physics."""
    rng = np.random.default_rng(seed)
    k = context_length
    state_mask = np.ones((B, k + 1), bool)
    discount = np.ones((B, k), np.float32)
    bootstrap = np.ones((B, k), bool)
    state_mask[1, -1] = False
    discount[1, -1] = 0.0  # terminated at the last step
    state_mask[2, -1] = False
    bootstrap[2, -1] = False  # truncated: successor unknown
    mask = state_mask[:, :-1].copy()
    if k > 1:
        state_mask[3, 0], mask[3, 0], bootstrap[3, 0] = False, False, False  # padding
        mask[4, -1], bootstrap[4, -1] = False, False  # bad physics
    return Window(
        obs=jnp.asarray(rng.normal(size=(B, k + 1, 2)), jnp.float32),
        action=jnp.asarray(rng.uniform(-1, 1, (B, k, 1)), jnp.float32),
        reward=jnp.asarray(rng.normal(size=(B, k)), jnp.float32),
        discount=jnp.asarray(discount),
        return_so_far=jnp.asarray(rng.normal(size=(B, k + 1)), jnp.float32),
        return_to_go=jnp.asarray(rng.normal(size=(B, k + 1)), jnp.float32),
        time_step=jnp.asarray(rng.integers(0, 9, (B, k + 1)), jnp.int32),
        state_mask=jnp.asarray(state_mask),
        mask=jnp.asarray(mask),
        bootstrap_mask=jnp.asarray(bootstrap),
        weight=jnp.asarray(1.0 / np.maximum(state_mask[:, :-1].sum(1), 1), jnp.float32),
    )


@pytest.fixture(scope="module", params=["gs", "joint"])
def setup(request):
    config = point_config(context_length=K, tokens=request.param)
    env = point_env(1)
    agent = agents.make(config, env.spec)
    learner = jax.jit(agent.init)(jax.random.key(0))
    return config, env.spec, jax.jit(agent.update), learner, hyperparameters(config, 1)


def taken(window):
    """The actions beside the K+1 states; what stands at the last is seen by nobody."""
    return jnp.concatenate([window.action, jnp.full((len(window.action), 1, 1), 7.0)], axis=1)


def transformer(config, spec, **fields):
    return TransformerActor(
        TransformerConfig(1, 16, 1, 4, 0.0, "relu"),
        1,
        K,
        spec.max_episode_steps + 1,
        0.01,
        config.context.tokens,
        **fields,
    )


def networks(config, spec):
    return gaussian_of(transformer(config, spec)), twin(MLPCritic)((32, 32), "relu", False)


# --- by hand ---------------------------------------------------------------------------------


def test_bellman_target_at_ordinary_and_terminated_steps():
    y = bellman_target(
        reward=jnp.array([[1.0, 2.0]]),
        discount=0.9 * jnp.array([[1.0, 0.0]]),  # the second step terminated
        next_q=jnp.array([[[10.0, 50.0]], [[8.0, 70.0]]]),
        next_log_prob=jnp.array([[-2.0, 3.0]]),
        alpha=jnp.float32(0.5),
    )
    # 1 + 0.9 (min(10, 8) - 0.5 (-2)) and 2 alone.
    np.testing.assert_allclose(y, [[9.1, 2.0]], rtol=1e-6)


def test_lambda_target_is_the_mean_of_targets_of_one_step_two_and_so_on():
    """Against the definition: n-step targets weighted by (1 - λ) λ^(n-1), the rest on the last."""
    rng, gamma, lam, k = np.random.default_rng(0), 0.9, 0.7, 5
    reward, q, bonus = rng.normal(size=(3, 2, k))  # of B = 2; Q and -α log π after each step
    goes_on = np.ones((2, k))
    goes_on[0, 2] = 0.0  # terminated there
    follows = np.ones((2, k), bool)
    follows[:, -1] = False
    follows[0, 2] = False
    follows[1, 1] = False  # what comes next cannot be judged
    one_step = reward + gamma * goes_on * (q + bonus)
    decay = gamma * lam * goes_on * follows
    got = lambda_target(*(jnp.asarray(x, jnp.float32) for x in (one_step, decay, q)))

    def n_step(b, t, n):
        """Rewards with their bonuses, and Q after n of them."""
        total, factor = 0.0, 1.0
        for i in range(t, t + n):
            total += factor * (reward[b, i] + gamma * goes_on[b, i] * bonus[b, i])
            factor *= gamma * goes_on[b, i]
        return total + factor * q[b, t + n - 1]

    for b in range(2):
        for t in range(k):
            most = next(n for n in range(1, k - t + 1) if not follows[b, t + n - 1])
            weights = [(1 - lam) * lam ** (n - 1) for n in range(1, most)] + [lam ** (most - 1)]
            expected = sum(w * n_step(b, t, n + 1) for n, w in enumerate(weights))
            assert float(got[b, t]) == pytest.approx(expected, rel=1e-5)


def test_sac_learns_from_windows_as_from_their_steps():
    """An update on windows is that on single steps of the same weights, with the same noise."""
    single = {"context_length": 1, "return_conditioning": "none"}
    config = point_config(agent="sac", learnt_steps=K, **single)
    agent = agents.make(config, point_env(1).spec)
    learner, hyper = jax.jit(agent.init)(jax.random.key(0)), hyperparameters(config, 1)
    windows, key = make_window(), jax.random.key(7)

    def apart(x, states=False):
        """``[B, K, ...]`` or ``[B, K+1, ...]`` -> ``[B K, 1, ...]`` or ``[B K, 2, ...]``."""
        pairs = jnp.stack([x[:, :-1], x[:, 1:]], axis=2) if states else x[:, :, None]
        return pairs.reshape(-1, *pairs.shape[2:])

    of_states = ("obs", "return_so_far", "return_to_go", "time_step", "state_mask")
    of_steps = ("action", "reward", "discount", "mask", "bootstrap_mask")
    steps = Window(
        **{name: apart(getattr(windows, name), states=True) for name in of_states},
        **{name: apart(getattr(windows, name)) for name in of_steps},
        weight=jnp.repeat(windows.weight, K),
    )
    update = jax.jit(agent.update)
    together, by_steps = update(learner, hyper, windows, key), update(learner, hyper, steps, key)
    for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(by_steps), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6)

    # λ makes a difference, which single steps have nothing to show for.
    along = jax.jit(agents.make(config.replace(td_lambda=0.6), point_env(1).spec).update)
    loss = float(along(learner, hyper, windows, key)[1]["critic_loss"])
    assert loss != float(together[1]["critic_loss"])


def test_step_weights():
    window = make_window().replace(
        weight=jnp.array([0.5, 1.0, 0.0, 0.0, 0.0]),
        mask=jnp.ones((B, K), bool).at[1, 1:].set(False),
        bootstrap_mask=jnp.ones((B, K), bool).at[:, 1:].set(False),
    )
    parts = SimpleNamespace(data=DataAxis())
    weights = step_weights(parts, window)  # 3 x 0.5 + 1, and 0.5 + 1
    np.testing.assert_allclose(weights.actor[:2], [[0.2] * 3, [0.4, 0, 0]], rtol=1e-6)
    np.testing.assert_allclose(weights.critic[:2], [[1 / 3, 0, 0], [2 / 3, 0, 0]], rtol=1e-6)
    nothing = step_weights(parts, window.replace(weight=jnp.zeros(B)))
    assert not nothing.actor.any()
    assert not nothing.critic.any()


def test_soft_update():
    moved = soft_update({"w": jnp.array([1.0])}, {"w": jnp.array([3.0])}, jnp.float32(0.005))
    np.testing.assert_allclose(moved["w"], [1.01])


def shown(config, spec, learner, window):
    """The policy's distributions at the K+1 states, conditioned on the commanded return."""
    return output_of(transformer(config, spec), learner.actor_params, window).gaussian


def output_of(actor, actor_params, window):
    """All that an actor says of the K+1 states."""
    return actor.apply(
        actor_params,
        window.obs,
        taken(window),
        (0.0 - window.return_so_far) / 10.0,  # (target - so far) / scale
        window.time_step,
        window.state_mask,
    )


def numpy_mlp(params, x):
    for layer in ("dense_0", "dense_1"):
        x = np.maximum(x @ params["mlp"][layer]["kernel"] + params["mlp"][layer]["bias"], 0.0)
    return (x @ params["q"]["kernel"] + params["q"]["bias"])[..., 0]


def numpy_q(params, obs, action):
    x = np.concatenate([obs, action], axis=-1)
    both = [jax.tree.map(lambda p, i=i: np.asarray(p[i], float), params["params"]) for i in (0, 1)]
    return np.stack([numpy_mlp(p, x) for p in both])


def numpy_sample(gaussian, key):
    """The tanh-Gaussian on [-1, 1], written out."""
    mean, log_std = (np.asarray(x, float) for x in (gaussian.mean, gaussian.log_std))
    noise = np.asarray(jax.random.normal(key, mean.shape), float)
    u = mean + np.exp(log_std) * noise
    log_prob = -0.5 * noise**2 - log_std - 0.5 * np.log(2 * np.pi) - np.log(1 - np.tanh(u) ** 2)
    return np.tanh(u), log_prob.sum(-1)


def test_losses_on_a_fixed_batch_equal_numpy(setup):
    config, spec, update, learner, hyper = setup
    learner = dataclasses.replace(learner, log_alpha=jnp.float32(np.log(0.3)))
    window, key = make_window(), jax.random.key(7)
    _, metrics = update(learner, hyper, window, key)

    gaussian = shown(config, spec, learner, window)
    _, next_key, action_key = jax.random.split(key, 3)
    obs = np.asarray(window.obs, float)
    following = jax.tree.map(lambda x: x[:, 1:], gaussian)
    next_action, next_log_prob = numpy_sample(following, next_key)
    next_q = numpy_q(learner.target_critic_params, obs[:, 1:], next_action).min(0)
    reward, discount = np.asarray(window.reward), np.asarray(window.discount)
    y = reward + 0.99 * discount * (next_q - 0.3 * next_log_prob)
    q = numpy_q(learner.critic_params, obs[:, :-1], np.asarray(window.action, float))

    # Means over the real steps of a window, then over windows: written as loops.
    weight, mask = np.asarray(window.weight), np.asarray(window.bootstrap_mask)
    total = norm = 0.0
    for b in range(B):
        for k in range(K):
            if mask[b, k]:
                total += weight[b] * ((q[0, b, k] - y[b, k]) ** 2 + (q[1, b, k] - y[b, k]) ** 2)
                norm += weight[b]
    assert float(metrics["critic_loss"]) == pytest.approx(total / norm, rel=1e-4)

    current = jax.tree.map(lambda x: x[:, :-1], gaussian)
    _, log_prob = numpy_sample(current, action_key)
    actor_weight = weight[:, None] * np.asarray(window.mask)
    entropy = -(actor_weight * log_prob).sum() / actor_weight.sum()
    assert float(metrics["entropy"]) == pytest.approx(entropy, rel=1e-4)
    assert float(metrics["alpha"]) == pytest.approx(0.3, rel=1e-6)


@pytest.mark.parametrize("setup", ["gs"], indirect=True)
def test_with_td_lambda_the_critics_learn_the_returns_along_the_window(setup):
    config, spec, update, learner, hyper = setup
    lam = 0.6
    window, key = make_window(), jax.random.key(7)
    along = jax.jit(agents.make(config.replace(td_lambda=lam), spec).update)
    learner = dataclasses.replace(learner, log_alpha=jnp.float32(np.log(0.3)))
    _, metrics = along(learner, hyper, window, key)
    of_one_step = update(learner, hyper, window, key)[1]
    assert float(metrics["critic_loss"]) != float(of_one_step["critic_loss"])

    following = jax.tree.map(lambda x: x[:, 1:], shown(config, spec, learner, window))
    next_action, next_log_prob = numpy_sample(following, jax.random.split(key, 3)[1])
    obs = np.asarray(window.obs, float)
    next_q = numpy_q(learner.target_critic_params, obs[:, 1:], next_action).min(0)
    q = numpy_q(learner.critic_params, obs[:, :-1], np.asarray(window.action, float))
    judged = np.asarray(window.bootstrap_mask)
    total = norm = 0.0
    for b in range(B):
        y = np.zeros(K + 1)
        for k in reversed(range(K)):
            later = next_q[b, k]
            if k + 1 < K and judged[b, k + 1]:
                later = (1 - lam) * later + lam * y[k + 1]
            factor = 0.99 * float(window.discount[b, k])
            y[k] = float(window.reward[b, k]) + factor * (later - 0.3 * next_log_prob[b, k])
            if judged[b, k]:
                total += float(window.weight[b]) * ((q[:, b, k] - y[k]) ** 2).sum()
                norm += float(window.weight[b])
    assert float(metrics["critic_loss"]) == pytest.approx(total / norm, rel=1e-4)


def test_critics_may_see_what_the_transformer_makes_of_the_past():
    config = point_config(context_length=K, critic_features=True)
    spec = point_env(1).spec
    agent = agents.make(config, spec)
    learner = jax.jit(agent.init)(jax.random.key(0))
    window, key = make_window(), jax.random.key(7)
    _, metrics = jax.jit(agent.update)(learner, hyperparameters(config, 1), window, key)

    output = output_of(transformer(config, spec), learner.actor_params, window)
    seen = np.concatenate([window.obs, output.features], axis=-1).astype(float)  # [B, K+1, O+D]
    following = jax.tree.map(lambda x: x[:, 1:], output.gaussian)
    next_action, next_log_prob = numpy_sample(following, jax.random.split(key, 3)[1])
    next_q = numpy_q(learner.target_critic_params, seen[:, 1:], next_action).min(0)
    alpha = float(jnp.exp(learner.log_alpha))
    y = window.reward + 0.99 * window.discount * (next_q - alpha * next_log_prob)
    q = numpy_q(learner.critic_params, seen[:, :-1], np.asarray(window.action, float))
    weight = window.weight[:, None] * window.bootstrap_mask
    expected = (weight * ((q - y) ** 2).sum(0)).sum() / weight.sum()
    assert float(metrics["critic_loss"]) == pytest.approx(float(expected), rel=1e-4)


def first_update(window, key, spec, **fields):
    """The actor's parameters, how they move, the gradients of its loss, the prediction's loss."""
    config = point_config(context_length=K, **fields)
    agent = agents.make(config, spec)
    learner = jax.jit(agent.init)(jax.random.key(0))
    # The layer that predicts starts at zero, where it passes no gradient on.
    kernel = learner.actor_params["params"]["prediction_out"]["kernel"]
    kernel += jnp.asarray(np.random.default_rng(1).normal(size=kernel.shape), jnp.float32)
    learner.actor_params["params"]["prediction_out"]["kernel"] = kernel
    new, metrics = jax.jit(agent.update)(learner, hyperparameters(config, 1), window, key)
    # The first moment of Adam's first step is a tenth of the gradient.
    grads = jax.tree.map(lambda x: 10.0 * x, new.actor_opt.mu["params"])
    moved = jax.tree.map(jnp.subtract, new.actor_params, learner.actor_params)["params"]
    return learner.actor_params, moved, grads, float(metrics["prediction_loss"])


def prediction_loss(actor, params, window, steps=1):
    """And its gradient in the actor's parameters, by NumPy and ``jax.grad``."""
    # A mean over the critics' steps: of a step that terminated there is no next observation.
    judged = np.asarray(window.weight)[:, None] * np.asarray(window.bootstrap_mask)  # [B, K]
    shown = np.asarray(window.state_mask[:, 1:] & window.bootstrap_mask)
    obs, reward = np.asarray(window.obs, float), np.asarray(window.reward, float)
    share_known = (judged * shown).sum() / judged.sum()
    parts = []  # of each step ahead: whose, the weights, what is to be foretold, its variance
    for ahead in range(steps):
        asked = slice(0, K - ahead)
        weights = judged[:, asked] * shown[:, ahead:]
        change = obs[:, 1 + ahead :] - obs[:, ahead:-1]
        outcome = np.concatenate([change, reward[:, ahead:, None]], axis=-1)
        rows, counts = outcome.reshape(-1, outcome.shape[-1]), weights.reshape(-1)
        variance = np.cov(rows.T, aweights=counts, ddof=0).diagonal()
        parts.append((asked, share_known * weights / weights.sum(), outcome, variance))

    def loss(params):
        prediction = output_of(actor, params, window).prediction  # [B, K + 1, H, O + 1]
        each = [
            (weights * ((prediction[:, asked, ahead] - outcome) ** 2 / variance).mean(-1)).sum()
            for ahead, (asked, weights, outcome, variance) in enumerate(parts)
        ]
        return sum(each) / steps

    value, grads = jax.jit(jax.value_and_grad(loss))(params)
    return float(value), grads["params"]


def test_the_actor_learns_to_predict_as_far_as_that_weighs():
    window, key, spec = make_window(), jax.random.key(7), point_env(1).spec
    params, _, once, loss_once = first_update(window, key, spec, prediction_weight=1.0)
    _, _, thrice, loss_thrice = first_update(window, key, spec, prediction_weight=3.0)
    assert loss_once == loss_thrice

    actor = transformer(point_config(context_length=K), spec, predicts=1)
    value, grads = prediction_loss(actor, params, window)
    assert loss_once == pytest.approx(value, rel=1e-5)
    # What is learnt besides is the same for both weights.
    for name in ("prediction", "prediction_out", "embed_state", "trunk", "heads"):
        got = jax.tree.map(lambda a, b: (b - a) / 2.0, once[name], thrice[name])
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5),
            got,
            grads[name],
        )
    assert np.any(grads["embed_state"]["kernel"])


def test_of_a_delayed_action_all_steps_until_its_effect_are_foretold():
    window, key = make_window(), jax.random.key(7)
    spec = dataclasses.replace(point_env(1).spec, wrapping=Wrapping(action_delay=1))
    fields = {"prediction_weight": 1.0, "prediction_steps": "effect", "action_delay": 1}
    params, _, _, loss = first_update(window, key, spec, **fields)
    actor = transformer(point_config(context_length=K), spec, predicts=2)
    assert loss == pytest.approx(prediction_loss(actor, params, window, steps=2)[0], rel=1e-5)


@pytest.mark.parametrize(
    ("fields", "steps"),
    [
        ({"action_delay": 2}, 1),
        ({"prediction_steps": 4}, 4),
        (EFFECT, 1),
        (EFFECT | {"action_delay": 2}, 3),
        # A window shows no more.
        (EFFECT | {"action_delay": 2, "learnt_steps": 2, "burn_in": 4}, 2),
        (EFFECT | {"action_delay": 2, "window": "scattered", "prefill_env_steps": 8_000}, 1),
        ({"prediction_weight": 0.0}, 0),
    ],
)
def test_what_is_foretold_reaches_as_far_as_the_delay(fields, steps):
    config = Config.from_preset("cpu", **{"prediction_weight": 1.0} | fields)
    assert predicted_steps(config, config.task.action_delay) == steps


def test_what_is_foretold_reaches_as_far_as_the_delay_that_an_environment_comes_with():
    config = point_config(**EFFECT, prediction_weight=1.0, context_length=K)
    delayed = wrapped(PointEnv(), action_delay=2).spec
    assert config.task.action_delay == 0
    assert sacformer.make_actor(config, delayed).predicts == 3


def test_a_transformer_may_learn_from_its_prediction_alone():
    window, key, spec = make_window(), jax.random.key(7), point_env(1).spec
    fields = {
        "transformer_loss": "prediction", "state_path_width": 8, "actor_learning_rate": 1e-3,
        "critic_learning_rate": 2e-3,
    }  # fmt: skip
    params, moved, got, loss = first_update(window, key, spec, **fields, prediction_weight=3.0)
    actor = transformer(
        point_config(context_length=K), spec, predicts=1, given=True, state_path=(8, 8)
    )
    value, wanted = prediction_loss(actor, params, window)
    assert loss == pytest.approx(value, rel=1e-5)
    for name, gradient in got.items():
        acts = name in ("heads", "state_path")
        # Adam's first step is one step size; the transformer's is that of the critics.
        step = max(float(jnp.max(jnp.abs(x))) for x in jax.tree.leaves(moved[name]))
        assert step == pytest.approx(1e-3 if acts else 2e-3, rel=1e-2), name
        assert any(np.any(x) for x in jax.tree.leaves(gradient)), name
        if not acts:
            jax.tree.map(
                lambda a, b: np.testing.assert_allclose(a, 3.0 * b, 1e-3, 1e-5),
                gradient,
                wanted[name],
            )

    # The actor sees the features beside the state, though: it acts on the past.
    shown = output_of(actor, params, window).gaussian.mean
    before = dataclasses.replace(window, obs=window.obs.at[:, 0].add(1.0))
    other = output_of(actor, params, before).gaussian.mean
    assert np.all(np.any(shown[:, 1] != other[:, 1], axis=-1) == window.state_mask[:, 0])


def test_what_a_burn_in_is_not_computed_of_changes_nothing():
    config = Config.from_preset(
        "memory", context_length=3, learnt_steps=3, burn_in=2, tokens="joint", actor_layers=2,
        actor_width=8, critic_width=16, state_path_width=16, acting_context_limit=3,
        action_delay=1,
    )  # fmt: skip
    spec, window = point_env(1).spec, make_window(context_length=5)
    learnt = (jnp.arange(5) >= 2)[None]
    window = dataclasses.replace(
        window, mask=window.mask & learnt, bootstrap_mask=window.bootstrap_mask & learnt
    )
    parts = sacformer.make_parts(config, spec, DataAxis())
    learner = jax.jit(agents.make(config, spec).init)(jax.random.key(0))
    kernel = learner.actor_params["params"]["prediction_out"]["kernel"]  # zeros
    learner.actor_params["params"]["prediction_out"]["kernel"] = 0.1 + kernel

    def updated(parts):
        agent = make_sac_agent(parts)
        hyper = hyperparameters(config, 1)
        new, metrics = jax.jit(agent.update)(learner, hyper, window, jax.random.key(7))
        return new.actor_opt.mu, new.critic_opt.mu, metrics

    everything = dataclasses.replace(
        parts,
        burn_in=0,
        critics=make_critics(config.critic, "float32", 3, spec.max_episode_steps + 1),
    )
    for some, every in zip(*map(jax.tree.leaves, map(updated, (parts, everything))), strict=True):
        np.testing.assert_allclose(some, every, rtol=1e-3, atol=1e-6)


def test_alpha_gradient_sign_and_first_adam_step(setup):
    _, _, update, learner, hyper = setup
    window = make_window()
    for target, direction in ((100.0, 1.0), (-100.0, -1.0)):  # far above, far below
        wanted = dataclasses.replace(hyper, target_entropy=jnp.float32(target))
        new, _ = update(learner, wanted, window, jax.random.key(0))
        # Adam's first step is one learning rate against the gradient's sign.
        step = float(new.log_alpha - learner.log_alpha)
        assert step == pytest.approx(direction * 1e-3, rel=1e-3)


def test_what_is_masked_does_not_matter(setup):
    _, _, update, learner, hyper = setup
    window, key = make_window(), jax.random.key(1)
    before, metrics_before = update(learner, hyper, window, key)
    garbage = np.asarray(window.reward).copy()
    garbage[~np.asarray(window.bootstrap_mask)] = 1e3
    action = np.asarray(window.action).copy()
    action[~np.asarray(window.mask)] = 0.9
    obs = np.asarray(window.obs).copy()
    obs[~np.asarray(window.state_mask)] = 5.0  # the states after terminated and truncated steps
    changed = dataclasses.replace(
        window, reward=jnp.asarray(garbage), action=jnp.asarray(action), obs=jnp.asarray(obs)
    )
    after, metrics_after = update(learner, hyper, changed, key)
    assert float(metrics_after["critic_loss"]) == pytest.approx(
        float(metrics_before["critic_loss"]), rel=1e-5
    )
    for a, b in zip(
        jax.tree.leaves((before.actor_params, before.critic_params)),
        jax.tree.leaves((after.actor_params, after.critic_params)),
        strict=True,
    ):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_a_transformer_critic_learns_from_the_same_loss():
    config = point_config(context_length=K, critic="transformer", critic_width=16, critic_heads=2)
    spec = point_env(1).spec
    agent = agents.make(config, spec)
    learner, hyper = jax.jit(agent.init)(jax.random.key(0)), hyperparameters(config, 1)
    window, key = make_window(), jax.random.key(7)
    new, metrics = jax.jit(agent.update)(learner, hyper, window, key)

    gaussian = shown(config, spec, learner, window)
    critics = make_critics(config.critic, "float32", K, spec.max_episode_steps + 1)
    inputs = CriticInputs(
        window.obs[:, :-1], window.obs[:, 1:], window.action, window.time_step, window.state_mask
    )
    next_action, next_log_prob = numpy_sample(
        jax.tree.map(lambda x: x[:, 1:], gaussian), jax.random.split(key, 3)[1]
    )
    next_q = jax.jit(critics.following)(
        learner.target_critic_params, inputs, jnp.asarray(next_action, jnp.float32)
    ).min(0)
    alpha = float(jnp.exp(learner.log_alpha))
    y = window.reward + 0.99 * window.discount * (next_q - alpha * next_log_prob)
    q = jax.jit(critics.now)(learner.critic_params, inputs, window.action)
    weight = window.weight[:, None] * window.bootstrap_mask
    expected = (weight * ((q - y) ** 2).sum(0)).sum() / weight.sum()
    assert float(metrics["critic_loss"]) == pytest.approx(float(expected), rel=1e-4)
    # Every parameter learns, the embedding of replayed actions included.
    for name in ("embed_state", "embed_action", "embed_candidate", "q"):
        moved = jax.tree.map(
            lambda a, b: np.any(a != b),
            new.critic_params["params"][name],
            learner.critic_params["params"][name],
        )
        assert all(jax.tree.leaves(moved)), name


# --- one pass against two --------------------------------------------------------------------


def contiguous_policies(config, spec, hyper, window):
    """π at the K steps and after them as functions of the parameters, each a pass of its own."""
    actor, k = networks(config, spec)[0], window.action.shape[1]
    return_to_go = (hyper.target_return - window.return_so_far) / hyper.return_scale

    def policy(params, states):
        return actor(
            params,
            window.obs[:, :states],
            taken(window)[:, :states],
            return_to_go[:, :states],
            window.time_step[:, :states],
            window.state_mask[:, :states],
        )

    return (
        lambda params: policy(params, k),
        lambda params: jax.tree.map(lambda x: x[:, 1:], policy(params, k + 1)),
    )


def reference_update(config, spec, learner, hyper, window, key, policies, obs, next_obs):
    """The update written out, by two passes and optax's Adam."""
    critic = networks(config, spec)[1]
    now, after = policies
    _, next_key, action_key = jax.random.split(key, 3)
    alpha = jnp.exp(learner.log_alpha)

    def sample(mean, log_std, key):
        noise = jax.random.normal(key, mean.shape)
        u = mean + jnp.exp(log_std) * noise
        log_prob = -0.5 * noise**2 - log_std - 0.5 * jnp.log(2 * jnp.pi)
        log_prob -= 2 * (jnp.log(2.0) - u - jax.nn.softplus(-2 * u))  # log(1 - tanh(u)^2)
        return jnp.tanh(u), log_prob.sum(-1)

    following = after(learner.actor_params)
    next_action, next_log_prob = sample(following.mean, following.log_std, next_key)
    next_q = critic.apply(learner.target_critic_params, next_obs, next_action).min(0)
    y = window.reward + hyper.discount * window.discount * (next_q - alpha * next_log_prob)

    def mean_over(values, mask):
        weights = window.weight[:, None] * mask
        return (values * weights).sum() / weights.sum()

    def critic_loss(params):
        q = critic.apply(params, obs, window.action)
        return mean_over((q[0] - y) ** 2 + (q[1] - y) ** 2, window.bootstrap_mask)

    def step(params, grads, learning_rate):
        adam = optax.adam(learning_rate)
        changes, _ = adam.update(grads, adam.init(params))
        return optax.apply_updates(params, changes)

    critic_grads = jax.grad(critic_loss)(learner.critic_params)
    critic_params = step(learner.critic_params, critic_grads, hyper.critic_learning_rate)

    def actor_loss(params):
        current = now(params)
        action, log_prob = sample(current.mean, current.log_std, action_key)
        q = critic.apply(critic_params, obs, action).min(0)
        return mean_over(alpha * log_prob - q, window.mask), log_prob

    grads, log_prob = jax.grad(actor_loss, has_aux=True)(learner.actor_params)
    alpha_grad = jax.grad(
        lambda log_alpha: mean_over(
            -jnp.exp(log_alpha) * (log_prob + hyper.target_entropy), window.mask
        )
    )(learner.log_alpha)
    actor_params = step(learner.actor_params, grads, hyper.actor_learning_rate)
    log_alpha = step(learner.log_alpha, alpha_grad, hyper.alpha_learning_rate)
    return actor_params, critic_params, log_alpha


def check_update(new, learner, hyper, reference):
    ours = (new.actor_params, new.critic_params, new.log_alpha)
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(reference), strict=True):
        # Adam's first step divides by the gradient's size: rounding shows where it is tiny.
        np.testing.assert_allclose(a, b, atol=3e-5)
    target = soft_update(learner.target_critic_params, reference[1], hyper.tau)
    for a, b in zip(
        jax.tree.leaves(new.target_critic_params), jax.tree.leaves(target), strict=True
    ):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_one_pass_equals_two_passes(setup):
    config, spec, update, learner, hyper = setup
    window, key = make_window(3), jax.random.key(9)
    new, _ = update(learner, hyper, window, key)

    @jax.jit
    def reference(learner, window):
        policies = contiguous_policies(config, spec, hyper, window)
        obs, next_obs = window.obs[:, :-1], window.obs[:, 1:]
        return reference_update(config, spec, learner, hyper, window, key, policies, obs, next_obs)

    check_update(new, learner, hyper, reference(learner, window))


def make_scattered(seed=0) -> Window:
    """Windows of K steps and what followed each, some of it unknown."""
    rng = np.random.default_rng(seed)
    base = make_window(seed)
    known = np.ones((B, K), bool)
    known[1:3, -1] = False
    discount = np.ones((B, K), np.float32)
    discount[1, -1] = 0.0  # terminated; the second window's end was truncated

    def number(*shape):
        return jnp.asarray(rng.normal(size=shape), jnp.float32)

    return dataclasses.replace(
        base,
        obs=number(B, K, 2),
        discount=jnp.asarray(discount),
        return_so_far=number(B, K),
        return_to_go=number(B, K),
        time_step=jnp.sort(jnp.asarray(rng.integers(0, 19, (B, K)), jnp.int32), axis=1),
        state_mask=jnp.ones((B, K), bool),
        mask=jnp.ones((B, K), bool),
        bootstrap_mask=jnp.asarray(known | (discount == 0)),
        weight=jnp.ones(B).at[4].set(0.0),
        following=States(
            obs=number(B, K, 2),
            return_so_far=number(B, K),
            return_to_go=number(B, K),
            time_step=jnp.asarray(rng.integers(0, 19, (B, K)), jnp.int32),
            mask=jnp.asarray(known),
        ),
    )


@pytest.mark.parametrize(
    "conditioning",
    [
        "decremented",
        pytest.param("hindsight", marks=pytest.mark.slow),
        pytest.param("commanded", marks=pytest.mark.slow),
    ],
)
def test_scattered_windows_take_two_passes(conditioning):
    fields = {"context_length": K, "window": "scattered", "prefill_env_steps": 80}
    if conditioning != "commanded":
        fields |= {"return_conditioning": "hindsight", "hindsight_scale": 500.0}
    if conditioning == "decremented":
        fields["next_rtg_decrement"] = 0.25
    config, spec = point_config(**fields).validated(), point_env(1).spec
    agent, hyper = agents.make(config, spec), hyperparameters(config, 1)
    learner = jax.jit(agent.init)(jax.random.key(0))
    window, key = make_scattered(2), jax.random.key(9)
    new, _ = jax.jit(agent.update)(learner, hyper, window, key)
    after = window.following
    shown, next_shown = {
        "hindsight": (window.return_to_go / 500.0, after.return_to_go / 500.0),
        "decremented": (window.return_to_go / 500.0, window.return_to_go / 500.0 - 0.25),
        "commanded": (-window.return_so_far / 10.0, -after.return_so_far / 10.0),
    }[conditioning]
    actor = networks(config, spec)[0]

    @jax.jit
    def reference(learner):
        def now(params):
            return actor(
                params, window.obs, window.action, shown, window.time_step, window.state_mask
            )

        def following(params):
            return actor(params, after.obs, window.action, next_shown, after.time_step, after.mask)

        return reference_update(
            config, spec, learner, hyper, window, key, (now, following), window.obs, after.obs
        )

    check_update(new, learner, hyper, reference(learner))


def test_a_deterministic_policy_has_no_entropy():
    """Its loss is Q alone, whatever α; targets and loss see the action with bounded noise."""
    config = point_config(context_length=K, policy="deterministic", tune_alpha=False, alpha=5.0)
    spec = point_env(1).spec
    agent, hyper = agents.make(config.validated(), spec), hyperparameters(config, 1)
    learner = jax.jit(agent.init)(jax.random.key(0))
    window, key = make_window(), jax.random.key(7)
    new, metrics = jax.jit(agent.update)(learner, hyper, window, key)
    gaussian = shown(config, spec, learner, window)
    _, next_key, action_key = jax.random.split(key, 3)

    def noisy(mean, key):
        noise = np.clip(0.1 * np.asarray(jax.random.normal(key, mean.shape)), -0.25, 0.25)
        return np.clip(np.tanh(mean) + noise, -1, 1)

    def mean_over(values, mask):
        weight = np.asarray(window.weight)[:, None] * mask
        return float((values * weight).sum() / weight.sum())

    obs = np.asarray(window.obs)
    next_q = numpy_q(
        learner.target_critic_params, obs[:, 1:], noisy(gaussian.mean[:, 1:], next_key)
    )
    y = window.reward + 0.99 * window.discount * next_q.min(0)
    q = numpy_q(learner.critic_params, obs[:, :-1], window.action)
    expected = mean_over(((q - y) ** 2).sum(0), window.bootstrap_mask)
    assert float(metrics["critic_loss"]) == pytest.approx(expected, rel=1e-4)
    assert float(metrics["entropy"]) == 0.0
    # The critics have moved before the actor looks at them.
    q = numpy_q(new.critic_params, obs[:, :-1], noisy(gaussian.mean[:, :-1], action_key))
    expected = mean_over(-q.min(0), window.mask)
    assert float(metrics["actor_loss"]) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("conditioning", ["hindsight", "none"])
def test_conditioning_decides_what_the_actor_is_shown(setup, conditioning):
    config, spec, _, learner, hyper = setup
    config = config.replace(return_conditioning=conditioning, prefill_env_steps=4 * 20)
    update = jax.jit(agents.make(config, spec).update)
    window, key = make_window(), jax.random.key(2)

    def entropy(**changes):
        return float(
            update(learner, hyper, dataclasses.replace(window, **changes), key)[1]["entropy"]
        )

    base = entropy()
    assert entropy(return_so_far=window.return_so_far + 3.0) == base
    shows_return = conditioning == "hindsight"
    assert (entropy(return_to_go=window.return_to_go + 3.0) != base) == shows_return

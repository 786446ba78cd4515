"""The critics against NumPy, and what each candidate action may see."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gpt2 import dense, gpt2_block, layer_norm, randomized

from sacformer_jax.config import CriticConfig
from sacformer_jax.critics import (
    CriticInputs,
    candidate_mask,
    make_critics,
    mlp_critics,
    transformer_critics,
    with_history,
)
from sacformer_jax.transformer import TransformerConfig

OBS, ACT, K, BATCH, MAX_TIME = 5, 3, 4, 3, 30


def make_inputs(seed=0) -> CriticInputs:
    rng = np.random.default_rng(seed)
    mask = np.ones((BATCH, K + 1), bool)
    mask[1, :2] = False  # a window before an episode's start
    mask[2, -1:] = False  # past its end
    obs = rng.normal(size=(BATCH, K + 1, OBS)).astype(np.float32)
    return CriticInputs(
        obs=obs[:, :-1],
        next_obs=obs[:, 1:],
        action=rng.uniform(-1, 1, (BATCH, K, ACT)).astype(np.float32),
        time_step=rng.integers(0, MAX_TIME, (BATCH, K + 1)).astype(np.int32),
        state_mask=mask,
    )


def make_candidate(seed=5):
    return np.random.default_rng(seed).uniform(-1, 1, (BATCH, K, ACT)).astype(np.float32)


def transformer(layers=2, heads=2):
    config = TransformerConfig(layers, 16, heads, 4, 0.0, "relu")
    return transformer_critics(config, K, MAX_TIME)


# --- the MLP -------------------------------------------------------------------------------------


def test_mlp_critics_are_two_mlps():
    critics, inputs, candidate = mlp_critics((8, 8), "relu", False), make_inputs(), make_candidate()
    params = jax.jit(critics.init)(jax.random.key(0), inputs)
    for judge, obs in (
        (critics.now, inputs.obs),
        (critics.following, inputs.next_obs),
    ):
        q = jax.jit(judge)(params, inputs, candidate)
        assert q.shape == (2, BATCH, K)
        assert not np.allclose(q[0], q[1])
        for i in range(2):
            p = jax.tree.map(lambda x, i=i: np.asarray(x[i], np.float64), params["params"])
            x = np.concatenate([obs, candidate], axis=-1)
            for layer in ("dense_0", "dense_1"):
                x = np.maximum(dense(x, p["mlp"][layer]), 0.0)
            np.testing.assert_allclose(q[i], dense(x, p["q"])[..., 0], rtol=1e-4, atol=1e-5)


def test_history_by_hand():
    """States 10, 20, 30, 40 with the actions 1, 2, 3 between them; the first is of no episode."""
    obs = jnp.array([[[10.0], [20.0], [30.0], [40.0]]])
    inputs = CriticInputs(
        obs=obs[:, :-1],
        next_obs=obs[:, 1:],
        action=jnp.array([[[1.0], [2.0], [3.0]]]),
        time_step=jnp.array([[0, 0, 1, 2]]),
        state_mask=jnp.array([[False, True, True, True]]),
    )
    seen = with_history(inputs, 3)
    assert seen[0, 1:].tolist() == [[20, 0, 0, 0, 0], [30, 20, 2, 0, 0], [40, 30, 3, 20, 2]]
    np.testing.assert_array_equal(with_history(inputs, 1), obs)


def test_critics_with_history_are_mlps_on_it_and_do_not_judge_the_burn_in():
    inputs, candidate, burn_in = make_inputs(), make_candidate(), 2
    critics = mlp_critics((8, 8), "relu", False, history=3, burn_in=burn_in)
    params = randomized(jax.jit(critics.init)(jax.random.key(0), inputs))
    plain = mlp_critics((8, 8), "relu", False)
    seen = with_history(inputs, 3)
    for judge, states in ((critics.now, seen[:, :-1]), (critics.following, seen[:, 1:])):
        q = jax.jit(judge)(params, inputs, candidate)
        # The same MLP on what is seen, as if that were the observation.
        expected = plain.now(params, dataclasses.replace(inputs, obs=states), candidate)
        np.testing.assert_allclose(q[..., burn_in:], expected[..., burn_in:], rtol=1e-5, atol=1e-6)
        assert q.shape == expected.shape
        assert not q[..., :burn_in].any()


# --- the transformer -----------------------------------------------------------------------------


def may_see(query, key, real, band):
    """The rule, token by token: ``(step, kind)`` of query and key; ``real [T]``."""
    (i, kind_i), (j, kind_j) = query, key
    if kind_j == "candidate":
        return query == key
    if j != i and not (real[j] and 0 < i - j < band):
        return False
    if kind_j == "action" and kind_i != "action":
        return j < i  # what was done at a step is not known to its state, nor to its candidate
    return True


def allowed_tokens(real, band):
    tokens = [(t, kind) for t in range(len(real)) for kind in ("state", "action", "candidate")]
    return np.array([[may_see(q, k, real, band) for k in tokens] for q in tokens])


@pytest.mark.parametrize("band", [1, 2, K, K + 3])
def test_the_mask_is_the_rule(band):
    state_mask = make_inputs().state_mask
    mask = candidate_mask(jnp.asarray(state_mask), band)
    for b in range(BATCH):
        np.testing.assert_array_equal(mask[b], allowed_tokens(state_mask[b], band))


def oracle(params, obs, action, candidate, time_step, real, layers, heads):
    """One window, one critic, in NumPy: Q ``[T]``."""
    time = params["embed_time"]["embedding"][time_step]
    states = len(time)
    x = np.empty((3 * states, time.shape[1]))
    x[0::3] = dense(obs.astype(float), params["embed_state"]) + time
    x[1::3] = dense(action.astype(float), params["embed_action"]) + time
    x[2::3] = dense(candidate.astype(float), params["embed_candidate"]) + time
    x = layer_norm(x, params["ln_embed"])
    for layer in range(layers):
        x = gpt2_block(x, params["trunk"][f"block_{layer}"], heads, allowed_tokens(real, K))
    return dense(layer_norm(x, params["trunk"]["ln_f"])[2::3], params["q"])[:, 0]


@pytest.mark.parametrize(("layers", "heads"), [(1, 1), (2, 4)])
def test_transformer_critics_equal_numpy(layers, heads):
    critics, inputs, candidate = transformer(layers, heads), make_inputs(), make_candidate()
    params = randomized(jax.jit(critics.init)(jax.random.key(0), inputs))
    now = jax.jit(critics.now)(params, inputs, candidate)
    following = jax.jit(critics.following)(params, inputs, candidate)
    assert now.shape == following.shape == (2, BATCH, K)
    for i in range(2):
        p = jax.tree.map(lambda x, i=i: np.asarray(x[i], np.float64), params["params"])
        for b in range(BATCH):
            time, real = inputs.time_step[b], inputs.state_mask[b]
            arguments = (inputs.obs[b], inputs.action[b], candidate[b], time[:K], real[:K])
            np.testing.assert_allclose(
                now[i, b], oracle(p, *arguments, layers, heads), rtol=1e-5, atol=1e-5
            )
            nothing = np.full((1, ACT), 9.0)  # whatever is put there, nobody sees it
            arguments = (
                np.concatenate([inputs.obs[b], inputs.next_obs[b, -1:]]),
                np.concatenate([inputs.action[b], nothing]),
                np.concatenate([nothing, candidate[b]]),
                time,
                real,
            )
            np.testing.assert_allclose(
                following[i, b], oracle(p, *arguments, layers, heads)[1:], rtol=1e-5, atol=1e-5
            )


def test_a_candidate_is_judged_by_what_came_before_it_and_itself_alone():
    critics, inputs, candidate = transformer(), make_inputs(), make_candidate()
    inputs = dataclasses.replace(inputs, state_mask=np.ones_like(inputs.state_mask))
    params = randomized(jax.jit(critics.init)(jax.random.key(0), inputs))
    now = jax.jit(critics.now)
    before = np.asarray(now(params, inputs, candidate))

    def differs(**changes):
        """``[K]``: whether the Q at each step changes with these inputs."""
        changed_candidate = changes.pop("candidate", candidate)
        after = np.asarray(now(params, dataclasses.replace(inputs, **changes), changed_candidate))
        same = (after == before).all(axis=(0, 1))
        return ~same

    steps = np.arange(K)
    for t in range(K):

        def moved(values, t=t):
            values = np.array(values)
            values[:, t] += 0.7
            return values

        np.testing.assert_array_equal(differs(candidate=moved(candidate)), steps == t)
        np.testing.assert_array_equal(differs(action=moved(inputs.action)), steps > t)
        np.testing.assert_array_equal(differs(obs=moved(inputs.obs)), steps >= t)
    # All candidates in one pass, or one at a time, makes no difference.
    for t in range(K):
        alone = np.zeros_like(candidate)
        alone[:, t] = candidate[:, t]
        np.testing.assert_array_equal(now(params, inputs, alone)[..., t], before[..., t])


@pytest.mark.parametrize("name", ["mlp", "transformer"])
def test_bfloat16_is_close_with_parameters_in_float32(name):
    inputs, candidate = make_inputs(), make_candidate()
    config = CriticConfig(critic=name, critic_width=32, critic_layers=2)
    exact, rounded = (make_critics(config, d, K, MAX_TIME) for d in ("float32", "bfloat16"))
    params = jax.jit(rounded.init)(jax.random.key(0), inputs)
    assert {leaf.dtype for leaf in jax.tree.leaves(params)} == {jnp.dtype("float32")}
    q, q_rounded = (jax.jit(c.now)(params, inputs, candidate) for c in (exact, rounded))
    assert q_rounded.dtype == jnp.float32
    difference = np.abs(q - q_rounded).max()
    assert 1e-6 < difference < 0.05 * np.abs(q).max()


def test_the_configuration_decides():
    inputs = make_inputs()
    for name, key in (("mlp", "mlp"), ("transformer", "trunk")):
        config = CriticConfig(critic=name, critic_width=8, critic_heads=2, critic_layers=1)
        params = make_critics(config, "float32", K, MAX_TIME).init(jax.random.key(0), inputs)[
            "params"
        ]
        assert key in params
        first, second = (jax.tree.map(lambda x, i=i: x[i], params["q"]) for i in (0, 1))
        assert not np.allclose(first["kernel"], second["kernel"])

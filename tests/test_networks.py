"""The actor against a NumPy forward pass of a GPT-2 decision transformer, and what it may see."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gpt2 import dense, gaussian_of, gpt2_block, layer_norm, randomized

from sacformer_jax.networks import TransformerActor
from sacformer_jax.transformer import TransformerConfig, banded_causal_mask

OBS, ACT, K, BATCH, MAX_TIME = 5, 3, 4, 3, 30


def make_actor(
    layers=3, width=16, heads=1, dropout=0.1, context_length=K, tokens="gs", state_path=None,
    time="absolute",
):  # fmt: skip
    config = TransformerConfig(layers, width, heads, 4, dropout, "relu", rotary=time == "rotary")
    max_time = MAX_TIME if time == "absolute" else None
    return TransformerActor(config, ACT, context_length, max_time, 1.0, tokens, state_path)


def make_inputs(states=K, seed=0):
    rng = np.random.default_rng(seed)
    mask = np.ones((BATCH, states), bool)
    mask[1, :2] = False  # left-padded, as in acting
    mask[2, -1:] = False  # padded at the end, as a window past an episode's end
    return {
        "obs": rng.normal(size=(BATCH, states, OBS)).astype(np.float32),
        "action": rng.uniform(-1, 1, (BATCH, states, ACT)).astype(np.float32),
        "return_to_go": rng.normal(size=(BATCH, states)).astype(np.float32),
        "time_step": rng.integers(0, MAX_TIME, (BATCH, states)).astype(np.int32),
        "state_mask": mask,
    }


# --- the oracle: plain NumPy in float64 ------------------------------------------------------


def oracle(params, inputs, layers, heads, band, tokens="gs", rotary=False):
    params = jax.tree.map(lambda x: np.asarray(x, np.float64), params["params"])
    means, log_stds = [], []
    for b in range(BATCH):
        steps = inputs["time_step"][b]
        time = params["embed_time"]["embedding"][steps] if "embed_time" in params else 0.0
        states, n = len(steps), 1 if tokens == "joint" else len(tokens)
        if tokens == "joint":
            before = np.zeros((states, ACT))
            for t in range(1, states):
                before[t] = inputs["action"][b, t - 1] * inputs["state_mask"][b, t - 1]
            known = [inputs["return_to_go"][b][:, None], inputs["obs"][b], before]
            x = dense(np.concatenate(known, axis=1).astype(float), params["embed_joint"]) + time
        else:
            x = np.empty((n * states, params["trunk"]["ln_f"]["scale"].shape[0]))
            x[0::n] = dense(
                inputs["return_to_go"][b][:, None].astype(float), params["embed_return"]
            )
            x[1::n] = dense(inputs["obs"][b].astype(float), params["embed_state"])
            if tokens == "gsa":
                x[2::n] = dense(inputs["action"][b].astype(float), params["embed_action"])
            x += np.repeat(np.broadcast_to(time, (states, x.shape[1])), n, axis=0)
        x = layer_norm(x, params["ln_embed"])
        allowed = np.zeros((n * states, n * states), bool)
        for i in range(n * states):
            for j in range(i + 1):
                same_step = i // n == j // n
                in_band = i // n - j // n < band
                allowed[i, j] = in_band and (same_step or inputs["state_mask"][b, j // n])
        for layer in range(layers):
            block, when = params["trunk"][f"block_{layer}"], np.repeat(steps, n)
            x = gpt2_block(x, block, heads, allowed, when if rotary else None)
        x = layer_norm(x, params["trunk"]["ln_f"])[min(1, n - 1) :: n]
        if "state_path" in params:
            by_state = inputs["obs"][b].astype(float)
            for name in ("dense_0", "dense_1"):
                by_state = np.maximum(dense(by_state, params["state_path"][name]), 0.0)
            x = by_state + dense(x, params["from_trunk"])
        means.append(dense(x, params["heads"]["mean"]))
        log_stds.append(np.clip(dense(x, params["heads"]["log_std"]), -20.0, 2.0))
    return np.stack(means), np.stack(log_stds)


@pytest.mark.parametrize(
    ("layers", "heads", "states", "tokens", "state_path", "time"),
    [
        (3, 1, K, "gs", None, "absolute"),
        (2, 2, K, "gs", None, "none"),
        (3, 1, K + 1, "gsa", None, "absolute"),
        (1, 2, K, "gsa", (12, 10), "absolute"),
        (2, 2, K + 1, "gsa", None, "rotary"),
        (2, 2, K + 1, "joint", None, "absolute"),
        (1, 2, K, "joint", (12, 10), "rotary"),
    ],
)
def test_actor_equals_the_numpy_decision_transformer(
    layers, heads, states, tokens, state_path, time
):
    actor = make_actor(layers=layers, heads=heads, tokens=tokens, state_path=state_path, time=time)
    inputs = make_inputs(states)
    params = randomized(jax.jit(actor.init)(jax.random.key(0), **inputs))
    out = jax.jit(gaussian_of(actor))(params, **inputs)
    mean, log_std = oracle(params, inputs, layers, heads, K, tokens, time == "rotary")
    real = inputs["state_mask"]
    np.testing.assert_allclose(out.mean[real], mean[real], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(out.log_std[real], log_std[real], rtol=1e-5, atol=1e-5)
    assert np.isfinite(out.mean).all()  # padding too
    assert (log_std[real] < 2.0).any()  # the clip is not all there is


@pytest.fixture(scope="module", params=["gs", "gsa", "joint"])
def trained(request):
    """A one-block actor, where the band is the whole receptive field."""
    actor = make_actor(layers=1, tokens=request.param)
    inputs = make_inputs(K + 2)
    inputs["state_mask"][:] = True
    params = randomized(jax.jit(actor.init)(jax.random.key(0), **inputs))
    return jax.jit(gaussian_of(actor)), params, inputs


def test_step_t_does_not_depend_on_later_steps(trained):
    apply, params, inputs = trained
    before = apply(params, **inputs)
    for t in range(K + 1):
        changed = {name: np.array(value) for name, value in inputs.items()}
        changed["action"][:, t:] += 1.0
        changed["obs"][:, t + 1 :] += 3.0
        changed["return_to_go"][:, t + 1 :] -= 2.0
        changed["time_step"][:, t + 1 :] = 7
        after = apply(params, **changed)
        np.testing.assert_array_equal(after.mean[:, : t + 1], before.mean[:, : t + 1])
        assert not np.allclose(after.mean[:, t + 1], before.mean[:, t + 1])


def test_actions_are_seen_from_the_next_step_on_if_at_all(trained):
    apply, params, inputs = trained
    before = apply(params, **inputs).mean
    # The joint token of the oldest state in sight holds the action before it, too.
    joint = "embed_joint" in params["params"]
    seen, last = joint or "embed_action" in params["params"], K + joint
    for t in range(K + 2):
        action = inputs["action"].copy()
        action[:, t] += 1.0
        after = apply(params, **{**inputs, "action": action}).mean
        differs = (np.asarray(after) != np.asarray(before)).any(axis=(0, 2))
        steps = np.arange(K + 2)
        np.testing.assert_array_equal(differs, seen & (steps > t) & (steps < t + last))


@pytest.mark.parametrize("tokens", ["gs", "gsa", "joint"])
def test_bfloat16_is_close_and_keeps_its_parameters_in_float32(tokens):
    inputs = make_inputs()
    actors = [make_actor(tokens=tokens), make_actor(tokens=tokens)]
    config = dataclasses.replace(actors[1].config, dtype="bfloat16")
    actors[1] = actors[1].clone(config=config)
    params = jax.jit(actors[1].init)(jax.random.key(0), **inputs)
    assert {leaf.dtype for leaf in jax.tree.leaves(params)} == {jnp.dtype("float32")}
    exact, rounded = (jax.jit(gaussian_of(actor))(params, **inputs) for actor in actors)
    assert rounded.mean.dtype == jnp.float32
    real = inputs["state_mask"]
    difference = np.abs(rounded.mean - exact.mean)[real].max()
    assert 1e-5 < difference < 0.03 * np.abs(exact.mean[real]).max()


def test_masked_steps_do_not_matter(trained):
    apply, params, inputs = trained
    masked = {name: np.array(value) for name, value in inputs.items()}
    masked["state_mask"][:, 1] = False
    before = apply(params, **masked)
    masked["obs"][:, 1] = 1e3
    masked["action"][:, 1] = 1e3
    masked["return_to_go"][:, 1] = -1e3
    masked["time_step"][:, 1] = 0
    after = apply(params, **masked)
    others = [0, 2, 3, 4, 5]
    np.testing.assert_array_equal(after.mean[:, others], before.mean[:, others])
    assert not np.allclose(before.mean[:, 2], apply(params, **inputs).mean[:, 2])


def test_no_more_than_k_pairs_are_seen(trained):
    apply, params, inputs = trained
    before = apply(params, **inputs)
    changed = {name: np.array(value) for name, value in inputs.items()}
    changed["obs"][:, 0] += 5.0
    after = apply(params, **changed)
    np.testing.assert_array_equal(after.mean[:, K:], before.mean[:, K:])
    assert not np.allclose(after.mean[:, K - 1], before.mean[:, K - 1])


def test_the_action_depends_on_the_return_and_the_time_step(trained):
    apply, params, inputs = trained
    before = apply(params, **inputs)
    for name in ("return_to_go", "time_step"):
        changed = {**inputs, name: inputs[name] + np.ones_like(inputs[name])}
        assert not np.allclose(apply(params, **changed).mean, before.mean)


def test_left_padding_equals_a_shorter_sequence(trained):
    apply, params, inputs = trained
    short = {name: value[:, 2:] for name, value in inputs.items()}
    padded = {name: np.array(value) for name, value in inputs.items()}
    padded["state_mask"][:, :2] = False
    np.testing.assert_allclose(
        apply(params, **padded).mean[:, 2:], apply(params, **short).mean, rtol=1e-5, atol=1e-6
    )


def test_banded_causal_mask_by_hand():
    mask = banded_causal_mask(jnp.array([[False, True, True, True]]), band=2)
    assert mask[0].astype(int).tolist() == [
        [1, 0, 0, 0],  # not real, but attends to itself
        [0, 1, 0, 0],
        [0, 1, 1, 0],
        [0, 0, 1, 1],
    ]


def test_dropout_is_on_only_where_asked_for():
    actor = make_actor(dropout=0.5)
    inputs = make_inputs()
    params = jax.jit(actor.init)(jax.random.key(0), **inputs)
    apply = jax.jit(gaussian_of(actor), static_argnames="deterministic")

    def mean(key):
        return apply(params, **inputs, deterministic=False, rngs={"dropout": key}).mean

    assert not np.allclose(mean(jax.random.key(0)), mean(jax.random.key(1)))
    np.testing.assert_array_equal(mean(jax.random.key(0)), mean(jax.random.key(0)))


@pytest.mark.parametrize(
    ("tokens", "time"), [("gs", "absolute"), ("gsa", "rotary"), ("joint", "rotary")]
)
def test_a_state_with_a_past_is_as_in_one_pass(tokens, time):
    actor = make_actor(heads=2, tokens=tokens, time=time)
    inputs = make_inputs(K + 1)
    params = randomized(jax.jit(actor.init)(jax.random.key(0), **inputs))
    together = jax.jit(gaussian_of(actor))(params, **inputs)

    @jax.jit
    def apart(params):
        first = {name: value[:, :K] for name, value in inputs.items()}
        last = {name: value[:, K:] for name, value in inputs.items()}
        before = actor.apply(params, **first)
        last |= {name: inputs[name] for name in ("state_mask", "action")}
        return before.gaussian, actor.apply(params, **last, past=before.seen).gaussian

    before, after = apart(params)
    for name in ("mean", "log_std"):
        parts = np.concatenate([getattr(before, name), getattr(after, name)], axis=1)
        np.testing.assert_allclose(parts, getattr(together, name), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("tokens", ["gs", "gsa", "joint"])
def test_states_that_nothing_is_asked_of_are_seen_all_the_same(tokens):
    actor = make_actor(tokens=tokens, heads=2, state_path=(12, 12)).clone(predicts=2)
    inputs = make_inputs(K + 1)
    params = randomized(jax.jit(actor.init)(jax.random.key(0), **inputs))
    asked = jax.jit(actor.apply)(params, **inputs)
    some = jax.jit(functools.partial(actor.apply, skip=2))(params, **inputs)
    said = [(output.gaussian, output.features, output.prediction) for output in (some, asked)]
    for one, every in zip(*map(jax.tree.leaves, said), strict=True):
        np.testing.assert_allclose(one[:, 2:], every[:, 2:], rtol=1e-5, atol=1e-5)
        assert not one[:, :2].any()
        assert every[:, :2].any()
    # What comes after may still look at all of them.
    for one, every in zip(*map(jax.tree.leaves, (some.seen, asked.seen)), strict=True):
        np.testing.assert_allclose(one, every, rtol=1e-5, atol=1e-5)


def test_with_a_path_around_it_the_trunk_starts_with_nothing_to_say_and_learns():
    actor = make_actor(layers=1, state_path=(12, 12))
    inputs = make_inputs()
    inputs["state_mask"][:] = True
    params = jax.jit(actor.init)(jax.random.key(0), **inputs)
    apply = jax.jit(gaussian_of(actor))
    other_past = {name: np.array(value) for name, value in inputs.items()}
    other_past["obs"][:, :-1] += 1.0
    other_past["return_to_go"] += 1.0
    other_past["time_step"][:] = 7
    before = apply(params, **inputs)
    np.testing.assert_array_equal(apply(params, **other_past).mean[:, -1], before.mean[:, -1])
    assert not np.allclose(apply(params, **other_past).mean[:, 0], before.mean[:, 0])

    @jax.jit
    def gradient(params):
        return jax.grad(lambda p: apply(p, **inputs).mean.sum())(params)["params"]

    # At first only the layer from the trunk learns of its part, then the trunk does, too.
    first = gradient(params)
    assert np.any(first["from_trunk"]["kernel"])
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(first["trunk"]))
    params["params"]["from_trunk"]["kernel"] += 0.1 * first["from_trunk"]["kernel"]
    assert all(np.any(leaf) for leaf in jax.tree.leaves(gradient(params)["embed_state"]))


@pytest.mark.parametrize("time", ["absolute", "rotary", "none"])
def test_what_counts_of_the_time(time):
    actor = make_actor(layers=1, time=time)
    inputs = make_inputs()
    inputs["state_mask"][:] = True
    params = randomized(jax.jit(actor.init)(jax.random.key(0), **inputs))
    apply = jax.jit(gaussian_of(actor))
    before = apply(params, **inputs).mean
    later = apply(params, **{**inputs, "time_step": inputs["time_step"] + 7}).mean
    wider = apply(params, **{**inputs, "time_step": 2 * inputs["time_step"]}).mean
    assert np.allclose(later, before, atol=1e-5) == (time != "absolute")
    assert np.allclose(wider, before, atol=1e-5) == (time == "none")

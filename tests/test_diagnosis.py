"""What is said of a trained run's networks, against numbers by hand, NumPy and the agents."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from functools import partial
from pathlib import Path
from typing import Any

import diagnose
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from diagnosis.gradients import by_group, make_gradients, update_of
from diagnosis.history import Change, _without_time, acting_agent
from diagnosis.networks import activations, inputs_of, representation_numbers
from diagnosis.numbers import (
    dormant_share,
    effective_rank,
    num_known,
    percentiles,
    share_outside,
    signal,
    soft_returns,
    value_bias,
)
from diagnosis.picture import KINDS
from diagnosis.subject import Subject, contexts_of, full_windows, make_tools, subjects
from diagnosis.values import Episodes, judged, make_judge, make_sampler
from diagnosis.window import window_numbers
from PIL import Image
from probe import EPISODE, point_config, point_env
from untrained import untrained_config

from sacformer_jax import Config, evaluate, make_population, make_program
from sacformer_jax.agents import sac_policy
from sacformer_jax.agents.core import Agent
from sacformer_jax.checkpoint import CheckpointWriter, Progress, RunFolder
from sacformer_jax.critics import Critics
from sacformer_jax.envs import EnvSpec
from sacformer_jax.members import seed_members
from sacformer_jax.networks import STEP_TOKENS, GaussianParams
from sacformer_jax.runner import sources_of, train
from sacformer_jax.train import policy_of
from sacformer_jax.types import Acted, Context, PolicyState, TrainState

SAC = {
    "agent": "sac", "context_length": 1, "return_conditioning": "none", "actor_layers": 2,
    "acting_context": "window",
}  # fmt: skip


POINT = {"env": "probe:PointEnv", "discount": 0.5, "batch_size": 8, "critic_width": 16}


def moved(tree: Any, seed: int) -> Any:
    """Far from where it starts."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(
        lambda leaf: leaf + jnp.asarray(rng.normal(scale=0.2, size=leaf.shape), leaf.dtype), tree
    )


def not_as_it_starts(state: TrainState) -> TrainState:
    """With another actor, and Adam in the middle of something."""
    learner = state.learner
    opt = learner.actor_opt._replace(mu=moved(learner.actor_opt.mu, 1))
    learner = dataclasses.replace(
        learner, actor_params=moved(learner.actor_params, 0), actor_opt=opt
    )
    return dataclasses.replace(state, learner=learner)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint of two members of SACFormer on the point task, after prefill."""
    folder = RunFolder(tmp_path_factory.mktemp("diagnosis") / "point")
    config = point_config(
        context_length=3, normalize_obs=True, target_return=40.0, tokens="gsa", seeds=(3, 5),
        **POINT,
    )  # fmt: skip
    population = make_population(config, seed_members(config.all_seeds))
    folder.create(config, sources_of(config), population.program.env.spec, population.members)
    state, _ = population.prefill(population.init())
    state = not_as_it_starts(state)
    with CheckpointWriter(folder, config, population.block_axes) as writer:
        writer.save(state, policy_of(state), Progress(200, (None, None), (0, 0)))
    return folder.path


@pytest.fixture(scope="module")
def sacformer(run: Path) -> Subject:
    return next(subjects(run))


@pytest.fixture(scope="module")
def sac() -> Subject:
    program = make_program(point_config(**SAC, **POINT), point_env(4))
    state, _ = program.prefill(program.init(jax.random.key(0)))
    return Subject("seed-0", make_tools(program), not_as_it_starts(state))


# --- numbers -------------------------------------------------------------------------------------


def test_signal_by_hand() -> None:
    found = signal(np.array([[1.0, 0.0, 2.0], [3.0, 0.0, 4.0]]))
    # Mean (2, 0, 3); both deviate by (1, 0, 1).
    assert found.norm == pytest.approx(math.sqrt(13.0))
    assert found.snr == pytest.approx(13.0 / 2.0)
    assert signal(np.ones((3, 2))).snr == math.inf
    assert math.isnan(signal(np.zeros((3, 2))).snr)


def test_signal_of_noise_is_one_over_one_less_than_the_batches() -> None:
    noise = np.random.default_rng(0).normal(size=(32, 50_000))
    assert signal(noise).snr == pytest.approx(1 / 31, rel=0.03)
    # A signal of the same size as the noise is added to that.
    assert signal(noise + 1.0).snr == pytest.approx((1 + 1 / 32) / (31 / 32), rel=0.03)


@pytest.mark.parametrize(
    ("values", "rank"),
    [([98.5, 1.0, 0.5], 2), ([99.0, 0.6, 0.4], 1), ([1.0, 1.0, 1.0], 3), ([0.0, 0.0, 0.0], 0)],
)
def test_effective_rank_of_known_singular_values(values: list[float], rank: int) -> None:
    rng = np.random.default_rng(0)
    left, _ = np.linalg.qr(rng.normal(size=(20, 3)))
    right, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    assert effective_rank(left @ np.diag(values) @ right.T) == rank


def test_dormant_share_by_hand() -> None:
    # Means of |activation|: 2, 0, 0.04, 1.96; mean 1, so 0.025 is the threshold.
    layer = np.array([[4.0, 0.0, -0.08, 1.96], [0.0, 0.0, 0.0, -1.96]])
    assert dormant_share(layer) == 0.25
    assert dormant_share(layer, tau=0.05) == 0.5
    assert dormant_share(np.zeros((3, 5))) == 1.0


def test_soft_returns_by_hand_and_as_sums() -> None:
    # 4; 2 + 0.5 (4 + 0.1 x 3); 1 + 0.5 (4.15 + 0.1 x 2)
    by_hand = soft_returns(np.array([1.0, 2.0, 4.0]), np.array([-9.0, -2.0, -3.0]), 0.5, 0.1)
    np.testing.assert_allclose(by_hand, [3.175, 4.15, 4.0])
    rng = np.random.default_rng(0)
    reward, log_prob, discount, alpha = rng.normal(size=30), rng.normal(size=30), 0.9, 0.3
    for t, value in enumerate(soft_returns(reward, log_prob, discount, alpha)):
        powers = discount ** np.arange(30 - t)
        expected = powers @ reward[t:] - alpha * powers[1:] @ log_prob[t + 1 :]
        assert value == pytest.approx(expected)


def test_known_steps() -> None:
    # 0.5^5 is the first power below 0.05: the first three steps of eight have five or more to come.
    assert num_known(7, terminated=False, discount=0.5) == 3
    assert num_known(4, terminated=False, discount=0.5) == 0
    assert num_known(7, terminated=True, discount=0.5) == 7


def test_value_bias_by_hand() -> None:
    returns = np.array([1.0, 2.0, -3.0])
    found = value_bias(returns + np.array([1.0, 3.0, 2.0]), returns)
    assert found["mean"] == pytest.approx(1.0)  # 2 over 2
    assert found["std"] == pytest.approx(math.sqrt(2 / 3) / 2)
    assert value_bias(2 * returns, returns)["correlation"] == pytest.approx(1.0)
    assert math.isnan(value_bias(np.ones(3), returns)["correlation"])
    assert math.isnan(value_bias(np.zeros(0), np.zeros(0))["mean"])


def test_percentiles_and_the_share_outside() -> None:
    reference = np.arange(101.0)
    assert percentiles(reference) == {"p1": 1.0, "p50": 50.0, "p99": 99.0}
    assert share_outside(np.array([0.5, 1.0, 50.0, 99.0, 99.5]), reference) == 0.4


# --- gradients -----------------------------------------------------------------------------------


@pytest.mark.parametrize("agent", ["sac", pytest.param("sacformer", marks=pytest.mark.slow)])
def test_gradients_are_those_of_the_update(agent: str, request: pytest.FixtureRequest) -> None:
    subject: Subject = request.getfixturevalue(agent)
    state, key = subject.state, jax.random.key(3)
    gradients = make_gradients(update_of(subject))
    found = gradients(state, key)
    for network, name in ((found.actor, "actor"), (found.critics, "critic")):
        squares = sum(float(jnp.sum(leaf**2)) for leaf in jax.tree.leaves(network))
        said = float(found.metrics[f"{name}_grad_norm"])
        assert math.sqrt(squares) == pytest.approx(said, rel=1e-4)

    # Along the gradient itself, by differences of the losses the update reports.
    for gradient, params, loss in (
        (found.actor, "actor_params", "actor_loss"),
        (found.critics, "critic_params", "critic_loss"),
    ):
        squared = sum(float(jnp.sum(leaf**2)) for leaf in jax.tree.leaves(gradient))
        size = 1e-2 / math.sqrt(squared)
        losses = []
        for step in (-size, size):
            old = getattr(state.learner, params)
            moved = jax.tree.map(lambda p, g, step=step: p + step * g, old, gradient)
            learner = dataclasses.replace(state.learner, **{params: moved})
            moved_state = dataclasses.replace(state, learner=learner)
            losses.append(float(gradients(moved_state, key).metrics[loss]))
        assert (losses[1] - losses[0]) / (2 * size) == pytest.approx(squared, rel=0.03)


def test_groups_hold_each_parameter_once(sacformer: Subject) -> None:
    params = sacformer.state.learner.actor_params
    groups = by_group([params, jax.tree.map(jnp.zeros_like, params)])
    assert list(groups) == [
        "whole", "embed_action", "embed_return", "embed_state", "embed_time", "ln_embed", "block_0",
        "ln_f", "heads",
    ]  # fmt: skip
    total = sum(leaf.size for leaf in jax.tree.leaves(params))
    assert groups["whole"].shape == (2, total)
    assert sum(flat.shape[1] for name, flat in groups.items() if name != "whole") == total
    inner = params["params"]
    np.testing.assert_allclose(
        np.sort(groups["heads"][0]),
        np.sort(np.concatenate([np.ravel(x) for x in jax.tree.leaves(inner["heads"])])),
    )
    assert not groups["whole"][1].any()


# --- networks ------------------------------------------------------------------------------------


def outlook_of(subject: Subject, policy: PolicyState, contexts: Context) -> GaussianParams:
    parts = subject.tools.parts
    return sac_policy.acting_outlook(parts, policy, contexts, jax.random.key(0)).gaussian


def test_activations_of_mlps_equal_numpy(sac: Subject) -> None:
    parts, learner = sac.tools.parts, sac.state.learner
    windows = full_windows(sac, 8, seed=0)
    obs, action = windows.obs[:, :1], windows.action

    def forward(layers: Any, x: np.ndarray) -> list[np.ndarray]:
        outputs = []
        for name in ("dense_0", "dense_1"):
            x = np.maximum(x @ np.asarray(layers[name]["kernel"]) + layers[name]["bias"], 0.0)
            outputs.append(x)
        return outputs

    seen = activations(partial(outlook_of, sac), sac.policy, contexts_of(windows, 1))
    first, last = forward(learner.actor_params["params"]["mlp"], obs)
    assert list(seen.layers) == ["mlp_0", "mlp_1"]
    np.testing.assert_allclose(seen.layers["mlp_0"], first, atol=1e-5)
    np.testing.assert_allclose(seen.features, last, atol=1e-5)

    inputs = inputs_of(sac, windows)
    plain = parts.critics.now(learner.critic_params, inputs, inputs.action)
    seen = activations(parts.critics.now, learner.critic_params, inputs, inputs.action)
    np.testing.assert_allclose(seen.output, plain, atol=1e-6)
    for critic in range(2):
        params = jax.tree.map(lambda leaf, i=critic: leaf[i], learner.critic_params)["params"]
        first, last = forward(params["mlp"], np.concatenate([obs, action], axis=-1))
        np.testing.assert_allclose(seen.layers["mlp_0"][critic], first, atol=1e-5)
        np.testing.assert_allclose(seen.layers["mlp_1"][critic], last, atol=1e-5)
        np.testing.assert_allclose(seen.features[critic], last, atol=1e-5)


def test_features_of_a_transformer_are_what_its_heads_see(sacformer: Subject) -> None:
    contexts = contexts_of(full_windows(sacformer, 8, seed=0), 3)
    seen = activations(partial(outlook_of, sacformer), sacformer.policy, contexts)
    head = sacformer.state.learner.actor_params["params"]["heads"]["mean"]
    mean = seen.features[:, -1] @ np.asarray(head["kernel"]) + head["bias"]
    np.testing.assert_allclose(mean, seen.output.mean, atol=1e-5)
    assert list(seen.layers) == ["block_0"]
    assert seen.layers["block_0"].shape[-1] == 4 * 16
    assert np.all(seen.layers["block_0"] >= 0)


# --- values --------------------------------------------------------------------------------------


def test_sampled_episodes_are_of_the_environment_and_the_policy(sac: Subject) -> None:
    parts, policy = sac.tools.parts, sac.policy
    episodes = jax.device_get(make_sampler(point_env(3), parts)(policy, jax.random.key(5)))
    assert episodes.reward.shape == (EPISODE, 3)
    assert not episodes.done[:-1].any()
    assert episodes.done[-1].all()
    assert not episodes.terminated.any()
    x, v = episodes.obs[..., 0], episodes.obs[..., 1]
    np.testing.assert_allclose(x[1:], x[:-1] + 0.4 * v[:-1], atol=1e-5)
    np.testing.assert_allclose(v[1:], 0.8 * v[:-1] + 0.5 * episodes.action[:-1, :, 0], atol=1e-5)
    np.testing.assert_allclose(episodes.reward[:-1], -(x[1:] ** 2), atol=1e-5)
    # The density of tanh(u), u normal, at the actions taken.
    nothing = jnp.zeros(())
    output = parts.actor.apply(
        policy.actor_params, episodes.obs, nothing, nothing, nothing, nothing
    ).gaussian
    mean, std = (np.asarray(x, np.float64) for x in (output.mean, np.exp(output.log_std)))
    action = episodes.action.astype(np.float64)
    inside = np.abs(action[..., 0]) < 0.99
    assert inside.sum() > 20
    density = np.exp(-0.5 * ((np.arctanh(action) - mean) / std) ** 2) / (
        std * math.sqrt(2 * math.pi) * (1 - action**2)
    )
    np.testing.assert_allclose(
        np.exp(episodes.log_prob)[inside], density[..., 0][inside], rtol=2e-3
    )


def test_a_critic_of_known_bias(sac: Subject) -> None:
    """A reward of 1 at each step, for ever: at γ = 0.5 and without entropy it is worth 2."""
    constant = dataclasses.replace(
        sac.tools.parts,
        critics=Critics(
            init=lambda *_: None,
            now=lambda params, inputs, candidate: (
                params["q"][:, None, None] + jnp.zeros((2, *candidate.shape[:2]))
            ),
            following=lambda *_: jnp.zeros(()),
        ),
    )
    length, num = 20, 2
    shape = (length, num)
    done = np.zeros(shape, bool)
    done[-1, 0] = done[7, 1] = True
    episodes = Episodes(
        obs=np.zeros((*shape, 2), np.float32), action=np.zeros((*shape, 1), np.float32),
        log_prob=np.full(shape, -5.0, np.float32), reward=np.ones(shape, np.float32),
        terminated=np.zeros(shape, bool), done=done, bad=np.zeros(shape, bool),
        features=np.zeros((*shape, 0), np.float32),
    )  # fmt: skip
    learner = dataclasses.replace(
        sac.state.learner, critic_params={"q": jnp.array([5.0, 3.0])}, log_alpha=jnp.float32(-50.0)
    )
    judge = make_judge(constant, 1)
    steps = judged(learner, episodes, judge, discount=0.5)
    # 20 steps and 8, of which the last four are not known.
    np.testing.assert_allclose(
        steps.returns, [2 - 2 * 0.5**n for n in (*range(20, 4, -1), *range(8, 4, -1))], rtol=1e-6
    )
    np.testing.assert_allclose(steps.q, 3.0)
    assert steps.entropy == pytest.approx(5.0)
    assert value_bias(steps.q, steps.returns)["mean"] == pytest.approx(0.5, abs=0.03)
    # The bonus of each later step is α times 5: 0.25 more a step is half of it, discounted, in all.
    warm = dataclasses.replace(learner, log_alpha=jnp.log(jnp.float32(0.05)))
    bonus = judged(warm, episodes, judge, discount=0.5).returns[0] - steps.returns[0]
    assert bonus == pytest.approx(0.25 * (1 - 0.5**19), rel=1e-5)
    # What broke down, or came after the first episode, is not looked at.
    bad = episodes.replace(bad=episodes.bad | (np.arange(length)[:, None] == 9))
    assert len(judged(learner, bad, judge, discount=0.5).q) == 4


def test_steps_are_judged_at_the_end_of_windows_of_their_episode(sac: Subject) -> None:
    seen = {}

    def now(params: Any, inputs: Any, candidate: jax.Array) -> jax.Array:
        seen["inputs"], seen["candidate"] = inputs, candidate
        steps = jnp.where(inputs.state_mask[:, :-1], inputs.obs[..., 0], 0.0)
        q = jnp.cumsum(steps, axis=1) + 1_000.0 * candidate[..., 0] + inputs.time_step[:, :-1] / 8
        q += inputs.obs[..., 2]
        return jnp.stack([q, q + 1.0])

    nothing = Critics(init=lambda *_: None, now=now, following=lambda *_: jnp.zeros(()))
    parts = dataclasses.replace(sac.tools.parts, critics=nothing)
    obs = np.arange(1.0, 13.0, dtype=np.float32).reshape(6, 2)
    action = np.arange(6, dtype=np.float32)[:, None] / 10
    features = 100.0 * np.arange(6, dtype=np.float32)[:, None]
    found = make_judge(parts, 3)(sac.state.learner, obs, features, action)
    expected = [
        obs[max(0, t - 2) : t + 1, 0].sum() + 1_000 * action[t, 0] + t / 8 + 100 * t
        for t in range(6)
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    assert seen["inputs"].time_step.shape == (6, 4)


# --- what acting sees ----------------------------------------------------------------------------


def test_changes_of_what_acting_sees(sacformer: Subject) -> None:
    tools, policy = sacformer.tools, sacformer.policy
    agent, parts = tools.program.agent, tools.parts
    contexts = contexts_of(full_windows(sacformer, 16, seed=0), 3)

    @partial(jax.jit, static_argnums=0)
    def act(agent: Agent, policy: PolicyState, contexts: Context) -> Acted:
        return agent.act(policy, contexts, jax.random.key(0), explore=False)

    usual = act(agent, policy, contexts).action
    # As if the episode had begun with the newest pair, but for its time step and reward so far.
    alone = dataclasses.replace(contexts, mask=jnp.zeros_like(contexts.mask).at[:, -1].set(True))
    blind = act(acting_agent(agent, parts, newest_only=True), policy, contexts)
    np.testing.assert_allclose(blind.action, act(agent, policy, alone).action, atol=1e-6)
    assert np.abs(blind.action - usual).max() > 1e-4
    np.testing.assert_array_equal(blind.context.mask, contexts.mask)
    assert acting_agent(agent, parts, newest_only=False) is agent

    at_0 = dataclasses.replace(contexts, time_step=jnp.zeros_like(contexts.time_step))
    timeless = act(agent, _without_time(policy), contexts).action
    np.testing.assert_allclose(timeless, act(agent, policy, at_0).action, atol=1e-6)
    assert np.abs(timeless - usual).max() > 1e-4
    assert Change().policy(policy) is policy


def test_contexts_are_those_of_the_windows_ends(sacformer: Subject) -> None:
    windows = full_windows(sacformer, 40, seed=1)
    assert len(windows.obs) >= 40
    assert windows.state_mask[:, :3].all()
    contexts = contexts_of(windows, 2)
    np.testing.assert_array_equal(contexts.obs, windows.obs[:, 1:3])
    np.testing.assert_array_equal(contexts.action[:, 0], windows.action[:, 1])
    assert not contexts.action[:, 1].any()
    np.testing.assert_array_equal(contexts.time_step[:, 1], windows.time_step[:, 2])


def test_what_acting_does_not_compute_is_not_looked_at() -> None:
    program = make_program(
        point_config(context_length=3, prediction_weight=1.0, **POINT), point_env(4)
    )
    state, _ = program.prefill(program.init(jax.random.key(0)))
    foretelling = Subject("seed-0", make_tools(program), state)
    numbers = representation_numbers(foretelling, full_windows(foretelling, 16, seed=0))
    assert "dormant/actor/block_0" in numbers
    assert not any("prediction" in name for name in numbers)


def test_steps_of_windows_beside_acting(sacformer: Subject, sac: Subject) -> None:
    """Acting on windows of three, the last step of a window is as in acting, the others are not; of
    a policy that acts on the episode, none is.
    """
    episodes = jax.device_get(
        make_sampler(point_env(2), sacformer.tools.parts)(sacformer.policy, jax.random.key(5))
    )
    found = window_numbers(sacformer, episodes)
    assert found["window/feature_change/last_learnt"] < 1e-5
    assert found["window/action_change/last_learnt"] < 1e-5
    assert found["window/feature_change/first_learnt"] == found["window/feature_change/first"]
    assert found["window/feature_change/first"] > 0.01
    assert found["window/action_change/first"] > 1e-4
    assert window_numbers(sac, episodes) == {}
    short = episodes.replace(done=episodes.done | (np.arange(EPISODE)[:, None] == 4))
    assert window_numbers(sacformer, short) == {}  # no window begins three steps in
    whole = dataclasses.replace(
        sacformer.tools.program, config=sacformer.config.replace(acting_context="episode")
    )
    acts_on_it = dataclasses.replace(
        sacformer, tools=dataclasses.replace(sacformer.tools, program=whole)
    )
    found = window_numbers(acts_on_it, episodes)
    assert found["window/feature_change/last_learnt"] > 0.01
    assert found["window/feature_change/first"] > found["window/feature_change/last_learnt"]


# --- the script ----------------------------------------------------------------------------------

FEW = ["--batches", "3", "--episodes", "2", "--windows", "20"]
SECTIONS = {
    "env_steps", "updates", "batch", "gradient", "entropy", "alpha", "q_bias", "srank", "dormant",
    "attention", "return_tokens", "history", "window",
}  # fmt: skip


def sections_of(row: dict[str, Any]) -> set[str]:
    return {name.split("/")[0] for name in row} - {"run", "member"}


def test_every_kind_of_token_can_be_drawn() -> None:
    assert set(KINDS) == {name for step in STEP_TOKENS.values() for name in step.names}


def check_picture(path: Path) -> None:
    grey = np.asarray(Image.open(path).convert("L"))
    assert grey.shape[1] > 1_000
    assert 0.01 < (grey < 200).mean() < 0.5


@pytest.mark.slow
def test_the_script(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    to, picture = tmp_path / "numbers.json", tmp_path / "picture.png"
    assert diagnose.main([str(run), *FEW, "--json", str(to), "--picture", str(picture)]) == 0
    rows = json.loads(to.read_text())
    assert [row["member"] for row in rows] == ["seed-3", "seed-5", "mean"]
    first, second, mean = rows
    for row in rows:
        assert row["run"] == "point"
        assert sections_of(row) == SECTIONS
        assert all(math.isfinite(value) for value in row.values() if not isinstance(value, str))
    for name in ("gradient/actor/whole/snr", "q_bias/mean", "history/return/as_it_is"):
        assert first[name] != second[name]
        assert mean[name] == pytest.approx((first[name] + second[name]) / 2)
    changes = ("newest_pair", "time_step_0", "target_halved", "target_doubled")
    for name in changes:
        assert first[f"history/return/{name}"] != first["history/return/as_it_is"]
        assert first[f"history/action_change/{name}"] > 1e-5
    # Evaluation itself, of the same policy by the same seed.
    record = evaluate(run, episodes=2, policy="latest", seed=0, member=5)
    assert second["history/return/as_it_is"] == pytest.approx(record["return_mean"], rel=1e-5)
    # Mean tokens are those of 40 - (0 … minus what was lost), over 10: above 4, never below.
    assert first["return_tokens/training/p1"] >= 4.0
    own = [value for name, value in first.items() if re.match("attention/block_0/.*_back/", name)]
    assert len(own) == 9
    assert sum(own) == pytest.approx(1.0, abs=1e-5)
    own_step = sum(first[f"attention/block_0/0_back/{kind}"] for kind in ("return", "state"))
    assert first["attention/block_0/earlier"] == pytest.approx(1 - own_step, abs=1e-5)
    assert first["batch/windows"] == 8
    assert 8 <= first["batch/steps"] <= 24
    assert first["q_bias/steps"] == 2 * 16  # of 20 steps the last four are not known
    shown = capsys.readouterr().out
    assert "point" in shown
    assert "target halved" in shown
    check_picture(picture)


@pytest.mark.slow
def test_the_script_on_trained_runs_of_both_agents(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tiny = {
        "env": "Hopper", "num_envs": 2, "max_episode_steps": 40, "prefill_env_steps": 200,
        "chunk_env_steps": 20, "total_env_steps": 220, "eval_every": 10_000, "eval_episodes": 2,
        "checkpoint_every": 10_000, "actor_width": 8, "critic_width": 8, "batch_size": 4,
        "buffer_capacity": 400,
    }  # fmt: skip
    paths = []
    for agent, fields in (
        (
            "sacformer",
            {
                "actor_layers": 1,
                "actor_heads": 1,
                "acting_context": "episode",
                "critic_features": True,
            },
        ),
        ("sac", {"seeds": 2}),
    ):
        paths.append(str(tmp_path / agent))
        config = Config.from_preset("cpu", agent=agent, run_dir=paths[-1], **tiny, **fields)
        train(config, quiet=True)
    to, picture = tmp_path / "numbers.json", tmp_path / "picture.png"
    files = ["--json", str(to), "--picture", str(picture)]
    # What comes after them and cannot be diagnosed costs nothing that was measured.
    assert diagnose.main([*paths, str(tmp_path / "nothing"), *FEW, *files]) == 2
    assert "no config.json there" in capsys.readouterr().err
    rows = {(row["run"], row["member"]): row for row in json.loads(to.read_text())}
    assert [run for run, _ in rows] == ["sacformer"] * 2 + ["sac"] * 3
    assert sections_of(rows["sacformer", "mean"]) == SECTIONS
    sac = rows["sac", "seed-1"]
    assert sections_of(sac) == SECTIONS - {"attention", "return_tokens"}
    assert {name for name in sac if name.startswith("history/")} == {"history/return/as_it_is"}
    for run, member in (("sacformer", "seed-0"), ("sac", "seed-1")):
        record = evaluate(
            tmp_path / run, episodes=2, policy="latest", seed=0, member=member.split("-")[1]
        )
        found = rows[run, member]["history/return/as_it_is"]
        assert found == pytest.approx(record["return_mean"], rel=1e-5)
    check_picture(picture)


def folder_of(path: Path, **fields: Any) -> Path:
    """Of a run that has not begun."""
    config = untrained_config(**fields)
    spec = EnvSpec("Hopper", 11, 3, (-1.0,) * 3, (1.0,) * 3, 12, "native", "a test")
    RunFolder(path).create(config, sources_of(config), spec, seed_members([0]))
    return path


def test_what_cannot_be_diagnosed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    td3, without, new = (
        folder_of(tmp_path / name, **fields)
        for name, fields in (
            ("td3", {"agent": "td3"}), ("without", {"checkpoint_replay": False}), ("new", {}),
        )
    )  # fmt: skip
    for arguments, message in (
        ([str(td3)], "agent=td3: must be sacformer or sac"),
        ([str(without)], "checkpoint_replay=False: must be True"),
        ([str(new)], "no checkpoint yet"),
        ([str(tmp_path / "nothing")], "no config.json there"),
        ([str(new), "--batches", "1"], "batches=1: must be at least 2"),
        ([str(new), "--picture", "a.svg"], "must end in .png"),
    ):
        with pytest.raises(SystemExit) as stopped:
            diagnose.main(arguments)
        assert stopped.value.code == 2
        assert message in " ".join(capsys.readouterr().err.split())

"""Pictures of runs: what is in them, and that the attention drawn is the one acting used."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from untrained import STEPS, made_up_records, untrained_config, untrained_run

from sacformer_jax import ConfigError, evaluate, load_policy
from sacformer_jax.attention import acting_attention
from sacformer_jax.cli import main
from sacformer_jax.console import Reporter
from sacformer_jax.diagnostics import PANELS, _curve, attention_map, diagnostics_sheet
from sacformer_jax.distributions import TanhGaussian
from sacformer_jax.networks import STEP_TOKENS
from sacformer_jax.pictures import (
    TARGETS,
    RunRecords,
    _labels,
    mean_attention,
    returns_for_targets,
)
from sacformer_jax.recording import Recorder
from sacformer_jax.run_folder import RunConfigFile, RunFolder
from sacformer_jax.train import make_training_env
from sacformer_jax.transformer import Transformer, TransformerConfig

LAYERS, HEADS = 2, 2


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return untrained_run(tmp_path_factory.mktemp("diagnostics") / "run")


# --- attention -----------------------------------------------------------------------------------


def test_attention_weights_by_hand() -> None:
    """The first block's, from its parameters; asking for them changes nothing of the output."""
    config = TransformerConfig(2, 4, 2, 2, 0.0, "relu")
    trunk = Transformer(config, kept=(1, 2))
    x = jax.random.normal(jax.random.key(0), (1, 4, 4))
    mask = jnp.tril(jnp.ones((1, 4, 4), bool)).at[0, 3, 0].set(False)
    variables = jax.jit(trunk.init)(jax.random.key(1), x, mask)
    assert set(variables) == {"params"}
    variables = jax.tree.map(lambda leaf: 2.0 * leaf + 0.1, variables)
    plain, _ = trunk.apply(variables, x, mask)
    (asked, _), looked = trunk.apply(variables, x, mask, mutable=["intermediates"])
    np.testing.assert_array_equal(plain, asked)

    block = jax.tree.map(np.asarray, variables["params"]["block_0"])
    rows = np.asarray(x[0], np.float64)
    normed = (rows - rows.mean(1, keepdims=True)) / np.sqrt(rows.var(1, keepdims=True) + 1e-5)
    normed = normed * block["ln_1"]["scale"] + block["ln_1"]["bias"]
    projected = normed @ block["query_key_value"]["kernel"] + block["query_key_value"]["bias"]
    query, key = projected[:, :4], projected[:, 4:8]
    (weights,) = looked["intermediates"]["block_0"]["attention"]
    assert weights.shape == (1, 2, 4, 4)
    for head in range(2):
        own = slice(2 * head, 2 * head + 2)
        for i in range(4):
            scores = [
                math.exp(query[i, own] @ key[j, own] / math.sqrt(2)) if mask[0, i, j] else 0.0
                for j in range(4)
            ]
            expected = np.array(scores) / sum(scores)
            np.testing.assert_allclose(weights[0, head, i], expected, atol=2e-6)
    (last,) = looked["intermediates"]["block_1"]["attention"]
    assert last.shape == (1, 2, 2, 4)  # of the kept tokens alone
    np.testing.assert_allclose(last.sum(axis=-1), 1.0, atol=1e-6)


def _episode(path: Path) -> tuple[Any, Any, Any, np.ndarray]:
    """A policy, its contexts ``[T, K]`` over an episode and the actions taken, ``[T - 1, A]``."""
    policy = load_policy(path)
    env = make_training_env(policy.config, num_envs=1)
    length = policy.config.context.context_length
    recorder = Recorder(env, policy.agent, length, lambda episodes: episodes.context)
    recording = recorder.record(policy.state, 0)
    contexts = jax.tree.map(lambda leaf: leaf[:, 0], recording.seen)
    return policy, recording, contexts, contexts.action[1:, -2]


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"tokens": "gsa", "acting_context": "episode", "acting_context_limit": 5},
        {"tokens": "joint", "acting_context": "episode", "acting_context_limit": 5},
    ],
    ids=["window", "episode", "joint"],
)
def test_attention_is_that_of_acting(fields: dict[str, Any], tmp_path: Path) -> None:
    policy, recording, contexts, taken = _episode(untrained_run(tmp_path / "run", **fields))
    steps = int(recording.lengths[0])
    assert 5 < steps <= STEPS
    look = jax.jit(functools.partial(acting_attention, policy.config, policy.spec))
    attention, mean = look(policy.state, contexts)
    # It says the same as acting did, so it was computed from the same.
    distribution = TanhGaussian(policy.spec.action_low, policy.spec.action_high)
    np.testing.assert_allclose(distribution.mode(mean)[:-1], taken, atol=1e-5)

    pairs, tokens = (5 if fields else 3), len(STEP_TOKENS[policy.config.context.tokens].names)
    assert attention.shape == (LAYERS, HEADS, steps, pairs, tokens)
    np.testing.assert_allclose(attention.sum(axis=(-1, -2)), 1.0, atol=1e-5)
    for step in range(pairs):  # nothing before the episode
        assert np.all(attention[:, :, step, : step + 1, :2] > 0)
        assert np.all(attention[:, :, step, step + 1 :] == 0)
    if tokens == 3:
        assert np.all(attention[:, :, :, 0, 2] == 0)  # its own action is not known yet
        assert np.all(attention[:, :, 5:, 1:, 2] > 0)
    if not fields:
        shown = mean_attention(policy)
        np.testing.assert_allclose(shown.attention, attention.mean(axis=2), atol=1e-6)
        assert not shown.older


def test_an_attention_map_is_darkest_where_most_is(tmp_path: Path) -> None:
    attention = np.zeros((1, 1, 2, 2))
    attention[0, 0, 1, 0] = 1.0  # all to the older return-to-go: the left cell of the left panel
    attention_map(attention, ("return-to-go", "state"), False, tmp_path / "a.png", "title")
    grey = np.asarray(Image.open(tmp_path / "a.png").convert("L"))
    # A block of black, left of the middle.
    black = np.flatnonzero((grey < 30).sum(axis=0) > 0.15 * grey.shape[0])
    assert black.size > 20
    assert np.median(black) < grey.shape[1] / 2


# --- target returns ------------------------------------------------------------------------------


def test_returns_for_targets_are_evaluations(run: Path) -> None:
    policy = load_policy(run)
    targets = [fraction * 40.0 for fraction in TARGETS]
    assert targets == [10.0, 20.0, 30.0, 40.0, 50.0]
    returns = returns_for_targets(policy, targets, episodes=2, seed=5)
    assert returns.shape == (5, 2)
    record = evaluate(run, episodes=2, seed=5)  # under the target of training, 40
    assert float(returns[3].mean()) == record["return_mean"]
    assert len({float(row.mean()) for row in returns}) == 5  # the actor sees its target


# --- sheets --------------------------------------------------------------------------------------

COMMON = {
    "return_mean", "episode_return_mean", "episode_length_mean", "entropy", "critic_loss",
    "actor_loss", "critic_grad_norm", "actor_grad_norm", "skipped_updates",
}  # fmt: skip


@pytest.mark.parametrize(
    ("ppo", "own"),
    [
        (False, {"q_mean", "alpha"}),
        (True, {"approx_kl", "clip_fraction", "explained_variance", "learning_rate"}),
    ],
)
def test_a_sheet_has_what_the_records_have(ppo: bool, own: set[str], tmp_path: Path) -> None:
    groups = {"a": [made_up_records(ppo=ppo), made_up_records(1.0, ppo)]}
    assert set(diagnostics_sheet(groups, tmp_path / "a.png", "title")) == COMMON | own
    grey = np.asarray(Image.open(tmp_path / "a.png").convert("L"))
    assert grey.shape[1] > 1000
    assert 0.01 < (grey < 128).mean() < 0.2


def test_curves_of_metrics() -> None:
    records = made_up_records()
    panels = {panel.name: panel for panel in PANELS}
    assert _curve(records, panels["return_mean"]) == {100: 9.0, 300: 27.0, 500: 45.0}
    # Chunks in which no episode ended are left out; skipped updates are summed up.
    assert _curve(records, panels["episode_return_mean"]) == {100: 10.0, 300: 30.0, 500: 50.0}
    totals = {100: 1.0, 200: 3.0, 300: 6.0, 400: 10.0, 500: 15.0}
    assert _curve(records, panels["skipped_updates"]) == totals
    assert _curve(records, panels["bad_physics"]) == {}
    never = [{**record, "skipped_updates": 0, "bad_physics": 2} for record in records]
    assert set(_curve(never, panels["skipped_updates"]).values()) == {0.0}
    assert _curve(never, panels["bad_physics"])[500] == 10.0
    assert _curve(records, dataclasses.replace(panels["q_mean"], name="nothing")) == {}


# --- the command ---------------------------------------------------------------------------------


def test_plot_of_a_run(run: Path, tmp_path: Path, capsys) -> None:
    before = sorted(run.iterdir())
    assert main(["plot", str(run), "--to", str(tmp_path / "p"), "--episodes", "2"]) == 0
    names = ["attention.png", "diagnostics.png", "learning_curve.png", "target_return.png"]
    assert sorted(path.name for path in (tmp_path / "p").iterdir()) == names
    assert sorted(capsys.readouterr().out.split()) == [str(tmp_path / "p" / name) for name in names]
    assert sorted(run.iterdir()) == before
    for path in (tmp_path / "p").iterdir():
        assert np.asarray(Image.open(path).convert("L")).std() > 10


def test_plot_of_several_members_and_runs(run: Path, tmp_path: Path, capsys) -> None:
    several = untrained_run(tmp_path / "sac", seeds=2, agent="sac")
    assert main(["plot", str(several)]) == 0
    own = {"diagnostics.png", "learning_curve.png"}
    for folder in (several, several / "seed-0", several / "seed-1"):
        assert {path.name for path in folder.glob("*.png")} == own
    to = tmp_path / "both"
    capsys.readouterr()
    assert main(["plot", str(several), str(run), "--to", str(to)]) == 0
    said = capsys.readouterr().out.split()
    assert said == [str(to / "comparison.png"), str(to / "diagnostics.png")]
    assert sorted(map(str, to.iterdir())) == said


def test_plot_before_the_first_evaluation(tmp_path: Path, capsys) -> None:
    path = untrained_run(tmp_path / "sac", seeds=2, agent="sac")
    for seed in range(2):
        metrics = path / f"seed-{seed}" / "metrics.jsonl"
        lines = [r for r in made_up_records(seed) if r["kind"] == "train"]
        metrics.write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert main(["plot", str(path)]) == 0
    assert [p.name for p in path.glob("*.png")] == ["diagnostics.png"]
    other = untrained_run(tmp_path / "other", agent="td3")
    assert main(["plot", str(path), str(other), "--to", str(tmp_path / "both")]) == 0
    with Reporter(quiet=True) as reporter:
        reporter._last_evaluations({"seed-0": [], "seed-1": []})


def test_runs_of_the_same_name_are_told_apart() -> None:
    config = untrained_config(agent="sac")
    runs = [
        RunRecords(RunFolder(path), RunConfigFile(config, {}, ()), {})
        for path in ("/a/runs/x", "/b/runs/x")
    ]
    assert _labels(runs) == ["a/runs/x", "b/runs/x"]
    with pytest.raises(ConfigError, match="'/a/runs/x' was given twice"):
        _labels([runs[0], runs[0]])


def test_a_place_that_cannot_be_written_is_told_in_a_line(
    run: Path, tmp_path: Path, capsys
) -> None:
    (tmp_path / "file").write_text("here already")
    assert main(["plot", str(run), "--to", str(tmp_path / "file"), "--episodes", "0"]) == 2
    assert f"error: '{tmp_path / 'file'}': File exists" in capsys.readouterr().err


def test_plot_refuses_what_has_nothing_to_draw(run: Path, tmp_path: Path, capsys) -> None:
    assert main(["plot"]) == 2
    assert "at least one run" in capsys.readouterr().err
    assert main(["plot", str(run), "--episodes", "-1"]) == 2
    assert "episodes=-1" in capsys.readouterr().err
    empty = untrained_run(tmp_path / "run", agent="sac")
    (empty / "metrics.jsonl").unlink()
    assert main(["plot", str(empty)]) == 2
    assert "no metrics yet" in capsys.readouterr().err

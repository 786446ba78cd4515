"""Updates with a tensor that is not finite are skipped, counted and explained."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probe import point_config, point_env
from test_sac_update import K, make_window
from trees import unequal

from sacformer_jax import DivergedError, agents, cli, load_policy, make_program, train
from sacformer_jax.agents.faults import NO_FAULT, first_fault, num_non_finite
from sacformer_jax.agents.sac_update import CHECKED
from sacformer_jax.config import Config
from sacformer_jax.logging import read_records
from sacformer_jax.train import hyperparameters
from sacformer_jax.types import LearnerState, Window

# --- one update ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def setup() -> Any:
    config = point_config(context_length=K)
    agent = agents.make(config, point_env(1).spec)
    learner = jax.jit(agent.init)(jax.random.key(0))
    return jax.jit(agent.update), learner, hyperparameters(config, 1)


def _filled(params: Any, value: float) -> Any:
    """The first leaf's first number replaced."""
    leaves, structure = jax.tree.flatten(params)
    return jax.tree.unflatten(
        structure, [leaves[0].at[(0,) * leaves[0].ndim].set(value), *leaves[1:]]
    )


def _poisoned(what: str, learner: LearnerState, window: Window) -> tuple[LearnerState, Window]:
    if what in ("obs", "reward", "return_to_go"):
        values = getattr(window, what)
        values = values.at[(0,) * values.ndim].set(jnp.inf if what == "obs" else jnp.nan)
        return learner, window.replace(**{what: values})
    name = {"policy": "actor_params", "next_q": "target_critic_params"}[what]
    return learner.replace(**{name: _filled(getattr(learner, name), np.nan)}), window


@pytest.mark.parametrize("what", ["obs", "reward", "return_to_go", "policy", "next_q"])
def test_a_tensor_that_is_not_finite_leaves_everything_as_it_was(setup: Any, what: str) -> None:
    update, learner, hyper = setup
    learner, window = _poisoned(what, learner, make_window())
    new, metrics = update(learner, hyper, window, jax.random.key(1))
    assert CHECKED[int(metrics["fault"])] == what
    assert unequal(new, learner) == {}


def test_a_loss_that_overflows(setup: Any) -> None:
    update, learner, hyper = setup
    learner = learner.replace(critic_params=jax.tree.map(lambda x: 1e25 * x, learner.critic_params))
    new, metrics = update(learner, hyper, make_window(), jax.random.key(1))
    assert CHECKED[int(metrics["fault"])] == "critic_loss"
    assert unequal(new, learner) == {}


def test_an_actor_whose_loss_overflows_stays_and_the_critics_go_on(setup: Any) -> None:
    """α beyond float32, where no target is built from a next state."""
    update, learner, hyper = setup
    learner = learner.replace(log_alpha=jnp.float32(200.0))
    nothing = jnp.zeros_like(make_window().bootstrap_mask)
    window = make_window().replace(bootstrap_mask=nothing, discount=jnp.zeros((5, K)))
    new, metrics = update(
        learner, hyper.replace(discount=jnp.float32(0)), window, jax.random.key(1)
    )
    # 0 x inf is not finite either: the targets are the first to tell.
    assert CHECKED[int(metrics["fault"])] in ("critic_loss", "actor_loss")
    assert unequal(new.actor_params, learner.actor_params) == {}
    assert unequal(new.log_alpha, learner.log_alpha) == {}


def test_a_sound_update_is_none(setup: Any) -> None:
    update, learner, hyper = setup
    new, metrics = update(learner, hyper, make_window(), jax.random.key(1))
    assert int(metrics["fault"]) == NO_FAULT
    assert {".actor_opt.count", ".critic_opt.count"} <= set(unequal(new, learner))


def test_first_fault() -> None:
    counts = [
        num_non_finite(jnp.ones(3)),
        num_non_finite(jnp.array([jnp.nan, jnp.inf]), jnp.ones(2)),
    ]
    assert [float(count) for count in counts] == [0.0, 2.0]
    assert int(first_fault([*counts, counts[1]])) == 1
    assert int(first_fault([counts[0]])) == NO_FAULT


# --- a chunk --------------------------------------------------------------------------------------


def test_skipped_updates_are_counted_and_are_in_no_mean() -> None:
    config = point_config(prefill_env_steps=80, chunk_env_steps=80, num_envs=1)
    program = make_program(config, point_env(1))
    state, _ = program.prefill(program.init(jax.random.key(0)))
    reward = state.buffer.steps.reward.at[0, 7].set(jnp.nan)  # gets past every guard
    steps = dataclasses.replace(state.buffer.steps, reward=reward)
    state = dataclasses.replace(state, buffer=dataclasses.replace(state.buffer, steps=steps))
    state, metrics = program.train_chunk(state)
    skipped = int(state.counters.skipped_updates)
    # 32 windows of about 1.9 of 80 to 160 steps: one in two or so.
    assert 10 < skipped < 75
    assert int(metrics["skipped_updates"]) == skipped
    assert int(state.counters.updates) == 80
    assert program.agent.checked[int(state.counters.first_fault)] == "reward"
    assert int(state.learner.critic_opt.count) == 80 - skipped
    for name in ("critic_loss", "actor_loss", "q_mean", "entropy", "actor_grad_norm"):
        assert np.isfinite(metrics[name]), name
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state.learner))


# --- a run ----------------------------------------------------------------------------------------

DIVERGING = {
    "env": "Hopper", "agent": "sac", "num_envs": 2, "max_episode_steps": 50,
    "prefill_env_steps": 200, "chunk_env_steps": 100, "total_env_steps": 2_000, "eval_every": 500,
    "eval_episodes": 2, "actor_width": 8, "actor_layers": 1, "critic_width": 8, "batch_size": 4,
    "buffer_capacity": 2_000, "updates_per_env_step": 1.0, "critic_learning_rate": 1e25,
    "max_skipped_updates": 150,
}  # fmt: skip


def test_a_run_that_diverges_stops_and_says_why(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = Config.from_preset("cpu", **DIVERGING, run_dir=str(tmp_path / "run"))
    with pytest.raises(DivergedError, match=r"max_skipped_updates=150.*fault\.json"):
        train(config)
    fault = json.loads((tmp_path / "run" / "fault.json").read_text())
    assert fault["env_steps"] == 400  # 200 updates by then
    assert 150 < fault["skipped_updates"] <= fault["updates"] == 200
    assert fault["first_tensor_not_finite"] in CHECKED
    assert fault["learner_values_not_finite"] == {}
    assert fault["hyperparameters"]["critic_learning_rate"] == pytest.approx(1e25)
    assert max(fault["largest_critic_parameters"].values()) > 1e20
    assert "updates were not finite" in " ".join(capsys.readouterr().out.split())
    records = read_records(tmp_path / "run" / "metrics.jsonl", "train")
    assert sum(record["skipped_updates"] for record in records) == fault["skipped_updates"]
    # The state was saved, and the policies before are there.
    assert (tmp_path / "run" / "checkpoints" / "400").is_dir()
    for which in ("best", "latest"):
        load_policy(tmp_path / "run", which)


def test_the_command_line_has_a_code_for_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = [
        f"--{name.replace('_', '-')}={value}"
        for name, value in {**DIVERGING, "run_dir": tmp_path / "run"}.items()
    ]
    assert cli.main(["train", *flags]) == cli.EXIT_DIVERGED == 4
    assert "max_skipped_updates=150" in capsys.readouterr().err


def test_one_diverging_member_does_not_stop_the_others(tmp_path: Path) -> None:
    from sacformer_jax import Member

    settings = {**DIVERGING, "critic_learning_rate": 3e-4, "total_env_steps": 600}
    config = Config.from_preset("cpu", **settings, run_dir=str(tmp_path / "run"))
    members = [Member("sound", 0), Member("diverging", 0, {"critic_learning_rate": 1e25})]
    result = train(config, members=members, quiet=True)
    assert result.env_steps == 600
    assert (tmp_path / "run" / "diverging" / "fault.json").is_file()
    assert not (tmp_path / "run" / "sound" / "fault.json").exists()
    last = read_records(tmp_path / "run" / "sound" / "metrics.jsonl", "train")[-1]
    assert last["skipped_updates"] == 0
    assert last["critic_loss"] is not None

"""DDPG where it is not TD3: one critic, targets without noise, no delay; and that it learns."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np
import pytest
from test_td3 import (
    CENTER,
    HALF_RANGE,
    RUN,
    Setup,
    check_exploration,
    check_learning,
    check_soft_update,
    conditions,
    make_setup,
    make_window,
    numpy_actor,
    numpy_actor_loss,
    numpy_critic_loss,
    products,
    reference_update,
    traced_for_two_members,
)
from trees import largest_difference, unequal

from sacformer_jax import cli, load_policy
from sacformer_jax.logging import read_records


@pytest.fixture(scope="module")
def ddpg() -> Setup:
    return make_setup(agent="ddpg")


def test_there_is_one_critic(ddpg: Setup) -> None:
    for params in (ddpg.learner.critic_params, ddpg.learner.target_critic_params):
        assert {leaf.shape[0] for leaf in jax.tree.leaves(params)} == {1}
    assert ddpg.learner.log_alpha is ddpg.learner.num_updates is None


def test_losses_equal_numpy(ddpg: Setup) -> None:
    """The target is at the target actor's own action, whatever TD3's settings say."""
    window = make_window()
    new, metrics = ddpg.update(ddpg.learner, ddpg.hyper, window, jax.random.key(7))
    point = numpy_actor(ddpg.learner.target_actor_params, window.obs[:, 1:])
    expected = numpy_critic_loss(ddpg.learner, window, CENTER + HALF_RANGE * point)
    assert float(metrics["critic_loss"]) == pytest.approx(expected, rel=1e-4)
    expected = numpy_actor_loss(ddpg.learner.actor_params, new.critic_params, window)
    assert float(metrics["actor_loss"]) == pytest.approx(expected, rel=1e-4)
    # Nothing in it is random.
    again, _ = ddpg.update(ddpg.learner, ddpg.hyper, window, jax.random.key(8))
    assert unequal(again, new) == {}


def test_parameters_move_as_written_out_at_every_update(ddpg: Setup) -> None:
    window, key = make_window(3), jax.random.key(9)
    new, _ = ddpg.update(ddpg.learner, ddpg.hyper, window, key)
    actor, critic = jax.jit(lambda: reference_update(ddpg, window, key, 1))()
    # Adam's first step divides by the gradient's size: rounding shows where it is tiny.
    assert largest_difference((new.actor_params, new.critic_params), (actor, critic)) < 3e-5
    check_soft_update(ddpg.learner, new)
    second, _ = ddpg.update(new, ddpg.hyper, window, key)
    assert int(second.actor_opt.count) == int(second.critic_opt.count) == 2
    check_soft_update(new, second)


def test_exploration_is_gaussian_in_half_ranges() -> None:
    check_exploration(make_setup(agent="ddpg", action_noise=0.15), 0.15)


def test_a_fault_of_the_target_actor_leaves_everything_as_it_was(ddpg: Setup) -> None:
    nan = jax.tree.map(lambda leaf: leaf * np.nan, ddpg.learner.target_actor_params)
    learner = ddpg.learner.replace(target_actor_params=nan)
    new, metrics = ddpg.update(learner, ddpg.hyper, make_window(), jax.random.key(1))
    assert ddpg.agent.checked[int(metrics["fault"])] == "policy"
    assert unequal(new, learner) == {}


def test_nothing_in_it_is_conditional(ddpg: Setup) -> None:
    traced = traced_for_two_members(ddpg)
    assert conditions(traced) == []
    # Both targets; both networks twice, as the critic learns and as it judges; and backward.
    assert products(traced) == 5 + (3 + 2 * 3) + (5 + 2 * 5)


def test_learns_and_a_broken_update_does_not() -> None:
    check_learning("ddpg")


@pytest.mark.slow
def test_a_run_from_the_command_line(tmp_path: Path) -> None:
    flags = [
        f"--no-{name.replace('_', '-')}"
        if value is False
        else f"--{name.replace('_', '-')}" + ("" if value is True else f"={value}")
        for name, value in {**RUN, "agent": "ddpg", "run_dir": tmp_path / "run"}.items()
    ]
    assert cli.main(["train", *flags]) == 0
    records = read_records(tmp_path / "run" / "metrics.jsonl", "train")
    assert [record["updates"] for record in records] == [100, 200, 300]
    for record in records:
        for name in ("critic_loss", "actor_loss", "q_mean", "critic_grad_norm", "actor_grad_norm"):
            assert np.isfinite(record[name]), name
    action, _ = load_policy(tmp_path / "run").predict(np.zeros(11, np.float32))
    assert action.shape == (3,)

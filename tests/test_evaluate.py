"""Evaluation: episodes that physics cuts off are told apart, and are not the best there is."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from probe import EPISODE, PointEnv, point_config

from sacformer_jax.envs.core import EnvStep, VectorEnv
from sacformer_jax.evaluate import make_evaluator
from sacformer_jax.logging import rank
from sacformer_jax.loop import summarize
from sacformer_jax.train import make_program, policy_of


class BreakingEnv(PointEnv):
    """Stays where it starts, costs 1 a step, and breaks down at once right of the origin."""

    def step(self, state: jax.Array, action: jax.Array) -> tuple[jax.Array, EnvStep]:
        no, reward = jnp.zeros((), bool), -jnp.ones(())
        bad = state[0] > 0
        return state, EnvStep(state, reward, terminated=no, bad=bad, reward_terms={"r": reward})


def _record(return_mean: float, **others: Any) -> dict[str, Any]:
    return {"return_mean": return_mean, **others}


def test_episodes_that_physics_cuts_off_are_told() -> None:
    program = make_program(point_config(), VectorEnv(BreakingEnv(), 4))
    evaluate = make_evaluator(VectorEnv(BreakingEnv(), 16), program.agent, 2)
    result = evaluate(policy_of(program.init(jax.random.key(0))), jax.random.key(1))
    bad = np.asarray(result.bad)
    assert 0 < bad.sum() < 16
    np.testing.assert_array_equal(result.lengths, np.where(bad, 1, EPISODE))
    np.testing.assert_array_equal(result.returns, np.where(bad, 0, -EPISODE))
    assert summarize(result)["bad_physics"] == bad.sum()


def test_a_whole_evaluation_is_better_than_one_cut_off() -> None:
    whole, higher = _record(-100.0, bad_physics=0), _record(-90.0, bad_physics=0)
    cut_off, more = _record(-5.0, bad_physics=1), _record(-4.0, bad_physics=2)
    ranked = sorted([more, whole, cut_off, higher], key=rank)
    assert ranked == [cut_off, more, whole, higher]
    assert rank(_record(-95.0)) > rank(whole)  # of a run from before they were counted

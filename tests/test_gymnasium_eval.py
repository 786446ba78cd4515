"""Evaluation in Gymnasium: against a loop written out, and without a word on the terminal."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest

from sacformer_jax.gymnasium_eval import evaluate_random


def test_random_actions_equal_a_loop_written_out() -> None:
    env = gymnasium.make("Hopper-v5")
    env.action_space.seed(3)
    returns, lengths, survive = [], [], []
    for episode in range(3):
        env.reset(seed=3 if episode == 0 else None)
        rewards, done = [], False
        while not done:
            _, reward, terminated, truncated, info = env.step(env.action_space.sample())
            rewards.append(float(reward))
            survive.append(info["reward_survive"])
            done = terminated or truncated
        returns.append(sum(rewards))
        lengths.append(len(rewards))

    got = evaluate_random("Hopper-v5", 3, seed=3)
    np.testing.assert_allclose(got.returns, returns)
    np.testing.assert_array_equal(got.lengths, lengths)
    assert got.reward_terms["reward_survive"] == pytest.approx(np.mean(survive))
    assert got.record()["length_mean"] == pytest.approx(np.mean(lengths))


def test_old_attributes_of_gymnasiums_models_are_not_the_users_business(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes MUJOCO_LOG.TXT into the working directory
    warnings: list[str] = []
    mujoco.set_mju_user_warning(warnings.append)
    try:
        evaluate_random("HalfCheetah-v5", 1)
        # Whoever handles MuJoCo's warnings goes on doing so.
        assert mujoco.get_mju_user_warning() is not None
        gymnasium.make("HalfCheetah-v5").close()
    finally:
        mujoco.set_mju_user_warning(None)
    assert len(warnings) == 1
    assert "settotalmass" in warnings[0]

    evaluate_random("HalfCheetah-v5", 1)
    captured = capfd.readouterr()
    assert not captured.out
    assert "settotalmass" not in captured.err
    assert not list(tmp_path.iterdir())

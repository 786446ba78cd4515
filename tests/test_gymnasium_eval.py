"""Evaluation in Gymnasium: against a loop written out, and without a word on the terminal."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from sacformer_jax import ConfigError
from sacformer_jax.envs import gym_registry
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


class Endless(gymnasium.Env):
    """Never ends by itself, and says much of its reward."""

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        parts = {"reward_near": np.float64(0.5), "reward_at": jnp.float32(0.25), "reward_on": True}
        told = {"reward_components": {"a": 1.0}, "reward_type": "dense", "reward_vector": [1, 2]}
        return np.zeros(2, np.float32), 1.0, False, False, {**parts, **told, "other": 3.0}


def test_an_id_without_a_limit_ends_and_its_parts_of_the_reward_are_numbers() -> None:
    gymnasium.register("Tests/Endless-v0", Endless)
    try:
        found = evaluate_random("Tests/Endless-v0", 1)
        as_in_training = evaluate_random("Tests/Endless-v0", 2, limit=7)
        live = gym_registry.find("Tests/Endless-v0", 5)
        live.env.close()
    finally:
        del gymnasium.registry["Tests/Endless-v0"]
    assert found.lengths.tolist() == [1000]
    assert as_in_training.lengths.tolist() == [7, 7]
    assert found.reward_terms == {"reward_near": 0.5, "reward_at": 0.25, "reward_on": 1.0}
    assert live.facts.reward_terms == ("reward_at", "reward_near", "reward_on")


def test_what_gymnasium_cannot_make_is_told() -> None:
    def missing(**_: Any) -> None:
        raise gymnasium.error.DependencyNotInstalled("Box3D is not installed")

    with pytest.raises(ConfigError, match="knows no such id"):
        evaluate_random("Tests/Nowhere-v0", 1)
    gymnasium.register("Tests/Missing-v0", missing)
    try:
        with pytest.raises(ConfigError, match=r"'Tests/Missing-v0': .* Box3D is not installed"):
            evaluate_random("Tests/Missing-v0", 1)
    finally:
        del gymnasium.registry["Tests/Missing-v0"]


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

"""brax.training's PPO on a task of ours, by the script that does it at length."""

from __future__ import annotations

import json

import brax_ppo
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sacformer_jax import make_env


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """One round of learning on the Hopper, with what the script writes and our engine counts."""
    path = tmp_path_factory.mktemp("brax") / "result.json"
    calls = make_env("Hopper", "native").engine.threads
    before = calls.calls
    brax_ppo.main(
        ["--env", "Hopper", "--steps", "512", "--num-envs", "16", "--unroll-steps", "2",
         "--evaluations", "2", "--episodes", "3", "--width", "8", "--max-episode-steps", "60",
         "--json", str(path)]
    )  # fmt: skip
    return {**json.loads(path.read_text()), "host_calls": calls.calls - before}


def test_brax_learns_and_its_numbers_are_finite(result):
    assert list(result["evaluations"]) == ["0", "512"]
    for metrics in result["evaluations"].values():
        assert np.all(np.isfinite(list(metrics.values())))
    assert np.isfinite(result["evaluations"]["512"]["training/total_loss"])
    assert result["command"].startswith("python experiments/brax_ppo.py --env Hopper --steps 512 ")


def test_the_steps_are_our_engines_and_the_returns_the_tasks(result):
    # A round of 32 steps of 16 environments, two evaluations of 60 steps, and resets.
    assert result["host_calls"] >= 32 + 2 * 60
    for metrics in result["evaluations"].values():
        # The Hopper falls before the limit; each step but the last pays 1 for being healthy.
        assert 5 < metrics["eval/avg_episode_length"] < 60
        healthy = metrics["eval/episode_reward_survive"]
        assert healthy == pytest.approx(metrics["eval/avg_episode_length"] - 1)
        terms = sum(
            metrics[f"eval/episode_reward_{name}"] for name in ("survive", "forward", "ctrl")
        )
        assert metrics["eval/episode_reward"] == pytest.approx(terms, rel=1e-4)
        assert metrics["eval/episode_reward_ctrl"] < 0
        assert metrics["eval/episode_bad_physics"] == 0
    assert np.all(np.isfinite(result["gymnasium_returns"]))


def test_what_jax_took_away_is_given_back_as_it_was():
    brax_ppo.give_back_device_put_replicated()
    given = jax.device_put_replicated({"a": jnp.arange(3), "b": 2.0}, jax.devices()[:1])
    np.testing.assert_array_equal(given["a"], [[0, 1, 2]])
    np.testing.assert_array_equal(given["b"], [2.0])
    assert given["a"].sharding.device_set == {jax.devices()[0]}

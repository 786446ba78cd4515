"""Many devices: the same numbers as on one, and no communication that need not be."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import users_flags

from sacformer_jax import normalizer
from sacformer_jax.agents.sac_update import step_weights
from sacformer_jax.buffer import weighted_by_share
from sacformer_jax.parallel import DATA_AXIS, DataAxis
from sacformer_jax.types import Window

HERE = Path(__file__).parent


def _found(*meshes: str) -> Any:
    """What a process with 8 CPU devices finds."""
    flags = users_flags() + " --xla_force_host_platform_device_count=8"
    done = subprocess.run(
        [sys.executable, HERE / "mesh_program.py", *meshes],
        env={**os.environ, "XLA_FLAGS": flags, "PYTHONPATH": str(HERE)},
        capture_output=True,
        text=True,
        timeout=500,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def found() -> Any:
    return _found("members", "update")


def _check_prefill(found: Any) -> None:
    assert set(found["prefilled"]) <= {".learner.normalizer.mean", ".learner.normalizer.m2"}
    # Statistics of the observations are summed in another order where the data are split.
    assert max(found["prefilled"].values(), default=0.0) < 1e-3


def _check_collectives(found: Any) -> None:
    """Critics, actor, and the weights of the steps; the rest is of collecting, once for it all."""
    names = found["collectives"]
    assert set(names) == {"all-reduce"}
    assert 3 < names["all-reduce"] <= 3 + 7  # 5 counts of episodes, mean and m2 of observations


def test_members_on_devices_of_their_own_learn_the_same(found: Any) -> None:
    members = found["members"]
    assert members["num_devices"] == 4
    assert members["prefilled"] == {}  # to the bit
    assert members["learner"] < 1e-5
    assert members["evaluation"] < 1e-2


def test_members_need_no_communication(found: Any) -> None:
    assert found["members"]["collectives"] == {}


@pytest.mark.slow
def test_data_on_devices_of_their_own() -> None:
    """The same to the bit through prefill, and one reduction for each network."""
    found = _found("data", "both")
    for mesh, num_devices in (("data", 4), ("both", 8)):
        assert found[mesh]["num_devices"] == num_devices
        _check_prefill(found[mesh])
        _check_collectives(found[mesh])


@pytest.mark.parametrize("agent", ["sacformer", "sac"])
def test_an_update_is_that_of_one_device_on_the_whole_batch(found: Any, agent: str) -> None:
    assert found["update"][agent] < 2e-6


def _over_shards(function: Any, *arguments: Any) -> Any:
    """As on devices whose shards lead the arguments."""
    return jax.jit(jax.vmap(function, axis_name=DATA_AXIS))(*arguments)


def test_rows_and_draws_of_shards_are_those_of_one_device() -> None:
    data, shards, key = DataAxis(4), jnp.arange(4), jax.random.key(0)
    everything = jnp.arange(24.0).reshape(8, 3)
    parts = _over_shards(lambda _: data.rows(everything), shards)
    np.testing.assert_array_equal(parts.reshape(8, 3), everything)
    drawn = _over_shards(lambda _: data.normal(key, (2, 3)), shards)
    np.testing.assert_array_equal(drawn.reshape(8, 3), jax.random.normal(key, (8, 3)))
    keys = jax.random.key_data(_over_shards(lambda _: data.own_key(key), shards))
    assert len({tuple(own.tolist()) for own in keys}) == 4


def test_sums_and_maxima_of_shards() -> None:
    data, values = DataAxis(3), jnp.array([1.0, -2.0, 4.0])
    tree = _over_shards(lambda x: data.sum({"a": x, "b": jnp.stack([x, 2 * x])}), values)
    np.testing.assert_array_equal(tree["a"], [3.0, 3.0, 3.0])
    np.testing.assert_array_equal(tree["b"][0], [3.0, 6.0])
    np.testing.assert_array_equal(_over_shards(data.max, values), [4.0, 4.0, 4.0])
    counts = _over_shards(data.count, jnp.array([2**24, 1, 0]))
    np.testing.assert_array_equal(counts, [2**24 + 1] * 3)  # not through floats


def test_one_shard_is_all_of_it() -> None:
    data, x = DataAxis(), jnp.arange(4.0)
    assert data.sum(x) is data.rows(x) is data.max(x) is data.count(x) is x
    key = jax.random.key(1)
    assert data.own_key(key) is key
    np.testing.assert_array_equal(data.normal(key, (2, 3)), jax.random.normal(key, (2, 3)))


def _window(weight: jax.Array) -> Window:
    steps = (*weight.shape, 2)
    zeros, real = jnp.zeros(steps), jnp.ones(steps, bool)
    return Window(
        obs=zeros, action=zeros, reward=zeros, discount=zeros, return_so_far=zeros,
        return_to_go=zeros, time_step=zeros, state_mask=real, mask=real,
        bootstrap_mask=real.at[0, 0].set(False), weight=weight,
    )  # fmt: skip


def test_steps_weigh_the_same_however_they_lie_on_devices() -> None:
    """Two shards with 30 and 10 steps, three windows of two steps from each, and an empty one."""
    parts: Any = SimpleNamespace(data=DataAxis(3))

    def weights(weight: jax.Array, num: jax.Array) -> Any:
        own = step_weights(parts, weighted_by_share(_window(weight), num))
        return own.actor, own.critic

    drawn = jnp.array([[0.5] * 3, [0.5] * 3, [jnp.inf] * 3])  # nothing to draw: no real step
    actor, critic = _over_shards(weights, drawn, jnp.array([30, 10, 0]))
    assert actor.sum() == pytest.approx(1.0)
    assert critic.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(actor.sum(axis=(1, 2)), [0.75, 0.25, 0.0], rtol=1e-6)
    np.testing.assert_allclose(actor[0], 3 * actor[1], rtol=1e-6)
    assert critic[0, 0, 0] == critic[1, 0, 0] == 0.0


def test_statistics_of_observations_over_shards() -> None:
    rng = np.random.default_rng(0)
    first, second = rng.normal(3.0, 2.0, (2, 8, 5, 2)).astype(np.float32)
    expected = normalizer.init(2)
    for obs in (first, second):
        expected = normalizer.update(expected, obs)

    def sharded(first: jax.Array, second: jax.Array) -> Any:
        update = partial(normalizer.update, data=DataAxis(4))
        return update(update(normalizer.init(2), first), second)

    ours = _over_shards(sharded, first.reshape(4, 2, 5, 2), second.reshape(4, 2, 5, 2))
    for mine, theirs in zip(jax.tree.leaves(ours), jax.tree.leaves(expected), strict=True):
        for shard in mine:
            np.testing.assert_allclose(shard, theirs, rtol=1e-5)

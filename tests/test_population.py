"""Members trained as one program: each is what it would be alone."""

from __future__ import annotations

import dataclasses
import re
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import with_users_loops
from probe import PointEnv, point_config, point_env
from trees import largest_difference, unequal

from sacformer_jax import (
    Config,
    ConfigError,
    Devices,
    Member,
    make_evaluator,
    make_population,
    make_program,
    policy_of,
    seed_members,
)
from sacformer_jax.envs import VectorEnv
from sacformer_jax.parallel import any_of_all
from sacformer_jax.population import Population, member_counters, member_metrics, member_state
from sacformer_jax.train import hyperparameters

SEEDS = (0, 7, 3)
HOPPER = {
    "env": "Hopper", "num_envs": 2, "max_episode_steps": 60, "prefill_env_steps": 240,
    "chunk_env_steps": 40, "total_env_steps": 2_000, "eval_episodes": 2, "actor_width": 8,
    "actor_heads": 1, "actor_layers": 1, "critic_width": 8, "batch_size": 8,
    "buffer_capacity": 2_000, "updates_per_env_step": 0.5, "normalize_obs": True,
    "return_conditioning": "commanded", "tune_alpha": True, "target_return": "auto",
    "actor_dropout": 0.1,
}  # fmt: skip


@pytest.fixture(scope="module")
def hopper() -> Config:
    return Config.from_preset("cpu", **HOPPER, seeds=list(SEEDS))


@dataclasses.dataclass(frozen=True)
class Trained:
    """A population and its states and metrics after prefill, and after two chunks."""

    population: Population
    prefilled: Any
    trained: Any
    metrics: Any


def _host(tree: Any) -> Any:
    return jax.tree.map(jnp.copy, tree)


@pytest.fixture(scope="module")
def together(hopper: Config) -> Trained:
    population = make_population(hopper, seed_members(hopper.all_seeds))
    return Trained(population, *_trained(population, population.init()))


def _trained(programs: Any, state: Any) -> tuple[Any, Any, Any]:
    """The state after prefill, and after two chunks, with the metrics of the last.

    A compiled program takes what it was compiled for and nothing else: so the second chunk also
    shows that nothing is compiled anew for what the first one gives.
    """
    prefilled, _ = with_users_loops(programs.prefill, state)(state)
    state = _host(prefilled)
    train_chunk = with_users_loops(programs.train_chunk, state)
    for _ in range(2):
        state, metrics = train_chunk(state)
    return prefilled, state, metrics


@pytest.fixture(scope="module")
def alone(hopper: Config) -> Any:
    """The same of one seed, by the program for one."""
    program = make_program(hopper.replace(seeds=1))
    return _trained(program, program.init(jax.random.key(SEEDS[1])))


# --- one seed among others ----------------------------------------------------------------------


def test_a_seed_among_others_is_the_same_to_the_bit_through_prefill(
    together: Trained, alone: Any
) -> None:
    ours = member_state(together.population, together.prefilled, 1)
    assert unequal(ours, alone[0]) == {}


def test_a_seed_among_others_learns_the_same_up_to_rounding(together: Trained, alone: Any) -> None:
    """40 updates and the physics of 40 vector steps: 1e-5 of values of order one."""
    ours = member_state(together.population, together.trained, 1)
    assert largest_difference(ours.learner, alone[1].learner) < 1e-5
    assert unequal(ours.counters, alone[1].counters) == {}
    # Contacts have not amplified it yet.
    assert largest_difference(ours.buffer.steps.obs, alone[1].buffer.steps.obs) < 1e-3
    for name, value in member_metrics(jax.device_get(together.metrics), 1).items():
        np.testing.assert_allclose(value, alone[2][name], rtol=1e-3, atol=1e-4, err_msg=name)


def test_members_differ(together: Trained) -> None:
    first, second = (member_state(together.population, together.trained, index) for index in (0, 2))
    assert largest_difference(first.learner.actor_params, second.learner.actor_params) > 1e-3
    assert not np.array_equal(first.buffer.steps.obs, second.buffer.steps.obs)


def test_a_population_of_one_is_the_program_to_the_bit(hopper: Config, alone: Any) -> None:
    population = make_population(hopper.replace(seeds=1), seed_members([SEEDS[1]]))
    _, state, metrics = _trained(population, population.init())
    assert unequal(member_state(population, state, 0), alone[1]) == {}
    assert unequal(member_metrics(metrics, 0), alone[2]) == {}


def test_evaluation_is_each_members_own(together: Trained, hopper: Config) -> None:
    population, state = together.population, together.trained
    policies = policy_of(state)
    result = population.evaluate(policies, np.int32(320))
    assert result.returns.shape == (3, 2)
    evaluate = make_evaluator(
        VectorEnv(population.program.env.env, 2, 60),
        population.program.agent,
        hopper.context.context_length,
    )
    for index, seed in enumerate(SEEDS):
        policy = jax.tree.map(lambda leaf, i=index: leaf[i], policies)
        key = jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), 2**31), 320)
        own = evaluate(policy, key)
        np.testing.assert_array_equal(result.lengths[index], own.lengths)
        np.testing.assert_allclose(result.returns[index], own.returns, rtol=1e-4)


@pytest.mark.slow
def test_members_with_a_cache_and_a_table_of_episodes() -> None:
    config = point_config(
        acting_context="episode", window="scattered", return_conditioning="hindsight",
        chunk_env_steps=40,
    )  # fmt: skip
    population = make_population(config, seed_members((3, 4)), env=PointEnv())
    state, _ = population.prefill(population.init())
    prefilled = _host(state)
    state, _ = population.train_chunk(state)
    for index, seed in enumerate((3, 4)):
        program = make_program(config, point_env(4))
        expected, _ = program.prefill(program.init(jax.random.key(seed)))
        differ = unequal(member_state(population, prefilled, index), expected)
        # What the policy saw is kept from looking on: a forward pass, and so up to rounding.
        assert all("cache" in name and value < 1e-6 for name, value in differ.items()), differ
        expected, _ = program.train_chunk(expected)
        ours = member_state(population, state, index)
        for part in ("learner", "context", "buffer"):
            assert largest_difference(getattr(ours, part), getattr(expected, part)) < 1e-4


# --- what it costs --------------------------------------------------------------------------------


def test_what_members_have_in_common_has_no_axis(together: Trained) -> None:
    state = together.trained
    assert state.buffer.head.shape == state.buffer.size.shape == ()
    assert state.counters.env_steps.shape == ()
    assert state.counters.updates.shape == (3,)
    assert member_counters(state.counters, 2).env_steps == 320


def _flops(program: Any, *arguments: Any) -> float:
    return float(program.lower(*arguments).compile().cost_analysis()["flops"])


@pytest.mark.parametrize("task", ["native", pytest.param("jax", marks=pytest.mark.slow)])
def test_members_cost_what_they_cost_alone(hopper: Config, task: str) -> None:
    config, env = (hopper, None) if task == "native" else (point_config(), PointEnv())
    alone = make_program(config, None if env is None else point_env(4))
    one = _flops(alone.train_chunk, jax.eval_shape(alone.init, jax.random.key(0)))
    population = make_population(config, seed_members(range(4)), env=env)
    four = population.train_chunk.lower(population.abstract()).compile()
    assert one > 1e4
    assert four.cost_analysis()["flops"] <= 1.05 * 4 * one
    # Environments in JAX are reset, and random numbers for resets of the others are made, only when
    # one of them needs it: that is still a condition.
    assert len(re.findall(r" conditional\(", four.as_text())) == 1


def test_any_of_all_is_one_answer_for_all_that_are_batched() -> None:
    asked = jnp.array([[False, False], [False, True]])
    assert jax.vmap(any_of_all, out_axes=None)(asked)
    assert not jax.vmap(any_of_all, out_axes=None)(jnp.zeros((2, 2), bool))
    twice = jax.vmap(jax.vmap(any_of_all, out_axes=None), out_axes=None)
    assert jax.jit(twice)(jnp.zeros((2, 2, 2), bool).at[1, 0, 1].set(True))
    assert any_of_all(jnp.array([False, True]))


def test_the_whole_population_is_compiled_once(swept: Any) -> None:
    population, state, _ = swept
    population.train_chunk(_host(state))
    assert population.train_chunk._cache_size() == 1
    assert population.prefill._cache_size() == 1


# --- numeric settings -----------------------------------------------------------------------------

SWEPT = {
    "actor_learning_rate": 3e-3, "critic_learning_rate": 1e-4, "alpha_learning_rate": 2e-3,
    "discount": 0.9, "tau": 0.02, "alpha": 0.7, "target_entropy": -0.5, "target_return": -5.0,
    "return_scale": 50.0,
}  # fmt: skip


@pytest.fixture(scope="module")
def swept() -> Any:
    """One member for each setting, after a chunk; and the program for one."""
    config = point_config(prefill_env_steps=80, chunk_env_steps=40)
    members = [Member("plain", 5), *(Member(n, 5, {n: value}) for n, value in SWEPT.items())]
    population = make_population(config, members, env=PointEnv())
    state, _ = population.prefill(population.init())
    state, _ = population.train_chunk(state)
    return population, state, make_program(config, point_env(4))


@pytest.mark.parametrize("name", SWEPT)
def test_a_setting_of_a_member_does_what_it_does_in_the_configuration(
    swept: Any, name: str
) -> None:
    population, state, program = swept
    index = [member.name for member in population.members].index(name)
    hyper = hyperparameters(population.config.replace(**{name: SWEPT[name]}), 1)
    expected, _ = program.prefill(program.init(jax.random.key(5), hyper))
    expected, _ = program.train_chunk(expected)
    ours = member_state(population, state, index)
    assert largest_difference(ours.learner, expected.learner) < 1e-4
    plain = member_state(population, state, 0)
    assert largest_difference(plain.learner, expected.learner) > 1e-3


def test_a_member_with_a_setting_that_cannot_work_is_refused() -> None:
    config = point_config()
    make = partial(make_population, env=PointEnv())
    with pytest.raises(ConfigError, match=r"discount=1.5"):
        make(config, [Member("a", 0), Member("b", 0, {"discount": 1.5})])
    with pytest.raises(ConfigError, match=r"'batch_size'.*actor_learning_rate"):
        make(config, [Member("a", 0, {"batch_size": 8})])
    with pytest.raises(ConfigError, match=r"'lr'"):
        make(config, [Member("a", 0, {"lr": 8})])
    for run, own in (("auto", 5.0), (5.0, "auto")):
        asking = config.replace(target_return=run)
        with pytest.raises(ConfigError, match=f"target_return={own!r} in a run .*{run!r}"):
            make(asking, [Member("a", 0, {"target_return": own})])
    with pytest.raises(ConfigError, match="two members are called 'a'"):
        make(config, [Member("a", 0), Member("a", 1)])
    with pytest.raises(ConfigError, match="at least one"):
        make(config, [])


# --- devices --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("devices", "message"),
    [
        (Devices(members=2), r"seed_devices=2: must be at least 1 and divide members=3"),
        (Devices(members=0), r"seed_devices=0"),
        (Devices(data=3), r"data_devices=3: .* num_envs=4"),
        (Devices(data=4), r"there are 1 devices"),
        (Devices(members=3), r"there are 1 devices"),
    ],
    ids=str,
)
def test_devices_that_cannot_be_had_are_refused(devices: Devices, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_population(point_config(), seed_members(range(3)), devices, PointEnv())

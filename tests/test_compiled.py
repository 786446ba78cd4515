"""What can be said exactly of speed: of the compiled programs' arithmetic, copies, memory."""

from __future__ import annotations

import math
import re
from typing import Any

import jax
import pytest
from probe import EPISODE, point_config, point_env

from sacformer_jax.config import Config
from sacformer_jax.digests import num_bytes
from sacformer_jax.envs.core import EnvSpec
from sacformer_jax.train import make_program

RING = 997  # a length that no other array has

CASES: dict[str, dict[str, Any]] = {
    "one_env_one_update": {"num_envs": 1},
    "four_envs": {"num_envs": 4, "updates_per_env_step": 0.5},
    "one_update_of_many_envs": {"num_envs": 4, "updates_per_env_step": 0.25},
    "hindsight": {"num_envs": 1, "return_conditioning": "hindsight"},
    "scattered": {"num_envs": 1, "window": "scattered"},
    "sac": {"num_envs": 1, "agent": "sac", "context_length": 1, "return_conditioning": "none"},
}


def compiled_chunk(seeds: int = 0, **fields: Any) -> Any:
    """The compiled ``train_chunk``, vmapped over seeds if there are any, and the state's shapes."""
    num_envs = fields["num_envs"]
    config = point_config(buffer_capacity=RING * num_envs, chunk_env_steps=40, **fields)
    program = make_program(config, point_env(num_envs))
    init, chunk = program.init, program.train_chunk
    keys = jax.random.key(0)
    if seeds:
        keys, init = jax.random.split(keys, seeds), jax.vmap(program.init)
        chunk = jax.jit(jax.vmap(program.train_chunk), donate_argnums=0)
    state = jax.eval_shape(init, keys)
    return chunk.lower(state).compile(), state


def copies_of_the_ring(compiled: Any) -> list[str]:
    """Instructions that copy an array with the ring's length among its axes."""
    shaped = rf"= \S*\[(\d+,)*{RING}(,\d+)*\]\S* "
    return [
        line.strip()
        for line in compiled.as_text().splitlines()
        if re.search(shaped + r"copy(-start)?\(", line)
    ]


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="reads the CPU's HLO")
@pytest.mark.parametrize("case", CASES)
def test_a_chunk_never_copies_the_replay(case):
    compiled, state = compiled_chunk(**CASES[case])
    assert f",{RING}" in compiled.as_text()  # the ring is there, by this name
    assert copies_of_the_ring(compiled) == []
    # Donated: the state after is where the state before was.
    memory = compiled.memory_analysis()
    assert memory.alias_size_in_bytes >= num_bytes(state)
    assert memory.temp_size_in_bytes < num_bytes(state.buffer) + 2_000_000


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="reads the CPU's HLO")
def test_seeds_never_copy_the_replay():
    compiled, _ = compiled_chunk(seeds=2, **CASES["one_env_one_update"])
    assert copies_of_the_ring(compiled) == []


def products_of_an_update(config: Config, spec: EnvSpec) -> int:
    """Floating-point operations of the matrix products, counted by hand (attention's left out)."""
    batch, steps = config.replay.batch_size, config.context.context_length
    width, layers = config.actor.actor_width, config.actor.actor_layers

    def actor(states: int) -> int:
        """Forward, G and S tokens of so many states of a window."""
        # Of width x width: 4 in attention, 8 in the MLP; in the last block, only keys and values
        # are needed of G tokens.
        whole, keys_values, rest = 12, 2, 10
        per_window = (layers - 1) * 2 * states * whole + 2 * states * keys_values + states * rest
        return 2 * batch * per_window * width**2

    first = (spec.obs_size + spec.action_size) * config.critic.critic_width
    hidden = config.critic.critic_width**2
    critics = 2 * 2 * batch * steps  # multiply and add, twins
    # Targets; forward, and both gradients but for the inputs'; through them into the actor.
    twins = critics * ((first + hidden) + (2 * first + 3 * hidden) + 2 * (first + hidden))
    # The state after the K of a window is never differentiated.
    return 3 * actor(steps) + actor(1) + twins


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="counts differ between backends")
def test_an_update_does_no_more_than_its_products():
    """At the paper's size; the tenth beyond them is dropout's bits and all that is elementwise."""
    config = Config.from_preset(
        "paper", env="HalfCheetah", engine="native", acting_context="window"
    )
    program, key = make_program(config), jax.random.key(0)
    state = jax.eval_shape(program.init, key)
    window = jax.eval_shape(
        lambda buffer: program.buffer.sample(buffer, key, config.replay.batch_size, 0.99),
        state.buffer,
    )
    lowered = jax.jit(program.agent.update).lower(state.learner, state.hyper, window, key)
    costs: Any = lowered.compile().cost_analysis()
    expected = products_of_an_update(config, program.env.spec)
    assert expected < costs["flops"] < 1.1 * expected


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="reads the CPU's HLO")
def test_rotary_angles_are_computed_once():
    """In a loop over the window's steps, not wherever queries and keys are turned."""
    batch, steps, width = 32, 7, 16
    config = point_config(
        num_envs=1, time_embedding="rotary", context_length=steps, batch_size=batch
    )
    assert (config.actor.actor_width, config.actor.actor_heads) == (width, 1)
    program, key = make_program(config, point_env(1)), jax.random.key(0)
    state = jax.eval_shape(program.init, key)
    update = jax.jit(program.update).lower(state.buffer, state.hyper, state.learner, key)
    shapes = re.findall(r"= f32\[([\d,]+)\]\S* sine\(", update.compile().as_text())
    sizes = [math.prod(map(int, shape.split(","))) for shape in shapes]
    assert sizes
    assert max(sizes) == batch * width // 2


def test_memory_of_the_replay_is_that_of_its_steps():
    config = Config.from_preset("paper", env="HalfCheetah")
    program = make_program(point_config(num_envs=1, buffer_capacity=100_000), point_env(1))
    state = jax.eval_shape(program.init, jax.random.key(0))
    # obs 2, action 1, reward, return so far, time step; terminated, truncated, bad physics.
    step = 4 * (2 + 1 + 1 + 1 + 1) + 3
    assert num_bytes(state.buffer) < 1.1 * 100_000 * step
    assert config.replay.buffer_capacity == 1_000_000
    assert EPISODE < RING

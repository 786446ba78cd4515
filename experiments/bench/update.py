"""Part `update`: one gradient update of SACFormer, its sampling included."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bench.clock import GEMM_FLOPS, Clock
from sacformer_jax import Config, make_program
from sacformer_jax.train import Program
from sacformer_jax.types import BufferState, LearnerState, TrainState

UPDATES = 10
"""Updates in one call, as in training."""
CASES: dict[str, dict[str, Any]] = {
    "paper": {"preset": "paper"},
    "paper_without_dropout": {"preset": "paper", "actor_dropout": 0.0},
    "cpu": {"preset": "cpu"},
}


def full_buffer(program: Program, state: TrainState) -> BufferState:
    """The replay filled with random episodes of full length, none of them running."""
    buffer, limit = program.buffer, program.env.max_episode_steps
    rng = np.random.default_rng(0)
    steps = state.buffer.steps
    time_step = np.broadcast_to(np.arange(buffer.length) % limit, steps.reward.shape)
    numbers = {
        name: jnp.asarray(rng.normal(size=getattr(steps, name).shape), jnp.float32)
        for name in ("obs", "reward")
    }
    return dataclasses.replace(
        state.buffer,
        steps=dataclasses.replace(
            steps,
            action=jnp.asarray(rng.uniform(-1, 1, steps.action.shape), jnp.float32),
            truncated=jnp.asarray(time_step == limit - 1),
            time_step=jnp.asarray(time_step, jnp.int32),
            **numbers,
        ),
        size=jnp.int32(buffer.length),
    )


def updater(program: Program, state: TrainState) -> Callable[[LearnerState], LearnerState]:
    """``UPDATES`` updates from the state's replay in one donated call."""
    batch_size = program.config.replay.batch_size

    def one(buffer: BufferState, learner: LearnerState, key: jax.Array) -> Any:
        sample_key, update_key = jax.random.split(key)
        window = program.buffer.sample(buffer, sample_key, batch_size, state.hyper.rtg_discount)
        return program.agent.update(learner, state.hyper, window, update_key)

    @partial(jax.jit, donate_argnums=1)
    def run(buffer: BufferState, learner: LearnerState) -> LearnerState:
        keys = jax.random.split(jax.random.key(0), UPDATES)
        return jax.lax.scan(partial(one, buffer), learner, keys)[0]

    return partial(run, state.buffer)


def measure(clock: Clock) -> dict[str, float]:
    """All cases by flat keys ``update.CASE.ms``, ``.gemm_units``, ``.flops``, ``.peak_share``."""
    results: dict[str, float] = {}
    for case, fields in CASES.items():
        program = make_program(Config.from_preset(env="HalfCheetah", engine="native", **fields))
        state = jax.jit(program.init)(jax.random.key(0))
        state = dataclasses.replace(state, buffer=full_buffer(program, state))
        run = updater(program, state)
        learner = state.learner

        def again(run: Any = run) -> LearnerState:
            nonlocal learner
            learner = run(learner)
            return learner

        milliseconds = clock.milliseconds(again, UPDATES)
        window = program.buffer.sample(
            state.buffer, jax.random.key(0), program.config.replay.batch_size, jnp.float32(0.99)
        )
        update = jax.jit(program.agent.update).lower(
            learner, state.hyper, window, jax.random.key(0)
        )
        costs: Any = update.compile().cost_analysis()
        flops = float(costs["flops"])
        units = milliseconds / clock.gemm_ms
        results |= {
            f"update.{case}.ms": milliseconds,
            f"update.{case}.gemm_units": units,
            f"update.{case}.flops": flops,
            f"update.{case}.peak_share": flops / GEMM_FLOPS / units,
            f"update.{case}.sampling_share": sampling_ms(clock, program, state) / milliseconds,
        }
    return results


def sampling_ms(clock: Clock, program: Program, state: TrainState) -> float:
    """Drawing a batch alone, ``UPDATES`` of them in one call."""
    batch_size = program.config.replay.batch_size

    @jax.jit
    def run(buffer: BufferState, key: jax.Array) -> jax.Array:
        def draw(total: jax.Array, key: jax.Array) -> tuple[jax.Array, None]:
            window = program.buffer.sample(buffer, key, batch_size, state.hyper.rtg_discount)
            # All of it must be made: its sum is kept.
            leaves = jax.tree.leaves(window)
            return total + sum(leaf.sum(dtype=jnp.float32) for leaf in leaves), None

        return jax.lax.scan(draw, jnp.float32(0), jax.random.split(key, UPDATES))[0]

    return clock.milliseconds(partial(run, state.buffer, jax.random.key(0)), UPDATES)

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
from sacformer_jax.agents import sac_update
from sacformer_jax.agents.adam import Adam
from sacformer_jax.agents.sac_policy import SACParts, window_policies
from sacformer_jax.train import Program
from sacformer_jax.types import (
    BufferState,
    Hyperparameters,
    LearnerState,
    Params,
    TrainState,
    Window,
)

UPDATES = 10
"""Updates in one call, as in training."""
CASES: dict[str, dict[str, Any]] = {
    "paper": {"preset": "paper"},
    "paper_without_dropout": {"preset": "paper", "actor_dropout": 0.0},
    "cpu": {"preset": "cpu"},
    "sac": {"preset": "paper", "agent": "sac"},
}
WITH_PHASES = ("paper", "cpu", "sac")


def full_buffer(program: Program, state: TrainState) -> BufferState:
    """The replay filled with random episodes of full length, none of them running."""
    buffer, limit = program.buffer, program.env.max_episode_steps
    rng = np.random.default_rng(0)
    assert state.buffer is not None
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


def repeated(body: Callable[..., Any], carry: Any, *fixed: Any) -> Callable[[], Any]:
    """``UPDATES`` turns of ``body(*fixed, carry, key) -> carry`` in one donated call; the next call
    goes on from there.
    """

    @partial(jax.jit, donate_argnums=0)
    def turns(carry: Any, fixed: Any) -> Any:
        keys = jax.random.split(jax.random.key(0), UPDATES)
        return jax.lax.scan(lambda carry, key: (body(*fixed, carry, key), None), carry, keys)[0]

    # A copy: the carry is donated, and others may need it.
    state = jax.tree.map(jnp.copy, carry)

    def run() -> Any:
        nonlocal state
        state = turns(state, fixed)
        return state

    return run


def updater(program: Program, state: TrainState) -> Callable[[], LearnerState]:
    """``UPDATES`` updates from the state's replay."""

    def one(
        buffer: BufferState, hyper: Hyperparameters, learner: LearnerState, key: jax.Array
    ) -> LearnerState:
        return program.update(buffer, hyper, learner, key)[0]

    return repeated(one, state.learner, state.buffer, state.hyper)


def batch_of(program: Program, state: TrainState) -> Window:
    """A batch from the state's replay."""
    assert state.buffer is not None
    return program.buffer.sample(
        state.buffer,
        jax.random.key(0),
        program.config.replay.batch_size,
        state.hyper.rtg_discount,
    )


def phases(program: Program, state: TrainState) -> dict[str, Callable[[], Any]]:
    """The parts of an update, each by itself on a batch that stays the same."""
    parts, hyper, learner = sac_parts_of(program), state.hyper, state.learner
    batch_size, window = program.config.replay.batch_size, batch_of(program, state)
    shown = window_policies(parts, learner.actor_params, learner, hyper, window, jax.random.key(0))
    inputs = sac_update.critic_inputs(parts, learner, window, shown)

    def sample(buffer: BufferState, total: jax.Array, key: jax.Array) -> jax.Array:
        drawn = program.buffer.sample(buffer, key, batch_size, hyper.rtg_discount)
        # All of it must be made: its sum is kept.
        return total + sum(leaf.sum(dtype=jnp.float32) for leaf in jax.tree.leaves(drawn))

    def actor(params: Params, key: jax.Array) -> Params:
        def policies(params: Params) -> Any:
            both = window_policies(parts, params, learner, hyper, window, key)
            return both.now, both.following

        now, pull_back, following = jax.vjp(policies, params, has_aux=True)
        # What follows is needed, too, but not differentiated.
        nudge = 1e-12 * sum(leaf.sum() for leaf in jax.tree.leaves(following))
        return jax.tree.map(lambda p, grad: p - 1e-9 * grad - nudge, params, *pull_back(now))

    def critics(params: Params, key: jax.Array) -> Params:
        action = window.action + 0.0 * jax.random.uniform(key)
        y = parts.critics.following(learner.target_critic_params, inputs, action).min(axis=0)

        def loss(params: Params) -> jax.Array:
            return jnp.mean((parts.critics.now(params, inputs, window.action) - y) ** 2)

        def value(action: jax.Array) -> jax.Array:
            return jnp.mean(parts.critics.now(params, inputs, action).min(axis=0))

        nudge = 1e-12 * jax.grad(value)(action).sum()
        return jax.tree.map(lambda p, grad: p - 1e-9 * grad - nudge, params, jax.grad(loss)(params))

    def optimizer(learner: LearnerState, key: jax.Array) -> LearnerState:
        def step(params: Params, opt: Any) -> Any:
            rate, sound = 1e-9 * jax.random.uniform(key), jnp.array(True)
            return Adam().step_where(sound, params, params, opt, rate)

        actor_params, actor_opt = step(learner.actor_params, learner.actor_opt)
        critic_params, critic_opt = step(learner.critic_params, learner.critic_opt)
        target = sac_update.soft_update(learner.target_critic_params, critic_params, hyper.tau)
        return dataclasses.replace(
            learner,
            actor_params=actor_params,
            actor_opt=actor_opt,
            critic_params=critic_params,
            critic_opt=critic_opt,
            target_critic_params=target,
        )

    return {
        "sample": repeated(sample, jnp.float32(0), state.buffer),
        "actor": repeated(actor, learner.actor_params),
        "critics": repeated(critics, learner.critic_params),
        "optimizer": repeated(optimizer, learner),
    }


def sac_parts_of(program: Program) -> SACParts:
    """The static parts that the program's update was bound to."""
    update: Any = program.agent.update
    parts: SACParts = update.args[0]
    return parts


def flops_of(program: Program, state: TrainState) -> float:
    """Floating-point operations of an update without sampling, as XLA counts them."""
    update = jax.jit(program.agent.update).lower(
        state.learner, state.hyper, batch_of(program, state), jax.random.key(0)
    )
    costs: Any = update.compile().cost_analysis()
    return float(costs["flops"])


def measure(clock: Clock) -> dict[str, float]:
    """By flat keys.

    ``update.CASE.ms``, ``.gemm_units``, ``.flops`` and ``.peak_share`` (of the rate of the GEMM
    unit) of the cases; ``.sample_share``, ``.actor_share``, ``.critics_share`` and
    ``.optimizer_share`` of the phases, each timed by itself (together they may come to more or less
    than the whole, in which XLA runs some beside others); ``update.paper.dropout_share``, from the
    paper's case without it.
    """
    results: dict[str, float] = {}
    runs: dict[str, Callable[[], Any]] = {}
    flops: dict[str, float] = {}
    for case, fields in CASES.items():
        program = make_program(Config.from_preset(env="HalfCheetah", engine="native", **fields))
        state = jax.jit(program.init)(jax.random.key(0))
        state = dataclasses.replace(state, buffer=full_buffer(program, state))
        runs[case] = updater(program, state)
        flops[case] = flops_of(program, state)
        if case in WITH_PHASES:
            parts = phases(program, state)
            runs |= {f"{case}.{phase}": run for phase, run in parts.items()}
    times = clock.side_by_side(runs, UPDATES, repetitions=15)
    for case in CASES:
        units = times[case] / clock.gemm_ms
        results |= {
            f"update.{case}.ms": times[case],
            f"update.{case}.gemm_units": units,
            f"update.{case}.flops": flops[case],
            f"update.{case}.peak_share": flops[case] / GEMM_FLOPS / units,
        }
    for name in runs:
        case, _, phase = name.partition(".")
        if phase:
            results[f"update.{case}.{phase}_share"] = times[name] / times[case]
    results["update.paper.dropout_share"] = 1 - times["paper_without_dropout"] / times["paper"]
    return results

"""Evaluation on our environments, jitted."""

from __future__ import annotations

from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp

from sacformer_jax import context as contexts
from sacformer_jax.agents.core import Agent
from sacformer_jax.envs.core import VectorEnv, VectorEnvState
from sacformer_jax.parallel import any_of_all
from sacformer_jax.types import Context, PolicyState

_ACTING_STREAM = 2**31
"""Folded into the key: beyond the small numbers by which the environments split it."""


@flax.struct.dataclass
class Evaluation:
    """Outcome of E episodes.

    Attributes:
      returns: ``[E]`` undiscounted sums of reward.
      lengths: int32 ``[E]`` steps.
    """

    returns: jax.Array
    lengths: jax.Array


@flax.struct.dataclass
class _Progress:
    env: VectorEnvState
    context: Context
    key: jax.Array
    running: jax.Array
    result: Evaluation


def make_evaluator(
    env: VectorEnv, agent: Agent, context_length: int
) -> Callable[[PolicyState, jax.Array], Evaluation]:
    """``evaluate(policy, key) -> Evaluation`` of one episode in each of the N environments.

    Actions are the policy's mean actions. Jitted; stops when the last episode ends.
    """

    def step(policy: PolicyState, progress: _Progress) -> _Progress:
        key, act_key = jax.random.split(progress.key)
        acted = agent.act(policy, progress.context, act_key, explore=False)
        env_state, step = env.step(progress.env, acted.action)
        reward = jnp.where(progress.running, step.reward, 0.0)
        return _Progress(
            env=env_state,
            context=contexts.advance(acted, step.next_obs, step.reward, step.done),
            key=key,
            running=progress.running & ~step.done,
            result=Evaluation(
                returns=progress.result.returns + reward,
                lengths=progress.result.lengths + progress.running,
            ),
        )

    @jax.jit
    def evaluate(policy: PolicyState, key: jax.Array) -> Evaluation:
        env_state = env.init(key)
        cache = agent.init_cache(env.num_envs)
        progress = _Progress(
            env=env_state,
            context=contexts.start(env_state.obs, context_length, env.spec.action_size, cache),
            key=jax.random.fold_in(key, _ACTING_STREAM),
            running=jnp.ones(env.num_envs, bool),
            result=Evaluation(
                returns=jnp.zeros(env.num_envs), lengths=jnp.zeros(env.num_envs, jnp.int32)
            ),
        )
        progress = jax.lax.while_loop(
            lambda progress: any_of_all(progress.running),
            lambda progress: step(policy, progress),
            progress,
        )
        return progress.result

    return evaluate

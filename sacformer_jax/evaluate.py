"""Evaluation on our environments, jitted."""

from __future__ import annotations

import dataclasses
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
      bad: bool ``[E]``, whose physics broke down: it was cut off there.
    """

    returns: jax.Array
    lengths: jax.Array
    bad: jax.Array


@flax.struct.dataclass
class Episodes:
    """One episode in each of N environments, on their way.

    Attributes:
      env: the environments; those whose episode has ended go on with others, which do not count.
      context: the acting contexts.
      key: typed PRNG key of acting.
      running: bool ``[N]``, whose episode has not ended.
      result: what there is of it so far.
    """

    env: VectorEnvState
    context: Context
    key: jax.Array
    running: jax.Array
    result: Evaluation


@dataclasses.dataclass(frozen=True)
class EpisodeFunctions:
    """Evaluation's episodes as pure functions, for whoever wants to look at their steps.

    Attributes:
      start: ``(key) -> Episodes``.
      step: ``(policy, Episodes) -> Episodes``, under the policy's mean actions.
    """

    start: Callable[[jax.Array], Episodes]
    step: Callable[[PolicyState, Episodes], Episodes]


def episode_functions(env: VectorEnv, agent: Agent, context_length: int) -> EpisodeFunctions:
    """The functions that :func:`make_evaluator` is made of."""

    def start(key: jax.Array) -> Episodes:
        env_state = env.init(key)
        cache = agent.init_cache(env.num_envs)
        return Episodes(
            env=env_state,
            context=contexts.start(env_state.obs, context_length, env.spec.action_size, cache),
            key=jax.random.fold_in(key, _ACTING_STREAM),
            running=jnp.ones(env.num_envs, bool),
            result=Evaluation(
                returns=jnp.zeros(env.num_envs),
                lengths=jnp.zeros(env.num_envs, jnp.int32),
                bad=jnp.zeros(env.num_envs, bool),
            ),
        )

    def step(policy: PolicyState, episodes: Episodes) -> Episodes:
        key, act_key = jax.random.split(episodes.key)
        acted = agent.act(policy, episodes.context, act_key, explore=False)
        env_state, step = env.step(episodes.env, acted.action)
        reward = jnp.where(episodes.running, step.reward, 0.0)
        return Episodes(
            env=env_state,
            context=contexts.advance(acted, step.next_obs, step.reward, step.done),
            key=key,
            running=episodes.running & ~step.done,
            result=Evaluation(
                returns=episodes.result.returns + reward,
                lengths=episodes.result.lengths + episodes.running,
                bad=episodes.result.bad | (episodes.running & step.bad),
            ),
        )

    return EpisodeFunctions(start, step)


def make_evaluator(
    env: VectorEnv, agent: Agent, context_length: int
) -> Callable[[PolicyState, jax.Array], Evaluation]:
    """``evaluate(policy, key) -> Evaluation`` of one episode in each of the N environments.

    Actions are the policy's mean actions. Jitted; stops when the last episode ends.
    """
    functions = episode_functions(env, agent, context_length)

    @jax.jit
    def evaluate(policy: PolicyState, key: jax.Array) -> Evaluation:
        episodes = jax.lax.while_loop(
            lambda episodes: any_of_all(episodes.running),
            lambda episodes: functions.step(policy, episodes),
            functions.start(key),
        )
        return episodes.result

    return evaluate

"""An ordinary Gymnasium environment, stepped on the host from inside jit.

It is pure: a state is the seed of the reset and the actions since, from which the host can bring an
environment to the same place again (see :mod:`sacformer_jax.envs.gym_host`). So states can be
copied, stepped twice, saved and restored in another process, as long as the environment goes the
same way from the same seed and actions. One that does not has the episodes cut off that would have
to be done again; all else works.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections import defaultdict
from collections.abc import Callable, Iterator

import flax.struct
import jax
import jax.numpy as jnp

from sacformer_jax.envs import gym_registry
from sacformer_jax.envs.core import EnvSpec, EnvStep, where_tree
from sacformer_jax.envs.gym_host import GymHost
from sacformer_jax.envs.gym_live import TOKEN_WORDS
from sacformer_jax.envs.gym_registry import Found
from sacformer_jax.envs.host_call import HostCall
from sacformer_jax.parallel import any_of_all


@flax.struct.dataclass
class GymState:
    """How one environment came to where it is.

    Attributes:
      seed: uint32, of the reset.
      length: int32, steps since.
      token: uint32 ``[4]``, the host's hash over all that was done and seen.
      actions: ``[T, A]`` float32, the first ``length`` are those of this episode.
    """

    seed: jax.Array
    length: jax.Array
    token: jax.Array
    actions: jax.Array


class GymEnv:
    """An environment of Gymnasium's registry with continuous actions and vector observations.

    Args:
      env_id: its id, also ``"module:ID"`` for one that a module registers.
      max_episode_steps: the longest episode, for which states have room; default: the id's own
        time limit.

    Raises:
      ConfigError: there is no such id, a package it needs is missing, or its spaces are of another
        kind.
    """

    def __init__(self, env_id: str, max_episode_steps: int | None = None):
        registered = gym_registry.registered(env_id)
        limit = max_episode_steps or gym_registry.time_limit(registered)
        self.longest_episode = limit
        shared = _shared_host(env_id, limit, str(registered))
        self.host, self._host_calls = shared.host, shared.host_calls
        self.spec = EnvSpec(
            name=f"gym:{env_id}",
            obs_size=self.host.facts.obs_size,
            action_size=self.host.facts.action_size,
            action_low=shared.found.action_low,
            action_high=shared.found.action_high,
            max_episode_steps=limit,
            engine="gymnasium",
            engine_reason="on the host, one environment after the other",
            gymnasium_id=env_id,
        )

    def reset(self, key: jax.Array) -> tuple[GymState, jax.Array]:
        return self._fresh(_seed(key), self._call("reset", 1, _seed(key)[None])[0])

    def step(self, state: GymState, action: jax.Array) -> tuple[GymState, EnvStep]:
        (row,) = self._call("step", 1, _operand(state, action), state.actions)
        return self._stepped(state, action, row)

    def step_and_refill(
        self,
        states: GymState,
        actions: jax.Array,
        refill: jax.Array,
        prepared: tuple[GymState, jax.Array],
        keys: Callable[[], jax.Array],
    ) -> tuple[tuple[GymState, EnvStep], tuple[GymState, jax.Array]]:
        seeds = jax.lax.cond(
            any_of_all(refill),
            lambda: jax.vmap(_seed)(keys()),
            lambda: jnp.zeros(len(refill), jnp.uint32),
        )

        def step(
            state: GymState, action: jax.Array, refill: jax.Array, seed: jax.Array
        ) -> tuple[tuple[GymState, EnvStep], tuple[GymState, jax.Array]]:
            more = jnp.stack([refill.astype(jnp.uint32), seed])
            operand = jnp.concatenate([_operand(state, action), more])
            rows = self._call("step_and_reset", 2, operand, state.actions)
            return self._stepped(state, action, rows[0]), self._fresh(seed, rows[1])

        stepped, fresh = jax.vmap(step)(states, actions, refill, seeds)
        # No actions of a fresh episode are looked at, so they need not be chosen between.
        fresh = (dataclasses.replace(fresh[0], actions=prepared[0].actions), fresh[1])
        return stepped, where_tree(refill, fresh, prepared)

    def _call(self, name: str, num_rows: int, *operands: jax.Array) -> list[jax.Array]:
        size = self.host.facts.row_size
        result = jax.ShapeDtypeStruct((num_rows * size,), jnp.uint32)
        (words,) = self._host_calls[name]((result,), *operands)
        return [words[i * size : (i + 1) * size] for i in range(num_rows)]

    def _fresh(self, seed: jax.Array, row: jax.Array) -> tuple[GymState, jax.Array]:
        facts = self.host.facts
        state = GymState(
            seed=seed,
            length=jnp.zeros((), jnp.int32),
            token=row[:TOKEN_WORDS],
            actions=jnp.zeros((facts.max_steps, facts.action_size)),
        )
        return state, _floats(row)[: facts.obs_size]

    def _stepped(
        self, state: GymState, action: jax.Array, row: jax.Array
    ) -> tuple[GymState, EnvStep]:
        numbers, end = _floats(row), self.host.facts.obs_size
        next_state = GymState(
            seed=state.seed,
            length=state.length + 1,
            token=row[:TOKEN_WORDS],
            actions=state.actions.at[state.length].set(action),
        )
        terms = zip(self.host.facts.reward_terms, numbers[end + 4 :], strict=True)
        return next_state, EnvStep(
            obs=numbers[:end],
            reward=numbers[end],
            terminated=numbers[end + 1] > 0.5,
            truncated=numbers[end + 2] > 0.5,
            bad=numbers[end + 3] > 0.5,
            reward_terms=dict(terms),
        )


def _seed(key: jax.Array) -> jax.Array:
    """A seed for ``env.reset``, below 2**31, which any of them takes."""
    return jax.random.bits(key, (), jnp.uint32) >> 1


def _floats(row: jax.Array) -> jax.Array:
    return jax.lax.bitcast_convert_type(row[TOKEN_WORDS:], jnp.float32)


def _operand(state: GymState, action: jax.Array) -> jax.Array:
    head = jnp.stack([state.seed, state.length.astype(jnp.uint32)])
    words = jax.lax.bitcast_convert_type(action.astype(jnp.float32), jnp.uint32)
    return jnp.concatenate([head, state.token, words])


@dataclasses.dataclass(frozen=True)
class _SharedHost:
    """The process's host of an id: pure, so one is enough for all programs."""

    found: Found
    host: GymHost
    host_calls: dict[str, HostCall]


_NUMBERS: dict[str, Iterator[int]] = defaultdict(itertools.count)
"""Hosts are numbered by id: in programs that make them in the same order, alike."""


@functools.cache
def _shared_host(env_id: str, max_steps: int, registered: str) -> _SharedHost:
    """Made anew where another environment is ``registered`` under the id."""
    found = gym_registry.find(env_id, max_steps)
    host = GymHost(found.facts, found.env)
    name = f"sacformer_jax.gym.{env_id}.{max_steps}"
    number = next(_NUMBERS[name])
    host_calls = {
        function.__name__: HostCall(f"{name}.{number}.{function.__name__}", function)
        for function in (host.reset, host.step, host.step_and_reset)
    }
    return _SharedHost(found, host, host_calls)

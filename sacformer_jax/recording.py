"""Evaluation's episodes step by step: the same program, looked into on its way."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sacformer_jax.agents.core import Agent
from sacformer_jax.envs import VectorEnv
from sacformer_jax.evaluate import Episodes, episode_functions
from sacformer_jax.types import PolicyState

Look = Callable[[Episodes], Any]
"""What is kept of each step: a pure function to arrays that lead with the N environments."""


@dataclasses.dataclass(frozen=True)
class Recording:
    """E episodes as an evaluation with the same seed runs them.

    Attributes:
      seen: what was looked at, at the states acted on: NumPy leaves ``[T, E, ...]``, T steps of the
        longest episode; from an episode's end on they are of others.
      return_so_far: float32 ``[T + 1, E]``, reward collected before each state; the last row holds
        the returns.
      lengths: int ``[E]`` steps.
    """

    seen: Any
    return_so_far: np.ndarray
    lengths: np.ndarray

    @property
    def returns(self) -> np.ndarray:
        """``[E]``, those of the evaluation."""
        return self.return_so_far[-1]


class Recorder:
    """Runs episodes and keeps what is looked at; compiles once.

    Args:
      env: the environments, one episode in each.
      agent: the algorithm.
      context_length: K.
      look: what is kept of each step.
    """

    def __init__(self, env: VectorEnv, agent: Agent, context_length: int, look: Look):
        functions = episode_functions(env, agent, context_length)

        # A loop of one step, so that a step compiles as it does within an evaluation's loop:
        # rounding, and with it a chaotic trajectory, stays the same.
        @jax.jit
        def step(policy: PolicyState, episodes: Episodes) -> Episodes:
            return jax.lax.while_loop(
                lambda both: jnp.any(both[1].running) & (both[0] < 1),
                lambda both: (both[0] + 1, functions.step(policy, both[1])),
                (jnp.int32(0), episodes),
            )[1]

        self._start, self._step, self._look = jax.jit(functions.start), step, jax.jit(look)

    def record(self, policy: PolicyState, seed: int) -> Recording:
        """Runs an episode in each environment; ``seed`` is an evaluation's."""
        episodes = self._start(jax.random.key(seed))
        seen, returns = [], [np.asarray(episodes.result.returns)]
        while np.any(episodes.running):
            seen.append(jax.tree.map(np.asarray, self._look(episodes)))
            episodes = self._step(policy, episodes)
            returns.append(np.asarray(episodes.result.returns))
        return Recording(
            seen=jax.tree.map(lambda *steps: np.stack(steps), *seen),
            return_so_far=np.stack(returns),
            lengths=np.asarray(episodes.result.lengths),
        )

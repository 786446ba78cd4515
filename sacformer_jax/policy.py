"""Deploying: a trained policy as a pure function and as a small object for a Gymnasium loop."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from sacformer_jax import agents, checkpoint
from sacformer_jax import context as contexts
from sacformer_jax.agents.core import Agent
from sacformer_jax.config import Config
from sacformer_jax.envs.core import EnvSpec
from sacformer_jax.types import Acted, PolicyState


@flax.struct.dataclass
class _Memory:
    """What a policy keeps between steps: its last step, and the key of the next."""

    last: Acted
    key: jax.Array


class Policy:
    """A trained policy.

    Attributes:
      config: the configuration it was trained with.
      spec: facts of the environment it was trained on.
      state: parameters, normalizer and target return.
      agent: the algorithm; ``agent.act`` is the pure acting function.

    Example:
      >>> policy = load_policy("runs/my-run")
      >>> obs, _ = env.reset()
      >>> policy.reset()
      >>> reward = 0.0
      >>> while True:
      ...     action = policy.predict(obs, reward)
      ...     obs, reward, terminated, truncated, info = env.step(action)
    """

    def __init__(self, config: Config, spec: EnvSpec, agent: Agent, state: PolicyState):
        self.config, self.spec, self.agent, self.state = config, spec, agent, state
        self._act = jax.jit(self._acting, donate_argnums=1)
        self.reset()

    def reset(self) -> None:
        """Forgets the episode so far; call it at each ``env.reset()``."""
        spec, context_length = self.spec, self.config.context.context_length
        cache = self.agent.init_cache(1)
        context = contexts.empty(1, context_length, spec.obs_size, spec.action_size, cache)
        last = Acted(action=jnp.zeros((1, spec.action_size)), context=context)
        self._memory = _Memory(last, jax.random.key(0))
        self._first = True

    def predict(self, obs: Any, reward: float = 0.0) -> np.ndarray:
        """The mean action for an observation.

        Args:
          obs: ``[O]``.
          reward: what the previous step gave; ignored on the first call after ``reset``.
            The previous step is taken to have been done with the action returned.

        Returns:
          ``[A]`` float32, within the action bounds.

        Raises:
          ValueError: ``obs`` has another shape.
        """
        values = np.asarray(obs, np.float32)
        if values.shape != (self.spec.obs_size,):
            raise ValueError(f"obs of shape {values.shape}: must be ({self.spec.obs_size},)")
        self._memory = self._act(
            self.state, self._memory, values, np.float32(reward), np.bool_(self._first)
        )
        self._first = False
        return np.array(self._memory.last.action[0])

    def _acting(
        self,
        state: PolicyState,
        memory: _Memory,
        obs: jax.Array,
        reward: jax.Array,
        first: jax.Array,
    ) -> _Memory:
        key, act_key = jax.random.split(memory.key)
        # An episode's first state enters like one after a reset.
        context = contexts.advance(memory.last, obs[None], reward[None], first[None])
        return _Memory(self.agent.act(state, context, act_key, explore=False), key)


def load_policy(path: str | Path, which: str = "best") -> Policy:
    """Loads a policy from a run, without its replay.

    Args:
      path: the run's folder.
      which: ``"best"`` (highest evaluation return) or ``"latest"``.

    Raises:
      CheckpointError: there is no run or no such policy, or it is damaged.
    """
    run = checkpoint.RunFolder(path).opened()
    config, spec = run.read_config().config, run.read_spec()
    agent = agents.make(config, spec)
    return Policy(config, spec, agent, run.restore_policy(agent, which))

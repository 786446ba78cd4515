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
from sacformer_jax.types import Context, PolicyState


@flax.struct.dataclass
class Acting:
    """One step of acting: the context after it, and the action chosen."""

    context: Context
    action: jax.Array


class Policy:
    """A trained policy.

    Attributes:
      config: the configuration it was trained with.
      spec: facts of the environment it was trained on.
      state: parameters, normalizer and target return.
      agent: the algorithm; ``agent.act(state, context, None)`` is the pure acting function.

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
        self._act = jax.jit(self._acting)
        self.reset()

    def reset(self) -> None:
        """Forgets the episode so far; call it at each ``env.reset()``."""
        spec = self.spec
        self._last = Acting(
            context=contexts.empty(
                1, self.config.context.context_length, spec.obs_size, spec.action_size
            ),
            action=jnp.zeros(spec.action_size),
        )
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
        acting = self._act(
            self.state, self._last, values, np.float32(reward), np.bool_(self._first)
        )
        self._last, self._first = acting, False
        return np.array(acting.action)

    def _acting(
        self,
        state: PolicyState,
        last: Acting,
        obs: jax.Array,
        reward: jax.Array,
        first: jax.Array,
    ) -> Acting:
        # An episode's first state enters like one after a reset.
        context = contexts.advance(
            last.context, last.action[None], obs[None], reward[None], first[None]
        )
        return Acting(context, jnp.asarray(self.agent.act(state, context, None)[0]))


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

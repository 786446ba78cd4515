"""Deploying: a trained policy as a pure function and as a small object for a Gymnasium loop."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from sacformer_jax import agents
from sacformer_jax import context as contexts
from sacformer_jax.agents.core import Agent
from sacformer_jax.checkpoint import RunFolder, restore_policy
from sacformer_jax.config import Config, ConfigError
from sacformer_jax.envs.core import EnvSpec
from sacformer_jax.members import Member
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

    For a vector environment, ``policy.reset(num_envs)`` and ``episode_start`` in ``predict``.
    """

    def __init__(self, config: Config, spec: EnvSpec, agent: Agent, state: PolicyState):
        self.config, self.spec, self.agent, self.state = config, spec, agent, state
        self._act = jax.jit(self._acting, donate_argnums=1)
        self._shapes: dict[int, Acted] = {}
        self.reset()

    def reset(self, num_envs: int | None = None) -> None:
        """Forgets everything so far; call it at ``env.reset()``.

        Where dropout is on in acting, its masks start anew from the same key, so that an episode
        can be repeated.

        Args:
          num_envs: N of a vector environment; None for a single one.

        Raises:
          ValueError: ``num_envs`` is below 1.
        """
        if num_envs is not None and num_envs < 1:
            raise ValueError(f"num_envs={num_envs}: must be at least 1, or None")
        self._num_envs, self._first = num_envs, True
        nothing = self._nothing(1 if num_envs is None else num_envs)
        zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), nothing)
        self._memory = _Memory(zeros, jax.random.key(0))

    def _nothing(self, size: int) -> Acted:
        """Shapes of a last step of ``size`` environments; all zero, it is none at all."""
        if size not in self._shapes:
            spec, length = self.spec, self.config.context.context_length

            def last() -> Acted:
                cache = self.agent.init_cache(size)
                context = contexts.empty(size, length, spec.obs_size, spec.action_size, cache)
                return Acted(action=jnp.zeros((size, spec.action_size)), context=context)

            self._shapes[size] = jax.eval_shape(last)
        return self._shapes[size]

    def predict(
        self, obs: ArrayLike, reward: ArrayLike = 0.0, episode_start: ArrayLike = False
    ) -> np.ndarray:
        """The mean action for an observation, or for one of each environment.

        Args:
          obs: ``[O]``, or ``[N, O]`` after ``reset(N)``.
          reward: what the previous step gave, scalar or ``[N]``; ignored where an episode starts.
            The previous step is taken to have been done with the action returned.
          episode_start: bool, scalar or ``[N]``: where ``obs`` is the first of a new episode. On
            the first call after ``reset`` it is everywhere.

        Returns:
          ``[A]`` or ``[N, A]`` float32, within the action bounds.

        Raises:
          ValueError: an argument has another shape.
        """
        lead = () if self._num_envs is None else (self._num_envs,)
        values = np.asarray(obs, np.float32)
        expected = (*lead, self.spec.obs_size)
        if values.shape != expected:
            remedy = "" if values.ndim == len(expected) else "; reset(num_envs) sets how many"
            raise ValueError(f"obs of shape {values.shape}: must be {expected}{remedy}")
        given = {
            "reward": np.asarray(reward, np.float32),
            "episode_start": np.asarray(episode_start, bool) | self._first,
        }
        size = self._memory.last.action.shape[0]
        for name, value in given.items():
            if value.shape not in ((), lead):
                raise ValueError(f"{name} of shape {value.shape}: must be {lead}, or a scalar")
            given[name] = np.broadcast_to(value, size)
        self._memory = self._act(self.state, self._memory, values.reshape(size, -1), **given)
        self._first = False
        return np.array(self._memory.last.action).reshape(*lead, -1)

    def _acting(
        self,
        state: PolicyState,
        memory: _Memory,
        obs: jax.Array,
        reward: jax.Array,
        episode_start: jax.Array,
    ) -> _Memory:
        key, act_key = jax.random.split(memory.key)
        # An episode's first state enters like one after a reset.
        context = contexts.advance(memory.last, obs, reward, episode_start)
        return _Memory(self.agent.act(state, context, act_key, explore=False), key)


def load_policy(path: str | Path, which: str = "best", member: str | int | None = None) -> Policy:
    """Loads a policy from a run, without its replay.

    Args:
      path: the run's folder.
      which: ``"best"`` (highest evaluation return) or ``"latest"``.
      member: of a run of several, which: its seed, or its name.

    Raises:
      CheckpointError: there is no run or no such policy, or it is damaged.
      ConfigError: the run has no such member, or several and none was named.
    """
    folder = RunFolder(path).opened()
    run, spec = folder.read_config(), folder.read_spec()
    index = member_index(run.members, member)
    config = run.members[index].config(run.config)
    agent = agents.make(config, spec)
    return Policy(config, spec, agent, restore_policy(folder, agent, which, index))


def member_index(members: Sequence[Member], member: str | int | None) -> int:
    """The place of a member given by seed or name; of the only one by None.

    Raises:
      ConfigError: see :func:`load_policy`.
    """
    names = ", ".join(each.name for each in members)
    if member is None:
        if len(members) > 1:
            raise ConfigError(f"member=None: the run has several; say which: {names}")
        return 0
    found = [
        index for index, each in enumerate(members) if str(member) in (each.name, str(each.seed))
    ]
    if len(found) != 1:
        problem = "there is none such" if not found else "there are several such"
        raise ConfigError(f"member={member!r}: {problem}; the run has {names}")
    return found[0]

"""Deploying: a trained policy as a pure function, by the convention of Stable-Baselines3."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import flax.struct
import gymnasium
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

_PRNG = "threefry2x32"


@flax.struct.dataclass
class ActingState:
    """What a policy remembers between the steps of N environments; all zero, it is nothing yet.

    Attributes:
      last: its last step.
      key: uint32 ``[2]``, the words of the PRNG key of the next step: plain numbers, so that a
        state can be pickled, or held by NumPy.
    """

    last: Acted
    key: jax.Array


class Policy:
    """A trained policy.

    Attributes:
      config: the configuration it was trained with.
      spec: facts of the environment it was trained on.
      state: parameters, normalizer and target return.
      agent: the algorithm; ``agent.act`` is the pure acting function.
      observation_space: Gymnasium's space of an observation, ``[O]`` float32.
      action_space: of an action, ``[A]`` float32.

    Example:
      >>> policy = load_policy("runs/my-run")
      >>> obs, _ = env.reset()
      >>> state = reward = None
      >>> while True:
      ...     action, state = policy.predict(obs, state, reward=reward)
      ...     obs, reward, terminated, truncated, info = env.step(action)
    """

    def __init__(self, config: Config, spec: EnvSpec, agent: Agent, state: PolicyState):
        self.config, self.spec, self.agent, self.state = config, spec, agent, state
        low, high = (np.array(bound, np.float32) for bound in (spec.action_low, spec.action_high))
        self.action_space = gymnasium.spaces.Box(low, high)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (spec.obs_size,))
        self._act = jax.jit(self.act, static_argnames="deterministic")
        self._nothings: dict[int, Acted] = {}
        self.set_random_seed(0)

    @property
    def uses_reward(self) -> bool:
        """Whether it is conditioned on return-to-go, so that it has to be told each reward."""
        return self.config.context.return_conditioning != "none"

    def set_random_seed(self, seed: int) -> None:
        """Seeds what ``predict(obs, state=None, deterministic=False)`` draws; at first it is 0."""
        self._seeds = np.random.default_rng(seed)

    def initial_state(self, num_envs: int = 1, seed: int = 0) -> ActingState:
        """The state before the first step of N environments.

        Args:
          num_envs: N; 1 also for a single environment.
          seed: of all that is drawn from here on: actions with ``deterministic=False``, masks where
            dropout is on in acting.

        Raises:
          ValueError: ``num_envs`` is below 1.
        """
        if num_envs < 1:
            raise ValueError(f"num_envs={num_envs}: must be at least 1")
        key = jax.random.key_data(jax.random.key(seed, impl=_PRNG))
        return ActingState(self._nothing(num_envs), key)

    def _nothing(self, num_envs: int) -> Acted:
        """No step yet; states are never changed, so one for each N is enough."""
        if num_envs not in self._nothings:

            def nothing() -> Acted:
                spec, length = self.spec, self.config.context.context_length
                cache = self.agent.init_cache(num_envs)
                context = contexts.empty(num_envs, length, spec.obs_size, spec.action_size, cache)
                return Acted(action=jnp.zeros((num_envs, spec.action_size)), context=context)

            with jax.ensure_compile_time_eval():  # also where a caller is being traced
                self._nothings[num_envs] = jax.jit(nothing)()
        return self._nothings[num_envs]

    def predict(
        self,
        obs: ArrayLike,
        state: ActingState | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
        reward: ArrayLike | None = None,
    ) -> tuple[np.ndarray, ActingState]:
        """The action for an observation, or for one of each environment, and the state after it.

        Pure but for the one case named at ``state``: nothing is kept in the policy, and a state may
        be used again, or for a branch of its own.

        Args:
          obs: ``[O]``, or ``[N, O]`` of a vector environment.
          state: what the previous call returned, as it is or as NumPy arrays. None: new episodes
            begin everywhere, as from ``initial_state(N)``; with ``deterministic=False`` its seed
            is drawn (see :meth:`set_random_seed`), so that each time is different.
          episode_start: bool, scalar or ``[N]``: where ``obs`` is the first of a new episode. None:
            nowhere, but where the state knows of no step yet.
          deterministic: the mean action; otherwise one drawn as in training (of TD3, DDPG and
            ``policy=deterministic``: the mean with their exploration noise).
          reward: what the previous step gave, done with the action returned then; scalar or
            ``[N]``. Ignored where an episode starts, and by a policy that does not use it.

        Returns:
          The action, ``[A]`` or ``[N, A]`` float32 within the bounds, and the state to pass next.

        Raises:
          ValueError: an argument has another shape, the state belongs to other environments, or a
            reward is missing: :attr:`uses_reward` is true and a row is in the middle of an episode.
        """
        values = np.asarray(obs, np.float32)
        size = self.spec.obs_size
        if values.ndim not in (1, 2) or values.shape[-1] != size or not values.size:
            raise ValueError(f"obs of shape {values.shape}: must be ({size},) or (N, {size})")
        lead = values.shape[:-1]
        num_envs = lead[0] if lead else 1
        if state is None:
            seed = 0 if deterministic else int(self._seeds.integers(2**31))
            state = self.initial_state(num_envs, seed)
        self._check_state(state, num_envs)
        episode_start = False if episode_start is None else episode_start
        start = _broadcast("episode_start", np.asarray(episode_start, bool), lead)
        if reward is None and self.uses_reward:
            _check_none_needed(state, start)
        reward = 0.0 if reward is None else reward
        given = _broadcast("reward", np.asarray(reward, np.float32), lead)
        rows = values.reshape(num_envs, size)
        state = self._act(self.state, state, rows, start, given, deterministic=deterministic)
        return np.array(state.last.action).reshape(*lead, -1), state

    def _check_state(self, state: ActingState, num_envs: int) -> None:
        if not isinstance(state, ActingState):
            raise ValueError(
                f"state of type {type(state).__name__}: must be what the previous predict "
                "returned, or None"
            )
        if state.last.action.shape[0] != num_envs:
            raise ValueError(
                f"state of {state.last.action.shape[0]} environments, obs of {num_envs}: must be "
                "of as many; state=None begins anew"
            )
        own = jax.tree.leaves(self._nothing(num_envs))
        if [x.shape for x in jax.tree.leaves(state.last)] != [x.shape for x in own]:
            raise ValueError("state of another policy: must be one that this policy returned")

    def act(
        self,
        policy: PolicyState,
        state: ActingState,
        obs: jax.Array,
        episode_start: jax.Array,
        reward: jax.Array,
        deterministic: bool = True,
    ) -> ActingState:
        """The step itself, to be jitted: what :meth:`predict` does with arrays of N environments.

        The action is ``last.action`` of the state returned.
        """
        key, act_key = jax.random.split(jax.random.wrap_key_data(state.key, impl=_PRNG))
        # An episode's first state enters like one after a reset; so does the very first.
        start = episode_start | ~state.last.context.mask[:, -1]
        context = contexts.advance(state.last, obs, reward, start)
        acted = self.agent.act(policy, context, act_key, explore=not deterministic)
        # Of what PPO drew only the action counts.
        acted = dataclasses.replace(acted, sample=None)
        return ActingState(acted, jax.random.key_data(key))


def _broadcast(name: str, value: np.ndarray, lead: tuple[int, ...]) -> np.ndarray:
    if value.shape not in ((), lead):
        wanted = f"must be {lead}, or a scalar" if lead else "must be a scalar"
        raise ValueError(f"{name} of shape {value.shape}: {wanted}")
    return np.broadcast_to(value, lead or (1,))


def _check_none_needed(state: ActingState, episode_start: np.ndarray) -> None:
    started = episode_start | ~np.asarray(state.last.context.mask)[:, -1]
    if not started.all():
        raise ValueError(
            "reward=None: this policy is conditioned on return-to-go, so within an episode it must "
            "be told what the last step gave: predict(obs, state, reward=reward); where a new "
            "episode starts, say so with episode_start or state=None"
        )


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

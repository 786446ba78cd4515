"""The host's side of ``gym:ID``: Gymnasium environments behind pure functions, without jax.

A Gymnasium environment keeps its state to itself, so what is carried is how it came about: the seed
of the reset and the actions since. Environments that are running are kept, each under the *token*
of the state it is in, a hash over the seed and all that was done and seen since; they only save
time. Where none is there for a state (a resumed run, a second step from the same state), one is
brought there by doing the episode again, and the token tells whether it went the same way.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import math
import threading
import warnings
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np

from sacformer_jax.envs.native import loading_quietly

TOKEN_WORDS = 4
_TOKEN_BYTES = 4 * TOKEN_WORDS
# Live environments kept, over the largest batch: of training those running and those prepared, and
# as many of evaluation.
_KEPT = 4


@dataclasses.dataclass(frozen=True)
class GymFacts:
    """What the host knows of an environment.

    Attributes:
      env_id: the id it is registered under.
      obs_size: O.
      action_size: A.
      action_dtype: type of its actions.
      reward_terms: names in ``info`` that are parts of the reward, R of them.
      max_steps: T, steps of the longest episode.
    """

    env_id: str
    obs_size: int
    action_size: int
    action_dtype: np.dtype
    reward_terms: tuple[str, ...]
    max_steps: int

    @property
    def row_size(self) -> int:
        """Words of an :class:`Outcome`: token, O, reward, three flags, R."""
        return TOKEN_WORDS + self.obs_size + 4 + len(self.reward_terms)


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a reset or a step gave.

    Attributes:
      token: of the state after it, 16 bytes.
      obs: ``[O]`` float32.
      reward: as float32 holds it.
      terminated: the task ended.
      truncated: the environment cut the episode off by itself.
      terms: ``[R]`` float32 parts of the reward; 0 where ``info`` has none.
    """

    token: bytes
    obs: np.ndarray
    reward: np.float32
    terminated: bool
    truncated: bool
    terms: np.ndarray

    def write(self, row: np.ndarray) -> None:
        """Into a row ``[row_size]`` of uint32."""
        row[:TOKEN_WORDS] = np.frombuffer(self.token, np.uint32)
        numbers = row[TOKEN_WORDS:].view(np.float32)
        end = self.obs.size
        numbers[:end] = self.obs
        numbers[end : end + 3] = self.reward, self.terminated, self.truncated
        numbers[end + 4 :] = self.terms


def make(env_id: str) -> gymnasium.Env:
    """``gymnasium.make`` without the time limit, which is the vector environment's to set."""
    with loading_quietly():
        return gymnasium.make(env_id, max_episode_steps=-1, disable_env_checker=True)


class LiveEnvs:
    """Environments by the token of the state they are in, and those in none.

    Args:
      first: one to begin with.
      env_id: what more of them are made from.
    """

    def __init__(self, first: gymnasium.Env, env_id: str):
        self.env_id, self.made, self.capacity = env_id, 1, 0
        self._idle = [first]
        self._by_token: dict[bytes, gymnasium.Env] = {}  # in the order of their last step

    def take(self, token: bytes) -> gymnasium.Env | None:
        """The one in that state, if there is one."""
        return self._by_token.pop(token, None)

    def spare(self) -> gymnasium.Env:
        """Any that may be reset: an idle one, a new one, or the one longest not used."""
        if self._idle:
            return self._idle.pop()
        if self.made >= self.capacity and self._by_token:
            return self._by_token.pop(next(iter(self._by_token)))
        self.made += 1
        return make(self.env_id)

    def keep(self, token: bytes, env: gymnasium.Env) -> None:
        """Keeps one under the token of its state."""
        other = self._by_token.pop(token, None)
        if other is not None:
            self._idle.append(other)
        self._by_token[token] = env

    def release(self, env: gymnasium.Env) -> None:
        """Its episode is over."""
        self._idle.append(env)

    @contextlib.contextmanager
    def dropped_on_error(self, env: gymnasium.Env) -> Iterator[None]:
        """Around what an environment does: after an exception it is in no state to go on."""
        try:
            yield
        except BaseException:
            self.made -= 1
            with contextlib.suppress(Exception):
                env.close()
            raise


class GymHost:
    """Steps and resets batches of a Gymnasium environment: states in, states out.

    Args:
      facts: what was found out of ``first``.
      first: one of the environments.

    Attributes:
      calls: host calls so far.
      replayed: steps done again so far.
    """

    def __init__(self, facts: GymFacts, first: gymnasium.Env):
        self.facts = facts
        self.calls = self.replayed = 0
        self._live = LiveEnvs(first, facts.env_id)
        self._lock = threading.Lock()  # programs at once take turns
        self._warned = False

    # --- host calls: NumPy arrays of any leading axes ---------------------------------------------

    def reset(self, operand: Any) -> tuple[np.ndarray]:
        """Seeds ``[..., 1]`` uint32 to rows ``[..., row_size]`` uint32."""
        seeds = np.asarray(operand)
        rows = np.zeros((math.prod(seeds.shape[:-1]), self.facts.row_size), np.uint32)
        with self._turn(len(rows)):
            for row, seed in zip(rows, seeds.reshape(-1).tolist(), strict=True):
                self._reset(seed).write(row)
        return (rows.reshape(*seeds.shape[:-1], -1),)

    def step(self, operand: Any, log: Any) -> tuple[np.ndarray]:
        """Steps all.

        Args:
          operand: ``[..., 6 + A]`` uint32: seed, length and token of the state, then the action.
          log: ``[..., T, A]`` float32, the state's actions; looked at to do an episode again.

        Returns:
          rows ``[..., row_size]`` uint32.
        """
        return (self._step(np.asarray(operand), np.asarray(log), refills=False),)

    def step_and_reset(self, operand: Any, log: Any) -> tuple[np.ndarray]:
        """Steps all and resets some.

        Args:
          operand: as of :meth:`step`, then whether to reset and the seed to do it from.
          log: as of :meth:`step`.

        Returns:
          rows ``[..., 2 * row_size]`` uint32: after the step, then of the reset, 0 without one.
        """
        return (self._step(np.asarray(operand), np.asarray(log), refills=True),)

    def _step(self, operand: np.ndarray, log: np.ndarray, refills: bool) -> np.ndarray:
        leading, size = operand.shape[:-1], self.facts.row_size
        operand = operand.reshape(math.prod(leading), operand.shape[-1])
        log = log.reshape(len(operand), *log.shape[-2:])
        rows = np.zeros((len(operand), size * (1 + refills)), np.uint32)
        end = 2 + TOKEN_WORDS + self.facts.action_size
        actions = operand[:, 2 + TOKEN_WORDS : end].view(np.float32)
        with self._turn(len(rows)):
            for words, action, past, row in zip(operand, actions, log, rows, strict=True):
                seed, length = words[:2].tolist()
                token = words[2 : 2 + TOKEN_WORDS].tobytes()
                outcome = self._step_one(seed, past[:length], token, action)
                if outcome is None:
                    row[TOKEN_WORDS + self.facts.obs_size + 3] = np.float32(1).view(np.uint32)
                else:
                    outcome.write(row[:size])
            if refills:
                for words, row in zip(operand, rows, strict=True):
                    if words[end]:
                        self._reset(int(words[end + 1])).write(row[size:])
        return rows.reshape(*leading, -1)

    @contextlib.contextmanager
    def _turn(self, batch: int) -> Iterator[None]:
        """Around a host call for ``batch`` environments."""
        with self._lock, np.errstate(over="ignore", invalid="ignore"):  # judged as bad physics
            self.calls += 1
            self._live.capacity = max(self._live.capacity, _KEPT * batch)
            yield

    # --- one environment --------------------------------------------------------------------------

    def _reset(self, seed: int) -> Outcome:
        env = self._live.spare()
        with self._live.dropped_on_error(env):
            outcome = self._reset_to(env, seed)
        self._live.keep(outcome.token, env)
        return outcome

    def _step_one(
        self, seed: int, past: np.ndarray, token: bytes, action: np.ndarray
    ) -> Outcome | None:
        """One step from the state that ``past [length, A]`` led to; None where that is lost."""
        env = self._live.take(token)
        if env is None:
            env = self._brought_to(token, seed, past)
            if env is None:
                return None
        with self._live.dropped_on_error(env):
            outcome = self._act(env, token, action)
        if outcome.terminated or outcome.truncated or len(past) + 1 >= self.facts.max_steps:
            self._live.release(env)
        else:
            self._live.keep(outcome.token, env)
        return outcome

    def _brought_to(self, token: bytes, seed: int, past: np.ndarray) -> gymnasium.Env | None:
        """An environment in that state, by doing its episode again."""
        env = self._live.spare()
        with self._live.dropped_on_error(env):
            reached = self._reset_to(env, seed).token
            for action in past:
                reached = self._act(env, reached, action).token
        self.replayed += len(past)
        if reached == token:
            return env
        self._live.release(env)
        if not self._warned:
            self._warned = True
            warnings.warn(
                f"gym:{self.facts.env_id} did not go the same way from the same seed and actions: "
                "it is not deterministic, or this is another machine. Episodes that were running "
                "are cut off here (truncated, counted as bad physics), and runs do not repeat.",
                RuntimeWarning,
                stacklevel=2,
            )
        return None

    def _reset_to(self, env: gymnasium.Env, seed: int) -> Outcome:
        obs, _ = env.reset(seed=seed)
        return self._outcome(seed.to_bytes(_TOKEN_BYTES, "little"), b"", obs, 0.0)

    def _act(self, env: gymnasium.Env, token: bytes, action: np.ndarray) -> Outcome:
        given = action.astype(self.facts.action_dtype)  # its own copy
        obs, reward, terminated, truncated, info = env.step(given)
        return self._outcome(
            token, action.tobytes(), obs, reward, bool(terminated), bool(truncated), info
        )

    def _outcome(
        self,
        before: bytes,
        action: bytes,
        obs: Any,
        reward: Any,
        terminated: bool = False,
        truncated: bool = False,
        info: dict[str, Any] | None = None,
    ) -> Outcome:
        values = np.asarray(obs).astype(np.float32)
        if values.shape != (self.facts.obs_size,):
            raise ValueError(
                f"gym:{self.facts.env_id} gave an observation of shape {values.shape}, not "
                f"{(self.facts.obs_size,)} as its observation_space says"
            )
        reward = np.float32(reward)
        seen = (
            before + action + values.tobytes() + reward.tobytes() + bytes([terminated, truncated])
        )
        terms = np.zeros(len(self.facts.reward_terms), np.float32)
        for i, name in enumerate(self.facts.reward_terms):
            terms[i] = (info or {}).get(name, 0.0)
        token = hashlib.blake2b(before + seen, digest_size=_TOKEN_BYTES).digest()
        return Outcome(token, values, reward, terminated, truncated, terms)

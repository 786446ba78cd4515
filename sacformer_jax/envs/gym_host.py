"""The host's side of ``gym:ID``: Gymnasium environments behind pure functions, without jax.

A Gymnasium environment keeps its state to itself, so what is carried is how it came about: the seed
of the reset and the actions since. Environments that are running are kept, each under the *token*
of the state it is in, a hash over the seed and all that was done and seen since; they only save
time. Where none is there for a state (a resumed run, a second step from the same state), one is
brought there by doing the episode again, and the token tells whether it went the same way.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import threading
import warnings
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np

from sacformer_jax.envs.gym_live import TOKEN_BYTES, TOKEN_WORDS, GymFacts, LiveEnvs, Outcome


class GymHost:
    """Steps and resets batches of a Gymnasium environment: states in, states out.

    Args:
      facts: what was found out of ``first``.
      first: one of the environments.

    Attributes:
      live: the environments there are.
      replayed: steps done again so far.
    """

    def __init__(self, facts: GymFacts, first: gymnasium.Env):
        self.facts = facts
        self.replayed = 0
        self.live = LiveEnvs(first, facts)
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
            self.live.calls += 1
            self.live.largest_batch = max(self.live.largest_batch, batch)
            yield

    # --- one environment --------------------------------------------------------------------------

    def _reset(self, seed: int) -> Outcome:
        env = self.live.spare()
        with self.live.dropped_on_error(env):
            outcome = self._reset_to(env, seed)
        self.live.keep(outcome.token, env)
        return outcome

    def _step_one(
        self, seed: int, past: np.ndarray, token: bytes, action: np.ndarray
    ) -> Outcome | None:
        """One step from the state that ``past [length, A]`` led to; None where that is lost."""
        env = self.live.take(token)
        if env is None:
            env = self._brought_to(token, seed, past)
            if env is None:
                return None
        with self.live.dropped_on_error(env):
            outcome = self._act(env, token, action)
        if outcome.terminated or outcome.truncated or len(past) + 1 >= self.facts.max_steps:
            self.live.release(env)
        else:
            self.live.keep(outcome.token, env)
        return outcome

    def _brought_to(self, token: bytes, seed: int, past: np.ndarray) -> gymnasium.Env | None:
        """An environment in that state, by doing its episode again."""
        env = self.live.spare()
        with self.live.dropped_on_error(env):
            reached = self._reset_to(env, seed).token
            for action in past:
                reached = self._act(env, reached, action).token
        self.replayed += len(past)
        if reached == token:
            return env
        self.live.release(env)
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
        return self._outcome(seed.to_bytes(TOKEN_BYTES, "little"), b"", obs, 0.0)

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
        token = hashlib.blake2b(before + seen, digest_size=TOKEN_BYTES).digest()
        return Outcome(token, values, reward, terminated, truncated, terms)

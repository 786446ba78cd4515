"""Gymnasium environments kept on the host, each under the state it is in; without jax."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator

import gymnasium
import numpy as np

from sacformer_jax.envs.models import loading_quietly

TOKEN_WORDS = 4
TOKEN_BYTES = 4 * TOKEN_WORDS


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


@dataclasses.dataclass(frozen=True)
class _Kept:
    """An environment that somebody may go on with, and the host call it was last used in."""

    env: gymnasium.Env
    since: int


# An environment of a running program, prepared ones too, is used within an episode of its own and
# the evaluations in between; one unused for so many of the longest episodes is abandoned.
_ABANDONED = 4
# However it may be, no more than this many times the largest batch are kept.
_MOST = 8


class LiveEnvs:
    """Environments by the token of the state they are in, and those in none.

    Args:
      first: one to begin with.
      facts: of all of them.

    Attributes:
      made: how many there are.
      calls: host calls so far, to tell which environments nobody will ask for any more.
      largest_batch: most environments in a host call so far.
    """

    def __init__(self, first: gymnasium.Env, facts: GymFacts):
        self.facts = facts
        self.made, self.calls, self.largest_batch = 1, 0, 0
        self._idle = [first]
        self._kept: dict[bytes, _Kept] = {}  # in the order of their last step

    def take(self, token: bytes) -> gymnasium.Env | None:
        """The one in that state, if there is one."""
        kept = self._kept.pop(token, None)
        return None if kept is None else kept.env

    def spare(self) -> gymnasium.Env:
        """Any that may be reset: an idle one, an abandoned one, or a new one."""
        if self._idle:
            return self._idle.pop()
        oldest = next(iter(self._kept), None)
        if oldest is not None:
            unused = self.calls - self._kept[oldest].since
            if (
                unused > _ABANDONED * self.facts.max_steps
                or self.made >= _MOST * self.largest_batch
            ):
                return self._kept.pop(oldest).env
        self.made += 1
        return make(self.facts.env_id)

    def keep(self, token: bytes, env: gymnasium.Env) -> None:
        """Keeps one under the token of its state."""
        other = self._kept.pop(token, None)
        if other is not None:
            self._idle.append(other.env)
        self._kept[token] = _Kept(env, self.calls)

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

"""A replay that starts with recorded episodes, laid out so that windows cannot tell.

Letters: N environment columns, L steps of each, O observation size, A action size.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sacformer_jax import normalizer
from sacformer_jax.buffer import TrajectoryBuffer
from sacformer_jax.config import Config, ConfigError
from sacformer_jax.envs.core import EnvSpec
from sacformer_jax.envs.wrapping import UNWRAPPED
from sacformer_jax.population import Population
from sacformer_jax.types import BufferState, TrainState, Transition

_SLACK = 1e-3
"""How far beyond its bounds, over half their distance, an action may lie to be taken as on them."""


@dataclasses.dataclass(frozen=True)
class Episode:
    """A recorded episode of T steps.

    Attributes:
      obs: float32 ``[T + 1, O]``, the last one is that after the last step.
      action: float32 ``[T, A]``.
      reward: float32 ``[T]``.
      terminated: the task ended after the last step; otherwise the episode was cut off there.
    """

    obs: np.ndarray
    action: np.ndarray
    reward: np.ndarray
    terminated: bool

    def __len__(self) -> int:
        return len(self.reward)

    @property
    def episode_return(self) -> float:
        """The undiscounted sum of rewards."""
        return float(self.reward.sum())


@dataclasses.dataclass(frozen=True)
class Layout:
    """Episodes laid into columns, oldest step first.

    Attributes:
      steps: :class:`~sacformer_jax.types.Transition` of NumPy arrays ``[L, N, ...]``.
      dropped: steps that found no place.
    """

    steps: Transition
    dropped: int


@dataclasses.dataclass(frozen=True)
class _Piece:
    """The steps ``[start, stop)`` of an episode."""

    episode: Episode
    start: int
    stop: int

    def __len__(self) -> int:
        return self.stop - self.start


def check_episodes(episodes: Sequence[Episode], spec: EnvSpec, config: Config) -> None:
    """Refuses what cannot be episodes of the configuration's task.

    Raises:
      ConfigError: with the dataset, the episode and what is wrong with it.
    """
    dataset = f"dataset={config.offline.dataset!r}"
    if not episodes:
        raise ConfigError(f"{dataset}: holds no episodes")
    if spec.wrapping != UNWRAPPED:
        raise ConfigError(
            f"{dataset}: its steps are of the task as it is, but env={spec.name} has wrappers "
            f"({', '.join(spec.wrapping.words())}); use an environment without any"
        )
    low, high = np.array(spec.action_low), np.array(spec.action_high)
    slack = _SLACK * (high - low) / 2
    for number, episode in enumerate(episodes):
        where, length = f"{dataset}: episode {number}", len(episode)
        if length == 0:
            raise ConfigError(f"{where} has no steps")
        shapes = (episode.obs.shape, episode.action.shape)
        wanted = ((length + 1, spec.obs_size), (length, spec.action_size))
        if shapes != wanted:
            raise ConfigError(
                f"{where} has observations {shapes[0]} and actions {shapes[1]}: env={spec.name} "
                f"with so many rewards needs {wanted[0]} and {wanted[1]}"
            )
        if length > config.task.max_episode_steps:
            raise ConfigError(
                f"{where} has {length} steps: more than max_episode_steps="
                f"{config.task.max_episode_steps}"
            )
        for name, values in (
            ("observation", episode.obs), ("action", episode.action), ("reward", episode.reward)
        ):  # fmt: skip
            if not np.all(np.isfinite(values)):
                raise ConfigError(f"{where} has {name}s that are not finite")
        if np.any(episode.action < low - slack) or np.any(episode.action > high + slack):
            raise ConfigError(
                f"{where} has actions from {episode.action.min():g} to {episode.action.max():g}: "
                f"env={spec.name} has bounds {spec.action_low} and {spec.action_high}"
            )
    total = sum(map(len, episodes))
    if total > config.replay.buffer_capacity:
        raise ConfigError(
            f"{dataset}: has {total} steps, buffer_capacity={config.replay.buffer_capacity}: give "
            f"at least {total}, and more for what is to come"
        )


def lay_out(episodes: Sequence[Episode], buffer: TrajectoryBuffer) -> Layout:
    """Lays episodes into the columns of a replay, all of the same length.

    Columns are filled from their newest step backwards; where an episode does not fit, the head of
    it goes into the next column as an episode that was cut off there. For hindsight return-to-go,
    which the head's steps would no longer have, it is dropped instead. What is left of the oldest
    episode of a column keeps its time steps and its reward so far, as in a ring that has
    overwritten its beginning.

    Args:
      episodes: in the order in which they are to be forgotten.
      buffer: the replay, with all its N columns.

    Raises:
      ConfigError: there are too few steps for N columns of K steps.
    """
    total = sum(map(len, episodes))
    for length in range(min(total // buffer.num_envs, buffer.length), 0, -1):
        columns = _filled(episodes, buffer, length)
        if columns is not None and length >= buffer.context_length:
            kept = length * buffer.num_envs
            steps: Any = jax.tree.map(
                lambda *each: np.stack(each, axis=1),  # [L, N, ...]
                *(_column(column, buffer.scattered) for column in columns),
            )
            return Layout(steps, total - kept)
    raise ConfigError(
        f"dataset: {total} steps in {len(episodes)} episodes are too few for num_envs="
        f"{buffer.num_envs} columns of {buffer.context_length} steps, which is what an update "
        "learns from at a time; use more steps, or a smaller num_envs"
    )


def _filled(
    episodes: Sequence[Episode], buffer: TrajectoryBuffer, length: int
) -> list[list[_Piece]] | None:
    """Pieces of each column, oldest first; None where the episodes do not fill them."""
    waiting = [_Piece(episode, 0, len(episode)) for episode in episodes]
    columns: list[list[_Piece]] = []
    for _ in range(buffer.num_envs):
        column: list[_Piece] = []
        room = length
        while room > 0:
            if not waiting:
                return None
            piece = waiting.pop()
            cut = piece.stop - min(room, len(piece))
            column.append(_Piece(piece.episode, cut, piece.stop))
            room -= piece.stop - cut
            if cut > piece.start and not buffer.hindsight:
                waiting.append(_Piece(piece.episode, piece.start, cut))
        columns.append(column[::-1])
    return columns


def _column(pieces: Sequence[_Piece], scattered: bool) -> Transition:
    """The steps of a column, NumPy ``[L, ...]``."""
    return jax.tree.map(
        lambda *each: np.concatenate(each), *(_transition(piece, scattered) for piece in pieces)
    )


def _transition(piece: _Piece, scattered: bool) -> Transition:
    episode, part = piece.episode, slice(piece.start, piece.stop)
    before = np.concatenate([[0.0], np.cumsum(episode.reward, dtype=np.float32)[:-1]])
    last = np.zeros(len(piece), bool)
    # Scattered windows are drawn of whole episodes: one without its beginning must not count as
    # finished.
    last[-1] = piece.start == 0 or not scattered
    terminates = episode.terminated and piece.stop == len(episode)
    never: Any = np.zeros(len(piece), bool)
    numbers: dict[str, Any] = {
        "obs": episode.obs[part].astype(np.float32),
        "action": episode.action[part].astype(np.float32),
        "reward": episode.reward[part].astype(np.float32),
        "terminated": last & terminates,
        "truncated": last & (not terminates),
        "bad": never,
        "time_step": np.arange(piece.start, piece.stop, dtype=np.int32),
        "return_so_far": before[part].astype(np.float32),
    }
    return Transition(**numbers)


def with_dataset(
    population: Population, state: TrainState, episodes: Sequence[Episode]
) -> tuple[TrainState, int]:
    """The state with the episodes in every member's replay, and how many steps had no room.

    Observation statistics begin with all of them, and ``target_return="auto"`` with the best return
    among them.

    Args:
      population: what is trained, in one process.
      state: at its start.
      episodes: see :func:`check_episodes`.

    Raises:
      ConfigError: there are too few of them.
    """
    config, program = population.config, population.program
    buffer = dataclasses.replace(program.buffer, num_envs=config.task.num_envs)
    spec = program.env.spec
    low, high = (np.array(b, np.float32) for b in (spec.action_low, spec.action_high))
    episodes = [
        dataclasses.replace(episode, action=np.clip(episode.action, low, high))
        for episode in episodes
    ]
    layout = lay_out(episodes, buffer)
    filled = jax.jit(lambda steps: _fill(buffer, steps))(layout.steps)
    learner, hyper, num_members = state.learner, state.hyper, len(population.members)

    def for_all(tree: Any, specs: Any, shardings: Any) -> Any:
        """Every member's copy, of what is not common to them anyway."""

        def placed(leaf: jax.Array, spec: Any, sharding: Any) -> jax.Array:
            if len(spec):
                leaf = jnp.broadcast_to(leaf[None], (num_members, *leaf.shape))
            return jax.device_put(leaf, sharding)

        return jax.tree.map(placed, tree, specs, shardings)

    specs, shardings = population.specs, population.shardings
    if config.context.normalize_obs:
        statistics = normalizer.init(spec.obs_size)
        seen = jnp.asarray(layout.steps.obs)
        statistics = for_all(
            normalizer.update(statistics, seen),
            specs.learner.normalizer,
            shardings.learner.normalizer,
        )
        learner = dataclasses.replace(learner, normalizer=statistics)
    if config.context.target_return == "auto":
        best = max(episode.episode_return for episode in episodes)
        target = jnp.maximum(hyper.target_return, best)
        hyper = dataclasses.replace(hyper, target_return=target)
    placed = for_all(filled, specs.buffer, shardings.buffer)
    state = dataclasses.replace(state, buffer=placed, learner=learner, hyper=hyper)
    return state, layout.dropped


def _fill(buffer: TrajectoryBuffer, steps: Transition) -> BufferState:
    """The replay after L steps of all columns, leaves ``[L, N, ...]``."""
    filled, _ = jax.lax.scan(
        lambda state, step: (buffer.add(state, step), None), buffer.init(), steps
    )
    return filled

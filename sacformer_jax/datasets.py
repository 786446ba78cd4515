"""Minari datasets: episodes read from them, and a policy's episodes written as one."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec as RegisteredSpec
from gymnasium.envs.registration import parse_env_id

from sacformer_jax.config import ConfigError
from sacformer_jax.envs.core import EnvSpec
from sacformer_jax.envs.gym_registry import registered
from sacformer_jax.envs.gym_wrappers import gym_wrapped_spec
from sacformer_jax.offline import Episode
from sacformer_jax.values import first_line

_WRAPPERS = gym_wrapped_spec.__module__


def minari_or_refuse(what: str) -> Any:
    """The package ``minari``.

    Raises:
      ConfigError: it is not installed; the message starts with ``what``.
    """
    try:
        import minari
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"{what}: Minari is not installed; pip install 'sacformer-jax[minari]'"
        ) from error
    return minari


def read_episodes(dataset: str, spec: EnvSpec | None = None) -> list[Episode]:
    """The episodes of a Minari dataset, in their order.

    Args:
      dataset: an id among the local datasets (``"mujoco/hopper/expert-v0"``; nothing is
        downloaded), a dataset's folder, its ``data`` folder, or the HDF5 file in that.
      spec: of the environment that is to be learnt in; None: whichever it is of.

    Raises:
      ConfigError: Minari is not installed, there is no such dataset, it says that it is of another
        task than ``spec`` or of a task wrapped by us (one that does not say is believed), or its
        observations or actions are not plain vectors.
    """
    what = f"dataset={dataset!r}"
    minari = minari_or_refuse(what)
    try:
        found = _opened(minari, dataset)
    except (FileNotFoundError, ValueError, OSError, KeyError) as error:
        raise ConfigError(
            f"{what}: is no local Minari dataset ({first_line(error)}); give an id that "
            "'minari list local' shows (get one by 'minari download'), or its folder"
        ) from error
    if spec is not None and found.spec.env_spec is not None:
        _check_source(what, found.spec.env_spec, spec)
    for name in ("observation", "action"):
        space = getattr(found.spec, f"{name}_space")
        if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
            raise ConfigError(f"{what}: its {name}s are {space}; they must be vectors (a 1-D Box)")
    return [_episode(episode) for episode in found.iterate_episodes()]


def _check_source(what: str, source: RegisteredSpec, spec: EnvSpec) -> None:
    ours = [each for each in source.additional_wrappers if each.entry_point.startswith(_WRAPPERS)]
    if ours:
        raise ConfigError(
            f"{what}: was collected with {ours[0].name}, so its steps are not those of "
            f"env={spec.name!r}; collect one without"
        )
    name = parse_env_id(source.id)[1]
    is_a_task = spec.gymnasium_id is not None and parse_env_id(spec.gymnasium_id)[1] == spec.name
    if is_a_task and name != spec.name:
        raise ConfigError(
            f"{what}: is of {source.id}, not of env={spec.name!r}; use one of that task, or "
            f"env={name}"
        )


def _opened(minari: Any, dataset: str) -> Any:
    path = Path(dataset).expanduser()
    if path.is_file():
        path = path.parent
    if not path.is_dir():
        return minari.load_dataset(dataset)
    return minari.MinariDataset(path / "data" if (path / "data").is_dir() else path)


def _episode(episode: Any) -> Episode:
    return Episode(
        obs=np.asarray(episode.observations, np.float32),
        action=np.asarray(episode.actions, np.float32),
        reward=np.asarray(episode.rewards, np.float32),
        terminated=bool(np.any(episode.terminations)),
    )


def described(dataset: str, episodes: Sequence[Episode], dropped: int) -> str:
    """A line about a dataset that was read."""
    returns = [episode.episode_return for episode in episodes]
    steps = sum(map(len, episodes))
    text = (
        f"dataset      {dataset}: {len(episodes):,} episodes, {steps:,} steps, returns "
        f"{min(returns):.1f} to {max(returns):.1f}, mean {np.mean(returns):.1f}"
    )
    return text + (f"; {dropped:,} steps found no place in equal columns" if dropped else "")


def write_episodes(
    episodes: Sequence[Episode], dataset_id: str, spec: EnvSpec, algorithm: str, description: str
) -> Path:
    """Writes episodes as a new local Minari dataset.

    Args:
      episodes: at least one.
      dataset_id: theirs, ``"namespace/name-v0"``; lies under ``$MINARI_DATASETS_PATH`` or
        ``~/.minari/datasets``.
      spec: of the environment they are from.
      algorithm: whose they are.
      description: for people.

    Returns:
      the dataset's folder.

    Raises:
      ConfigError: Minari is not installed, the id is malformed, or there is such a dataset.
    """
    what = f"to={dataset_id!r}"
    minari = minari_or_refuse(what)
    from minari.data_collector.episode_buffer import EpisodeBuffer
    from minari.storage.datasets_root_dir import get_dataset_path

    check_dataset_id(dataset_id)
    buffers = [
        EpisodeBuffer(
            id=number,
            observations=episode.obs,
            actions=episode.action,
            rewards=list(episode.reward),
            terminations=_at_the_end(episode, episode.terminated),
            truncations=_at_the_end(episode, not episode.terminated),
        )
        for number, episode in enumerate(episodes)
    ]
    unbounded = np.full(spec.obs_size, np.inf, np.float32)
    bounds = np.array(spec.action_low, np.float32), np.array(spec.action_high, np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # who the author is may stay open
        minari.create_dataset_from_buffers(
            dataset_id,
            buffer=buffers,
            env=_env_spec(spec),
            observation_space=gymnasium.spaces.Box(-unbounded, unbounded, dtype=np.float32),
            action_space=gymnasium.spaces.Box(*bounds, dtype=np.float32),
            algorithm_name=algorithm,
            description=description,
        )
    return Path(get_dataset_path(dataset_id))


def check_dataset_id(dataset_id: str) -> None:
    """Refuses an id that no new dataset can have.

    Raises:
      ConfigError: Minari is not installed, the id is malformed, or there is such a dataset.
    """
    what = f"to={dataset_id!r}"
    minari_or_refuse(what)
    from minari.dataset.minari_dataset import parse_dataset_id
    from minari.storage.datasets_root_dir import get_dataset_path

    try:
        parse_dataset_id(dataset_id)
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{what}: must be like 'name-v0' or 'namespace/name-v0'") from error
    if get_dataset_path(dataset_id).exists():
        raise ConfigError(f"{what}: there is such a dataset already; choose another id")


def _at_the_end(episode: Episode, flag: bool) -> list[bool]:
    return [False] * (len(episode) - 1) + [flag]


def _env_spec(spec: EnvSpec) -> Any:
    """What a dataset says of the environment it is of; None where that cannot be written down."""
    if spec.gymnasium_id is None:
        return None
    found = registered(spec.gymnasium_id)
    return None if callable(found.entry_point) else gym_wrapped_spec(found, spec.wrapping)

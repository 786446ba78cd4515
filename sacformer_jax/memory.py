"""Whether a train state fits in the memory there is, before any of it is allocated."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sacformer_jax.config import Config, ConfigError, shortest_column


def check_fits(
    state_bytes: int,
    replay_bytes: int,
    config: Config,
    members_per_device: int,
    available: int | None,
    copies: int = 1,
    data_shards: int = 1,
) -> None:
    """Refuses a replay that does not fit in a device.

    What counts is the train state, ``copies`` times. Prefill and chunks are given theirs to keep
    and work in place (measured on CPU: 1.5 MiB besides, with a state of 406 MiB); a checkpoint on
    CPU holds a copy until it is written (407 MiB). Compiled programs and their temporaries do not
    grow with the replay and are not counted.

    Args:
      state_bytes: the train states of all members on a device, replay included.
      replay_bytes: the part of it that is replay.
      config: the run's.
      members_per_device: how many replays of ``buffer_capacity`` steps the device holds.
      available: bytes there are before the states are made; None, if nobody knows: no refusal.
      copies: states in that memory at once: 2 on CPU, where a checkpoint's is one, else 1.
      data_shards: devices over which each replay is split.

    Raises:
      ConfigError: with the arithmetic and the largest capacity that would fit.
    """
    needed = copies * state_bytes
    if available is None or needed <= available:
        return
    capacity, num_envs = config.replay.buffer_capacity, config.task.num_envs
    held = capacity // num_envs * num_envs  # all columns are of one length
    step_bytes = replay_bytes * data_shards / (held * members_per_device)
    factors = [f"{step_bytes:,.1f} bytes a step", f"{capacity:,} steps"]
    if members_per_device > 1:
        factors.append(f"{members_per_device} members")
    split = f" / {data_shards} devices" if data_shards > 1 else ""
    more = f", {copies} copies of that {_gib(needed)}" if copies > 1 else ""
    per_device = step_bytes * members_per_device / data_shards
    room = available / copies - (state_bytes - replay_bytes)
    raise ConfigError(
        f"buffer_capacity={capacity}: the replay takes {' x '.join(factors)}{split} = "
        f"{_gib(replay_bytes)}, with the rest of the train state {_gib(state_bytes)}{more}; "
        f"available are {_gib(available)}: {_advice(config, int(room / per_device))}"
    )


def _advice(config: Config, room: int) -> str:
    """What would fit, where there is room for so many steps of each member."""
    num_envs, context = config.task.num_envs, config.context
    scattered = context.window == "scattered"
    least = num_envs * shortest_column(
        config.task.max_episode_steps, context.window_length, scattered
    )
    largest = room // num_envs * num_envs
    if largest >= least:
        return f"use at most {largest}"
    return (
        f"even the least, {least}, does not fit; use fewer seeds, a smaller num_envs or "
        "max_episode_steps, or more devices"
    )


def _gib(num: int) -> str:
    return f"{num / 2**30:.2f} GiB"


def available_bytes(device: Any, sharing: int = 1, root: Path = Path("/")) -> int | None:
    """Memory that this process may still allocate on a device.

    Args:
      device: a ``jax.Device`` of this process.
      sharing: devices of the run that share the host's memory, where they are CPU devices.
      root: where ``proc`` and ``sys`` lie.

    Returns:
      Of an accelerator, what its allocator may still take. Of a CPU device, its share of the least
      of what the kernel and the control groups leave; where neither tells (macOS), of all the
      memory there is. None where nothing is known.
    """
    if device.platform != "cpu":
        stats = device.memory_stats() or {}
        if "bytes_limit" not in stats:
            return None
        return max(0, stats["bytes_limit"] - stats.get("bytes_in_use", 0))
    known = [*_left_by_kernel(root), *_left_by_groups(root)] or [*_physical()]
    return max(0, min(known)) // sharing if known else None


def _left_by_kernel(root: Path) -> Iterator[int]:
    for line in _lines(root / "proc/meminfo"):
        if line.startswith("MemAvailable:"):
            yield 1024 * int(line.split()[1])


def _left_by_groups(root: Path) -> Iterator[int]:
    """What each control group that this process is in leaves, versions 2 and 1."""
    for line in _lines(root / "proc/self/cgroup"):
        _, controllers, path = line.split(":", 2)
        if not controllers:
            mount, limit, usage = root / "sys/fs/cgroup", "memory.max", "memory.current"
            reclaimable = "inactive_file"
        elif "memory" in controllers.split(","):
            mount, limit = root / "sys/fs/cgroup/memory", "memory.limit_in_bytes"
            usage, reclaimable = "memory.usage_in_bytes", "total_inactive_file"
        else:
            continue
        # In a container the path may be that of the host; the mount is then the container's own.
        group = mount / path.lstrip("/")
        for folder in (group, *group.parents):
            limits, used = _lines(folder / limit), _lines(folder / usage)
            if limits and used and limits[0] != "max":
                cached = (line.split() for line in _lines(folder / "memory.stat"))
                free = sum(int(value) for name, value in cached if name == reclaimable)
                yield int(limits[0]) - int(used[0]) + free
            if folder == mount:
                break


def _physical() -> Iterator[int]:
    names = getattr(os, "sysconf_names", {})
    if {"SC_PHYS_PAGES", "SC_PAGE_SIZE"} <= set(names):
        pages, size = os.sysconf("SC_PHYS_PAGES"), os.sysconf("SC_PAGE_SIZE")
        if pages > 0 and size > 0:
            yield pages * size


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text().splitlines()
    except OSError:
        return []

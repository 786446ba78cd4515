"""Refusing a replay that does not fit: the arithmetic, and where free memory is read."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any

import jax
import pytest

from sacformer_jax import Config, ConfigError, make_program
from sacformer_jax.digests import num_bytes
from sacformer_jax.memory import available_bytes, check_fits

MIB, GIB = 2**20, 2**30


def config(capacity: int = 1_000_000, **fields: Any) -> Config:
    given = {"env": "Hopper", "num_envs": 4, "context_length": 6, "max_episode_steps": 1000}
    return Config.from_preset("cpu", **{**given, **fields}, buffer_capacity=capacity)


# --- the arithmetic ----------------------------------------------------------------------------


def refusal(*args: Any, **options: Any) -> str:
    with pytest.raises(ConfigError) as refused:
        check_fits(*args, **options)
    return str(refused.value)


def test_what_fits_is_not_refused() -> None:
    check_fits(200_000_000, 100_000_000, config(), 1, 200_000_000)
    check_fits(200_000_000, 100_000_000, config(), 1, None)
    check_fits(200_000_000, 100_000_000, config(), 1, 400_000_000, copies=2)


def test_the_arithmetic_of_one_member() -> None:
    # 100 bytes a step; 20,000,000 of other things leave room for (60 - 20) / 100 million steps.
    said = refusal(120_000_000, 100_000_000, config(), 1, 60_000_000)
    assert said == (
        "buffer_capacity=1000000: the replay takes 100.0 bytes a step x 1,000,000 steps = "
        "0.09 GiB, with the rest of the train state 0.11 GiB; available are 0.06 GiB: "
        "use at most 400000"
    )


def test_the_arithmetic_of_members_copies_and_shards() -> None:
    # 8 members of 1,000,000 steps over 2 devices, 64 bytes a step: 256,000,000 on each.
    # Half of 400,000,000, less 44,000,000, over 8 * 64 / 2 bytes: room for 609,375 steps of each.
    said = refusal(300_000_000, 256_000_000, config(), 8, 400_000_000, copies=2, data_shards=2)
    assert "64.0 bytes a step x 1,000,000 steps x 8 members / 2 devices = 0.24 GiB" in said
    assert "train state 0.28 GiB, 2 copies of that 0.56 GiB; available are 0.37 GiB" in said
    assert said.endswith("use at most 609372")  # in 4 columns of one length


def test_a_capacity_that_its_environments_do_not_divide() -> None:
    # Four columns of 250,000: 1,000,000 of the 1,000,003 steps are there, of 100 bytes each.
    said = refusal(100_000_000, 100_000_000, config(1_000_003), 1, 99_999_999)
    assert "100.0 bytes a step x 1,000,003 steps" in said
    assert said.endswith("use at most 999996")


@pytest.mark.parametrize(("available", "fits"), [(402_400, True), (402_399, False)])
def test_nothing_is_advised_that_would_be_refused(available: int, fits: bool) -> None:
    # Each of 4 columns must hold the longest episode and a window, 1006 steps.
    said = refusal(100_000_000, 100_000_000, config(), 1, available)
    assert ("use at most 4024" in said) == fits
    assert ("even the least, 4024, does not fit; use fewer seeds" in said) == (not fits)


def test_scattered_windows_need_two_episodes() -> None:
    said = refusal(100_000_000, 100_000_000, config(window="scattered"), 1, 1)
    assert "even the least, 8000, does not fit" in said


def test_the_capacity_advised_fits_and_one_more_does_not() -> None:
    """With shapes of real train states."""

    def sizes(capacity: int) -> tuple[int, int, Config]:
        made = config(capacity, num_envs=2, actor_width=8, actor_heads=1, critic_width=8)
        state = jax.eval_shape(make_program(made).init, jax.random.key(0))
        return num_bytes(state), num_bytes(state.buffer), made

    state_bytes, replay_bytes, made = sizes(100_000)
    available = state_bytes // 3
    largest = int(refusal(state_bytes, replay_bytes, made, 1, available).split()[-1])
    state_bytes, replay_bytes, made = sizes(largest)
    check_fits(state_bytes, replay_bytes, made, 1, available)
    # In columns of one length the next larger has a step more in each.
    assert sizes(largest + 2)[0] > available


# --- what there is -----------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Device:
    platform: str
    stats: dict[str, int] | None = None

    def memory_stats(self) -> dict[str, int] | None:
        return self.stats


CPU = Device("cpu")


def files(root: Path, contents: dict[str, object]) -> Path:
    for name, text in contents.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(f"{text}\n")
    return root


@pytest.mark.parametrize(
    ("stats", "expected"),
    [
        ({"bytes_limit": 60 * GIB, "bytes_in_use": 3 * GIB}, 57 * GIB),
        ({"bytes_limit": 60 * GIB}, 60 * GIB),
        ({"bytes_limit": 1, "bytes_in_use": 2}, 0),
        ({"bytes_in_use": 3 * GIB}, None),
        (None, None),
    ],
)
def test_an_accelerator_tells_itself(stats: dict[str, int] | None, expected: int | None) -> None:
    assert available_bytes(Device("gpu", stats), sharing=8) == expected


MEMINFO = "MemTotal:       24684092 kB\nMemFree:  1 kB\nMemAvailable:    8388608 kB\nCached: 5 kB"


def test_the_kernel_tells(tmp_path: Path) -> None:
    root = files(tmp_path, {"proc/meminfo": MEMINFO})
    assert available_bytes(CPU, root=root) == 8 * GIB
    assert available_bytes(CPU, sharing=8, root=root) == GIB


def group_2(folder: str, limit: object, used: int, cached: int = 0) -> dict[str, object]:
    return {
        f"sys/fs/cgroup{folder}/memory.max": limit,
        f"sys/fs/cgroup{folder}/memory.current": used,
        f"sys/fs/cgroup{folder}/memory.stat": f"active_file 7\ninactive_file {cached}",
    }


def test_the_tightest_group_of_version_2_decides(tmp_path: Path) -> None:
    root = files(
        tmp_path,
        {
            "proc/meminfo": MEMINFO,
            "proc/self/cgroup": "0::/slice/job/step",
            **group_2("/slice/job/step", "max", 2 * GIB),
            **group_2("/slice/job", 4 * GIB, 3 * GIB, cached=512 * MIB),
            **group_2("/slice", 100 * GIB, 9 * GIB),
        },
    )
    assert available_bytes(CPU, root=root) == 1536 * MIB  # 4 - 3 + 0.5 GiB


def test_a_group_wider_than_the_machine_does_not_count(tmp_path: Path) -> None:
    contents = {"proc/meminfo": MEMINFO, "proc/self/cgroup": "0::/"}
    root = files(tmp_path, {**contents, **group_2("", 100 * GIB, 9 * GIB)})
    assert available_bytes(CPU, root=root) == 8 * GIB


def test_a_group_that_is_full(tmp_path: Path) -> None:
    contents = {"proc/meminfo": MEMINFO, "proc/self/cgroup": "0::/"}
    root = files(tmp_path, {**contents, **group_2("", GIB, GIB + 1)})
    assert available_bytes(CPU, root=root) == 0


def test_groups_of_version_1(tmp_path: Path) -> None:
    """In a container: the path is the host's, what is mounted is the container's own."""
    mount = "sys/fs/cgroup/memory"
    root = files(
        tmp_path,
        {
            "proc/meminfo": MEMINFO,
            "proc/self/cgroup": "9:name=systemd:/\n4:cpu,memory:/docker/1234\n1:pids:/\n0::/",
            f"{mount}/memory.limit_in_bytes": 3 * GIB,
            f"{mount}/memory.usage_in_bytes": 2 * GIB,
            f"{mount}/memory.stat": f"inactive_file 1\ntotal_inactive_file {MIB}",
        },
    )
    assert available_bytes(CPU, root=root) == GIB + MIB


def test_no_limit_in_version_1_is_a_number_beyond_all_memory(tmp_path: Path) -> None:
    mount = "sys/fs/cgroup/memory"
    contents = {"proc/meminfo": MEMINFO, "proc/self/cgroup": "4:memory:/"}
    contents[f"{mount}/memory.limit_in_bytes"] = str(2**63 - 4096)
    contents[f"{mount}/memory.usage_in_bytes"] = str(GIB)
    assert available_bytes(CPU, root=files(tmp_path, contents)) == 8 * GIB


@pytest.mark.parametrize(("pages", "expected"), [(1000, 4_096_000), (-1, None)])
def test_a_system_without_these_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pages: int, expected: int | None
) -> None:
    values = {"SC_PHYS_PAGES": pages, "SC_PAGE_SIZE": 4096}
    monkeypatch.setattr(os, "sysconf_names", dict.fromkeys(values, 0))
    monkeypatch.setattr(os, "sysconf", values.__getitem__)
    assert available_bytes(CPU, root=tmp_path) == expected


def test_a_system_that_tells_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sysconf_names")
    assert available_bytes(CPU, root=tmp_path) is None


def test_this_machine_has_memory() -> None:
    available = available_bytes(jax.local_devices()[0])
    assert available is None or 10 * MIB < available < 2**50

"""Where a run is started: the threads and devices it gets."""

from __future__ import annotations

import os

import jax
import pytest

from sacformer_jax import Config
from sacformer_jax.launch import Launch, choose_cpu_devices, choose_xla_threads


@pytest.mark.parametrize(
    ("fields", "environment", "expected"),
    [
        ({"agent": "ppo"}, {}, "1"),
        ({"agent": "ppo", "critic_width": 256}, {}, None),
        ({"agent": "sac"}, {}, None),
        ({"agent": "ppo"}, {"PJRT_NPROC": "3"}, "3"),
        ({"agent": "ppo"}, {"NPROC": "2"}, None),
    ],
)
def test_narrow_ppo_has_one_thread_of_xla_unless_the_environment_says_otherwise(
    monkeypatch: pytest.MonkeyPatch,
    fields: dict[str, object],
    environment: dict[str, str],
    expected: str | None,
) -> None:
    monkeypatch.setattr(os, "environ", dict(environment))
    choose_xla_threads(Config.from_preset("paper", **fields))
    assert os.environ.get("PJRT_NPROC") == expected


@pytest.fixture
def chosen(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """What is asked of JAX, where nobody has said how many devices a CPU has; there are 4 cores."""
    asked: list[tuple[str, int]] = []
    monkeypatch.setattr(os, "environ", {})
    monkeypatch.setattr("sacformer_jax.launch.usable_cores", lambda: 4)
    monkeypatch.setattr(jax.config, "update", lambda *option: asked.append(option))
    return asked


@pytest.mark.parametrize(
    ("launch", "members", "begun_with", "expected"),
    [
        (Launch(), 1, None, None),
        (Launch(), 2, None, 2),
        (Launch(), 6, None, 3),
        (Launch(), 8, None, 4),
        (Launch(), 5, None, None),
        # A resumed run keeps its own, where that can be.
        (Launch(), 8, 1, None),
        (Launch(), 8, 2, 2),
        (Launch(), 8, 8, 4),
        (Launch(), 6, 4, 3),
        # What is asked for goes before.
        (Launch(seed_devices=1), 8, 2, None),
        (Launch(seed_devices=2), 8, None, 2),
        (Launch(seed_devices=8), 8, None, 4),
        (Launch(data_devices=2), 8, None, 4),
        (Launch(data_devices=2), 5, None, 2),
        (Launch(data_devices=3), 8, None, 3),
        (Launch(seed_devices=2, data_devices=2), 8, None, 4),
        # Refused later, with its reason.
        (Launch(seed_devices=0), 3, None, 3),
        (Launch(data_devices=0), 2, None, 2),
        # Several processes have a device each.
        (Launch(distributed=True), 8, None, None),
        (Launch(coordinator="host:1", num_processes=2, process_id=0), 8, None, None),
    ],
)
def test_members_have_a_core_each_as_far_as_there_are_some(
    chosen: list[tuple[str, int]],
    launch: Launch,
    members: int,
    begun_with: int | None,
    expected: int | None,
) -> None:
    choose_cpu_devices(Config(), launch, members, begun_with)
    assert chosen == ([] if expected is None else [("jax_num_cpu_devices", expected)])


def test_who_says_how_many_devices_a_cpu_has_decides(
    chosen: list[tuple[str, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    os.environ["XLA_FLAGS"] = "--xla_a=1 --xla_force_host_platform_device_count=3"
    choose_cpu_devices(Config(), Launch(), 8)
    os.environ["XLA_FLAGS"] = "--xla_a=1"
    with monkeypatch.context() as patched:
        patched.setattr(type(jax.config), "jax_num_cpu_devices", property(lambda _: 1))
        choose_cpu_devices(Config(), Launch(), 8)
    assert not chosen
    choose_cpu_devices(Config(), Launch(), 8)
    assert chosen == [("jax_num_cpu_devices", 4)]


@pytest.mark.parametrize("task", [{"env": "brax:ant"}, {"engine": "mjx"}, {"env": "gym:Pusher-v5"}])
def test_elsewhere_than_on_the_native_engine_it_is_not_done(
    chosen: list[tuple[str, int]], task: dict[str, str]
) -> None:
    choose_cpu_devices(Config().replace(**task), Launch(), 8)
    assert not chosen


@pytest.mark.parametrize(
    ("launch", "begun_with", "expected"),
    [
        (Launch(), None, None),
        (Launch(), 2, 2),
        (Launch(seed_devices=2), None, 2),
        (Launch(data_devices=2), None, 2),
    ],
)
def test_narrow_ppo_stays_on_one_device_unless_more_are_asked_for(
    chosen: list[tuple[str, int]], launch: Launch, begun_with: int | None, expected: int | None
) -> None:
    """One host call steps the environments of all its members, on all cores, which is faster."""
    choose_cpu_devices(Config.from_preset("paper", agent="ppo"), launch, 8, begun_with)
    assert chosen == ([] if expected is None else [("jax_num_cpu_devices", expected)])


def test_wide_ppo_has_a_core_for_each_member(chosen: list[tuple[str, int]]) -> None:
    config = Config.from_preset("paper", agent="ppo", critic_width=256)
    choose_cpu_devices(config, Launch(), 8)
    assert chosen == [("jax_num_cpu_devices", 4)]


def test_where_jax_has_been_used_its_devices_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sacformer_jax.launch.usable_cores", lambda: jax.device_count() + 1)
    before = jax.devices()
    choose_cpu_devices(Config(), Launch(), jax.device_count() + 1)
    assert jax.devices() == before

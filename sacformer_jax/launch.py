"""Where a run is started: on which devices, in how many processes."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from typing import Any

import jax

from sacformer_jax.config import Config, ConfigError
from sacformer_jax.cores import usable_cores
from sacformer_jax.envs.tasks import TASKS
from sacformer_jax.population import Devices
from sacformer_jax.values import first_line

_NARROW = 64
"""Width of layers up to which a second thread of XLA's did not help PPO, with 1 to 64 environments;
the updates of the other agents, whose layers are wider, it helps (docs/speed.md).
"""


@dataclasses.dataclass(frozen=True)
class Launch:
    """Devices and processes. None of it is part of a run: it may be resumed elsewhere."""

    seed_devices: int | None = None
    """Devices that the seeds are split over, of the five tasks on engine native up to the cores of
    a CPU; default: as many as divide them.
    """
    data_devices: int = 1
    """Devices that environments, replay and batch of each seed are split over."""
    distributed: bool = False
    """One of several processes, which find each other (SLURM, Open MPI, Cloud TPU)."""
    coordinator: str | None = None
    """The same without such a system: HOST:PORT of the first process, the same for all."""
    num_processes: int | None = None
    """With a coordinator: how many processes there are."""
    process_id: int | None = None
    """With a coordinator: which of them this is, from 0."""

    @property
    def _by_hand(self) -> tuple[str | int | None, ...]:
        return (self.coordinator, self.num_processes, self.process_id)

    @property
    def one_of_several(self) -> bool:
        """Whether there are other processes, or should be."""
        return self.distributed or self._by_hand != (None, None, None)

    def start(self, config: Config, num_members: int, begun_with: int | None = None) -> Devices:
        """Chooses threads and devices, meets the other processes; how the members lie on devices.

        To be called before JAX is used.

        Args:
          config: of the run.
          num_members: of the run.
          begun_with: see :func:`choose_cpu_devices`.

        Raises:
          ConfigError: as of :meth:`join`.
        """
        choose_xla_threads(config)
        choose_cpu_devices(config, self, num_members, begun_with)
        self.join()
        return self.devices(num_members)

    def join(self) -> None:
        """Meets the other processes, if there are any; before JAX is used.

        Raises:
          ConfigError: a coordinator without the other two, or they without it; or the processes
            cannot be found.
        """
        if not self.one_of_several:
            return
        if None in self._by_hand and self._by_hand != (None, None, None):
            raise ConfigError(
                f"coordinator={self.coordinator}, num_processes={self.num_processes}, "
                f"process_id={self.process_id}: give all three, or --distributed alone"
            )
        try:
            jax.distributed.initialize(self.coordinator, self.num_processes, self.process_id)
        except (RuntimeError, ValueError) as error:
            raise ConfigError(
                f"distributed=True: the other processes cannot be found ({first_line(error)}); "
                "outside SLURM, Open MPI and Cloud TPU give --coordinator, --num-processes and "
                "--process-id"
            ) from error

    def devices(self, num_members: int) -> Devices:
        """How so many members lie on the devices."""
        if self.seed_devices is not None:
            return Devices(self.seed_devices, self.data_devices)
        return Devices.for_members(num_members, self.data_devices)


def choose_xla_threads(config: Config) -> None:
    """Has XLA use one thread where more make a run slower: PPO with narrow networks on the CPU.

    Its operations are so small that handing them to another thread takes longer than doing them.
    To be called before JAX is used, later it changes nothing; who sets ``PJRT_NPROC`` or ``NPROC``
    decides for themselves. With several devices it is one for each of them. MuJoCo's threads are
    others.
    """
    if _is_narrow_ppo(config) and "NPROC" not in os.environ:
        os.environ.setdefault("PJRT_NPROC", "1")


def _is_narrow_ppo(config: Config) -> bool:
    width = max(config.actor.actor_width, config.critic.critic_width)
    return config.agent == "ppo" and width <= _NARROW


def choose_cpu_devices(
    config: Config, launch: Launch, num_members: int, begun_with: int | None = None
) -> None:
    """Makes the cores of a CPU devices, as many as the members are split over.

    One device splits every operation among the cores, and of networks as small as these handing
    over costs much of what that gains; with members on cores of their own several train 1.2 to 1.6
    times as fast (docs/scaling.md). That was measured, and is done, with MuJoCo tasks on engine
    native: physics in JAX factorizes matrices by LAPACK, whose kernels in jaxlib 0.10.2 wait for
    threads that the devices share (see :func:`sacformer_jax.layers.orthogonal`). PPO with narrow
    networks, which mostly steps environments, is slower so (0.85 times) and stays on one: the host
    calls of several devices take turns.

    To be called before JAX is used, later it changes nothing. Who says how many devices a CPU has,
    by ``JAX_NUM_CPU_DEVICES`` or XLA's flag, decides for themselves, and several processes get no
    more than one each.

    Args:
      config: of the run.
      launch: what the command line says.
      num_members: of the run.
      begun_with: devices that the members of a resumed run were split over, as only with the same
        number its next steps are the same bit for bit; taken where it can be.
    """
    settings: Any = jax.config  # has its options as attributes, which its type does not know
    by_flag = "--xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", "")
    if launch.one_of_several or by_flag or settings.jax_num_cpu_devices >= 0:
        return
    if config.task.env not in TASKS or config.task.engine == "mjx":
        return
    data, cores = max(1, launch.data_devices), usable_cores()
    members = begun_with
    if not members or num_members % members or members > max(1, cores // data):
        one = _is_narrow_ppo(config)
        members = 1 if one else Devices.for_members(num_members, data, cores).members
    number = min((launch.seed_devices or members) * data, cores)
    if number > 1:
        # Refused where JAX has been used: a program that calls the command line as a function.
        with contextlib.suppress(RuntimeError):
            settings.update("jax_num_cpu_devices", number)

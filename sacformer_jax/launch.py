"""Where a run is started: on which devices, in how many processes."""

from __future__ import annotations

import dataclasses
import os

import jax

from sacformer_jax.config import Config, ConfigError
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
    """Devices that the seeds are split over; default: as many as divide them."""
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

    def join(self) -> None:
        """Meets the other processes, if there are any; before JAX is used.

        Raises:
          ConfigError: a coordinator without the other two, or they without it; or the processes
            cannot be found.
        """
        by_hand = (self.coordinator, self.num_processes, self.process_id)
        if by_hand == (None, None, None) and not self.distributed:
            return
        if None in by_hand and by_hand != (None, None, None):
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
    decides for themselves. MuJoCo's threads are others.
    """
    width = max(config.actor.actor_width, config.critic.critic_width)
    if config.agent == "ppo" and width <= _NARROW and "NPROC" not in os.environ:
        os.environ.setdefault("PJRT_NPROC", "1")

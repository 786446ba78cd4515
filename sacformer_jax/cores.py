"""How many CPU cores this process may use, and how many threads XLA makes of them."""

from __future__ import annotations

import os


def usable_cores() -> int:
    """Cores this process may run on; where the system does not tell (macOS), all there are."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def xla_threads() -> int:
    """Threads that XLA's operations are split over on the CPU, as it decides when it starts."""
    for name in ("PJRT_NPROC", "NPROC"):
        value = os.environ.get(name, "").strip()
        if value.lstrip("+-").isdigit():
            return max(0, int(value))
    return usable_cores()

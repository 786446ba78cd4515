"""Timing in milliseconds and in GEMM units.

A GEMM unit is the time of one 1024 x 1024 x 1024 float32 matrix product, the fastest of many that
are made between the repetitions of everything else: on a shared machine absolute times do not hold,
ratios do.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

GEMM_SIZE = 1024
GEMM_FLOPS = 2 * GEMM_SIZE**3


class Clock:
    """Measures, and keeps the fastest matrix product seen.

    Attributes:
      gemm_ms: milliseconds of a GEMM unit so far.
    """

    def __init__(self) -> None:
        self._matrix = jnp.ones((GEMM_SIZE, GEMM_SIZE))
        self._product = jax.jit(jnp.matmul)
        jax.block_until_ready(self._product(self._matrix, self._matrix))
        self.gemm_ms = float("inf")
        self._time_products()

    def _time_products(self, count: int = 3) -> None:
        for _ in range(count):
            start = time.perf_counter()
            jax.block_until_ready(self._product(self._matrix, self._matrix))
            self.gemm_ms = min(self.gemm_ms, 1e3 * (time.perf_counter() - start))

    def milliseconds(self, run: Callable[[], Any], per: int = 1, repetitions: int = 7) -> float:
        """Median time of ``run`` over ``per`` things it does, after one run that is not counted."""
        return self.side_by_side({"run": run}, per, repetitions)["run"]

    def side_by_side(
        self, runs: Mapping[str, Callable[[], Any]], per: int = 1, repetitions: int = 7
    ) -> dict[str, float]:
        """The same for several, taking turns, so that what slows the machine down slows all."""
        for run in runs.values():
            jax.block_until_ready(run())
        times: dict[str, list[float]] = {name: [] for name in runs}
        for _ in range(repetitions):
            self._time_products()
            for name, run in runs.items():
                start = time.perf_counter()
                jax.block_until_ready(run())
                times[name].append(1e3 * (time.perf_counter() - start) / per)
        self._time_products()
        return {name: statistics.median(of_one) for name, of_one in times.items()}

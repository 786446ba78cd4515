"""What a run's newest checkpoint holds, in short."""

from __future__ import annotations

from pathlib import Path

from sacformer_jax import make_population
from sacformer_jax.checkpoint import RunFolder
from sacformer_jax.digests import digest


def state_digest(path: Path) -> str:
    """Digest of the whole train state of the newest checkpoint."""
    folder = RunFolder(path)
    run = folder.read_config()
    population = make_population(run.config, run.members)
    restored = folder.restore(
        population.abstract(), population.block_axes, population.shardings, move_aside=False
    )
    return digest(restored.state, population.block_axes)

"""The evaluations in a run's folder as rows of its study's table."""

from __future__ import annotations

from collections.abc import Sequence

from machine import UNKNOWN
from study_table import MORE, Row

from sacformer_jax.checkpoint import RunFolder
from sacformer_jax.logging import read_records


def rows_of(
    study: str, run: str, folder: RunFolder, commits: Sequence[str], cpus: Sequence[str]
) -> list[Row]:
    """The evaluations in a run's folder, seed by seed; none if it has not begun.

    Args:
      study: name of the study.
      run: name of the run.
      folder: of the run.
      commits: by which versions of the code it was trained.
      cpus: on which models of processors.
    """
    if not folder.timings_path.exists():
        return []
    seconds, total = {}, 0.0
    for record in read_records(folder.timings_path):
        total += record["chunk_seconds"]
        seconds[record["env_steps"]] = total
    file = folder.read_config()
    engine = folder.read_spec().engine
    return [
        {
            "study": study,
            "run": run,
            "agent": file.config.agent,
            "preset": file.config.preset,
            "env": file.config.task.env,
            "engine": engine,
            "seed": member.seed,
            "env_steps": record["env_steps"],
            "return_mean": round(record["return_mean"], 2),
            "return_std": round(record["return_std"], 2),
            "episodes": record["episodes"],
            "wall_s": round(seconds.get(record["env_steps"], 0.0), 1),
            "commit": MORE.join(commits) or UNKNOWN,
            "cpu": MORE.join(cpus) or UNKNOWN,
        }
        for member in file.members
        for record in read_records(folder.metrics_path(member.name), "eval")
    ]

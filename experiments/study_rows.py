"""The evaluations in a run's folder as rows of its study's table."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence

from machine import UNKNOWN
from study_table import MORE, Row

from sacformer_jax import Config
from sacformer_jax.checkpoint import RunFolder
from sacformer_jax.logging import read_records

NOT_COMPARED = {"run_dir", "total_env_steps"}
"""Fields that may differ between a run's folder and its study: where it lies, how far it goes."""


def settings_digest(config: Config) -> str:
    """Eight digits of all that makes a run's seeds comparable with others: every field that is not
    at its default, but for the seeds and ``NOT_COMPARED``. A field added later changes nothing.
    """
    defaults, own = Config().flat(), config.flat()
    named = {
        field: value
        for field, value in own.items()
        if field not in NOT_COMPARED | {"seed", "seeds"} and value != defaults[field]
    }
    return hashlib.sha256(json.dumps(named, sort_keys=True).encode()).hexdigest()[:8]


def rows_of(
    study: str, run: str, folder: RunFolder, commits: Sequence[str], cpus: Sequence[str]
) -> list[Row]:
    """The evaluations in a run's folder, seed by seed; none if it has not begun.

    Args:
      study: name of the study.
      run: name of the run.
      folder: of the run.
      commits: by which versions of the code it was trained.
      cpus: on how many cores of which processors.
    """
    if not folder.timings_path.exists():
        return []
    seconds, total = {}, 0.0
    for record in read_records(folder.timings_path):
        total += record["chunk_seconds"]
        seconds[record["env_steps"]] = total
    file = folder.read_config()
    engine, settings = folder.read_spec().engine, settings_digest(file.config)

    def trained_until(env_steps: int) -> float | str:
        """Seconds; nothing where that is not known, as records of a resumed run can be lost."""
        known = seconds.get(env_steps)
        if known is not None:
            return round(known, 1)
        return 0.0 if env_steps <= file.config.env_steps_of_prefill else ""

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
            "wall_s": trained_until(record["env_steps"]),
            "commit": MORE.join(commits) or UNKNOWN,
            "cpu": MORE.join(cpus) or UNKNOWN,
            "settings": settings,
        }
        for member in file.members
        for record in read_records(folder.metrics_path(member.name), "eval")
    ]

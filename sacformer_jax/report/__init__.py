"""One self-contained HTML page about one or several runs, finished or not.

Curves with intervals over environment steps and over time, differences of the settings,
throughput, faults counted, the newest video of each.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sacformer_jax.config import ConfigError
from sacformer_jax.report.page import html_page
from sacformer_jax.report.reading import read_run
from sacformer_jax.run_folder import labels


def report(runs: Sequence[str | Path], to: str | Path | None = None) -> Path:
    """Writes the page; nothing else is changed.

    Args:
      runs: folders of runs.
      to: the file; default: ``report.html`` in the folder of a single run, or here.

    Returns:
      The file.

    Raises:
      CheckpointError: a folder holds no run.
      ConfigError: no run was given, or one twice, or the file cannot be written.
    """
    if not runs:
        raise ConfigError("runs=(): give the folder of at least one run")
    read = [read_run(path, label) for path, label in zip(runs, labels(runs), strict=True)]
    default = read[0].path / "report.html" if len(read) == 1 else Path("report.html")
    path = Path(to) if to is not None else default
    try:
        path.write_text(html_page(read))
    except OSError as error:
        raise ConfigError(f"to={str(path)!r}: cannot be written ({error.strerror})") from error
    return path


__all__ = ["report"]

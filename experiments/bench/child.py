"""Measurements that need a process of their own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

EXPERIMENTS = Path(__file__).resolve().parents[1]


def answer_of(
    module: str, *arguments: str, limit_seconds: float, environment: Mapping[str, str] | None = None
) -> Any:
    """Runs ``python -m module arguments`` and reads the JSON in its last line of output.

    Args:
      module: which prints it, found from the folder of the experiments.
      arguments: for it.
      limit_seconds: for the whole process.
      environment: variables beside, or instead of, those of this process.

    Raises:
      RuntimeError: it failed; the message ends with its last line of error output.
      subprocess.TimeoutExpired: it took longer than ``limit_seconds``.
    """
    done = subprocess.run(
        [sys.executable, "-m", module, *arguments],
        env={**os.environ, "PYTHONPATH": str(EXPERIMENTS), **(environment or {})},
        capture_output=True,
        text=True,
        timeout=limit_seconds,
    )
    if done.returncode:
        last = (done.stderr.strip() or "no error output").splitlines()[-1]
        raise RuntimeError(f"{' '.join((module, *arguments))}: status {done.returncode}: {last}")
    return json.loads(done.stdout.splitlines()[-1])

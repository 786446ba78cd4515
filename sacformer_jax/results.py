"""What a run leaves to who started it from Python."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from sacformer_jax.logging import Record


@dataclasses.dataclass(frozen=True)
class RunResult:
    """What a run left.

    Attributes:
      path: the run's folder.
      env_steps: environment steps done, by each member.
      evaluations: the ``"eval"`` records of ``metrics.jsonl``; of several members one after the
        other, with the name as ``"member"``.
      interrupted: stopped by Ctrl-C (or SIGTERM) before its end.
      stopped: stopped by a callback before its end.
    """

    path: Path
    env_steps: int
    evaluations: list[Record]
    interrupted: bool
    stopped: bool = False

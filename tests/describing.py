"""What ``sacformer describe`` says of a run, in this process."""

from __future__ import annotations

import contextlib
import io
import json
from pathlib import Path
from typing import Any

from sacformer_jax.cli import main


def described(run: Path) -> dict[str, Any]:
    """Its JSON."""
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert main(["describe", str(run), "--json"]) == 0
    said: dict[str, Any] = json.loads(printed.getvalue())
    return said

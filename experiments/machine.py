"""What machine this is."""

from __future__ import annotations

import platform
from pathlib import Path

UNKNOWN = "unknown"


def cpu_model() -> str:
    """The processor: its name and, as virtual machines give many the same, its model in numbers
    (family/model/stepping).
    """
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    facts = {name.strip(): value.strip() for name, _, value in (x.partition(":") for x in lines)}
    name = facts.get("model name") or platform.processor() or UNKNOWN
    numbers = [facts[key] for key in ("cpu family", "model", "stepping") if key in facts]
    return f"{name} {'/'.join(numbers)}".strip()


def cpu_with_cores(cores: int) -> str:
    """The processor, and how many of its cores a run had."""
    model = cpu_model()
    return model if model == UNKNOWN else f"{model}, {cores} core{'s' if cores > 1 else ''}"

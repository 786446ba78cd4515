"""How fast it is, in milliseconds and in GEMM units; see bench/clock.py.

python experiments/benchmark.py                       # every part
python experiments/benchmark.py --part update --json results.json
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
from bench import update
from bench.clock import Clock

from sacformer_jax.cores import usable_cores

PARTS: dict[str, Callable[[Clock], dict[str, float]]] = {
    "update": update.measure,
}


def machine() -> dict[str, Any]:
    """What it runs on."""
    names = ("jax", "jaxlib", "flax", "mujoco", "mujoco-mjx", "gymnasium", "brax", "numpy")
    return {
        "machine.cpu": _cpu_model(),
        "machine.cores": usable_cores(),
        "machine.devices": str(jax.devices()),
        "machine.python": platform.python_version(),
        **{f"version.{name}": version(name) for name in names},
    }


def _cpu_model() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def main(arguments: Sequence[str] | None = None) -> int:
    """Measures the parts asked for, prints a table, writes the JSON."""
    parser = argparse.ArgumentParser(description="Measures how fast sacformer-jax is.")
    parser.add_argument("--part", nargs="+", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--json", type=Path, help="write the results there, too")
    args = parser.parse_args(arguments)
    clock, results = Clock(), machine()
    for part in args.part:
        print(f"measuring {part} …", file=sys.stderr)
        results |= PARTS[part](clock)
    results["gemm_ms"] = clock.gemm_ms
    print("| what | |\n| --- | --- |")
    for name, value in results.items():
        shown = f"{value:,.3g}" if isinstance(value, float) and value < 1e3 else value
        shown = f"{value:,.0f}" if isinstance(value, float) and value >= 1e3 else shown
        print(f"| {name} | {shown} |")
    if args.json:
        args.json.write_text(json.dumps(results, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""How fast it is, in milliseconds and in GEMM units; see bench/clock.py.

python experiments/benchmark.py                       # every part
python experiments/benchmark.py --part update --json results.json
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

import jax
from bench import checkpointing, compiling, environments, members, peers, scaling, training, update
from bench.clock import Clock
from machine import cpu_model

from sacformer_jax.cores import usable_cores

Results = dict[str, float | str]
Measure = Callable[[Clock], Mapping[str, float | str]]

PARTS: dict[str, Measure] = {
    "update": update.measure,
    "env": environments.measure,
    "train": training.measure,
    "peer": peers.measure,
    "scaling": scaling.measure,
    "members": members.measure,
    "checkpoint": checkpointing.measure,
    "compile": compiling.measure,
}
"""In the order they run: first the pieces, then the whole of them, then how it grows."""

THREAD_SETTINGS = (
    "XLA_FLAGS",
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "PJRT_NPROC",
    "NPROC",
)
"""Variables of the environment that decide how many threads are used (the last two by XLA)."""


def machine() -> Results:
    """What it runs on, and how busy that was."""
    names = ("jax", "jaxlib", "flax", "mujoco", "mujoco-mjx", "gymnasium", "brax", "numpy")
    found: Results = {
        "machine.cpu": cpu_model(),
        "machine.cores": usable_cores(),
        "machine.cores_of_all": os.cpu_count() or 0,
        "machine.devices": str(jax.devices()),
        "machine.python": platform.python_version(),
        **{f"machine.env.{name}": os.environ.get(name, "") for name in THREAD_SETTINGS},
        **{f"version.{name}": version(name) for name in names},
    }
    if hasattr(os, "sched_getaffinity"):
        found["machine.affinity"] = ",".join(map(str, sorted(os.sched_getaffinity(0))))
    if hasattr(os, "getloadavg"):
        found["machine.load_average_at_start"] = os.getloadavg()[0]
    return found


def run(parts: Mapping[str, Measure], results: Results, path: Path | None) -> bool:
    """Measures the parts, each by itself: one that fails is told, and the others go on.

    Args:
      parts: by name.
      results: filled by flat keys; ``PART.error`` is why a part failed, ``seconds.PART`` how long
        it took, ``gemm_ms`` the GEMM unit so far.
      path: where the results are written as JSON after each part.

    Returns:
      Whether no part failed.
    """
    clock, good = Clock(), True
    for name, measure in parts.items():
        print(f"measuring {name} …", file=sys.stderr, flush=True)
        start = time.perf_counter()
        try:
            results |= measure(clock)
        except Exception as error:  # whatever it is, hours of other parts must not be lost
            traceback.print_exc()
            results[f"{name}.error"] = f"{type(error).__name__}: {error}"
            good = False
        results[f"seconds.{name}"] = time.perf_counter() - start
        results["gemm_ms"] = clock.gemm_ms
        if path:
            write(path, results)
    return good


def write(path: Path, results: Mapping[str, float | str]) -> None:
    """Writes flat JSON; at no time is the file there in part."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(path.name + ".part")
    beside.write_text(json.dumps(results, indent=2) + "\n")
    beside.replace(path)


def table(results: Mapping[str, float | str]) -> str:
    """Markdown, with a heading for the first word of the keys."""
    groups: dict[str, list[str]] = {}
    for key, value in results.items():
        group, _, rest = key.partition(".")
        groups.setdefault(group, []).append(f"| {rest or group} | {shown(value)} |")
    return "\n\n".join(
        f"## {group}\n\n| what | |\n| --- | --- |\n" + "\n".join(lines)
        for group, lines in groups.items()
    )


def shown(value: float | str) -> str:
    """Three digits, more only before the point."""
    if isinstance(value, float):
        return f"{value:,.3g}" if abs(value) < 1e3 else f"{value:,.0f}"
    # What an error says may have bars and line breaks of its own.
    return " ".join(f"{value}".replace("|", "\\|").split())


def main(arguments: Sequence[str] | None = None, parts: Mapping[str, Measure] = PARTS) -> int:
    """Measures the parts asked for, prints a table, writes the JSON; 1 if one of them failed."""
    parser = argparse.ArgumentParser(description="Measures how fast sacformer-jax is.")
    parser.add_argument("--part", nargs="+", choices=list(parts), default=list(parts))
    parser.add_argument("--json", type=Path, help="write the results there, too, after each part")
    args = parser.parse_args(arguments)
    results = machine()
    good = run({name: parts[name] for name in parts if name in args.part}, results, args.json)
    print(table(results))
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())

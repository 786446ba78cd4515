"""The commands that look at runs: all but ``sacformer train`` and ``resume``."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from sacformer_jax.presets import Resolved


@dataclasses.dataclass(frozen=True)
class EvaluateArgs:
    """Evaluate a run's policy under its mean action."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    gymnasium: bool = False
    """In a real gymnasium.make environment, beside random actions; otherwise on our own."""
    episodes: int = 10
    """Number of episodes."""
    policy: Literal["best", "latest"] = "best"
    """Which policy: best or latest."""
    member: str | None = None
    """Of a run of several, which: its seed in training, or its name; default: each."""
    seed: int = 0
    """Seed of the resets."""
    json: bool = False
    """Print a JSON line (for each member) instead of a table."""


@dataclasses.dataclass(frozen=True)
class DescribeArgs:
    """Print a run's settings, their sources, counters and digest."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    json: bool = False
    """Print JSON; it holds the config, the counters and a SHA-256 digest of the train state."""


@dataclasses.dataclass(frozen=True)
class ExtractArgs:
    """Write some members of a run as a run of its own."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    to: Path
    """Folder of the new run."""
    members: tuple[str, ...]
    """Their seeds, or names."""


@dataclasses.dataclass(frozen=True)
class ReportArgs:
    """Write one self-contained HTML page about runs: curves, differences, throughput, faults."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of the runs."""
    to: Path | None = None
    """The file; default: report.html in the folder of a single run, or here."""


@dataclasses.dataclass(frozen=True)
class CollectArgs:
    """Write a policy's episodes as a new local Minari dataset."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    to: str
    """Id of the dataset, like hopper/medium-v0; lies under $MINARI_DATASETS_PATH."""
    episodes: int = 100
    """Number of episodes."""
    actions: Literal["mean", "sample", "random"] = "sample"
    """The policy's mean actions, samples of it, or uniformly random ones."""
    policy: Literal["best", "latest"] = "best"
    """Which policy: best or latest."""
    member: str | None = None
    """Of a run of several, which: its seed in training, or its name."""
    seed: int = 0
    """Seed of resets and samples."""


@dataclasses.dataclass(frozen=True)
class ExportArgs:
    """Write a run's policy as a file that runs without this package."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    to: Path
    """The file to write; there must be none yet."""
    format: Literal["jax", "onnx"] = "jax"
    """A program of jax.export (extra export), or an ONNX model (extra onnx)."""
    num_envs: int | None = None
    """Number of environments it acts in at once; default: any."""
    policy: Literal["best", "latest"] = "best"
    """Which policy: best or latest."""
    member: str | None = None
    """Of a run of several, which: its seed in training, or its name."""
    stochastic: bool = False
    """Draw actions instead of taking the mean; needs num-envs."""
    platforms: tuple[str, ...] = ("cpu", "cuda", "tpu")
    """Of format jax: what it can run on, of cpu, cuda, rocm and tpu."""


def evaluate(args: list[str]) -> int:
    """``sacformer evaluate``."""
    from sacformer_jax import api
    from sacformer_jax.checkpoint import RunFolder
    from sacformer_jax.gymnasium_eval import evaluate_random

    parsed = tyro.cli(EvaluateArgs, args=args, prog="sacformer evaluate")
    members: list[str | None] = [parsed.member]
    if parsed.member is None:
        names = [member.name for member in RunFolder(parsed.run).opened().read_config().members]
        members = [*names] if len(names) > 1 else [None]
    rows: dict[str, dict[str, Any]] = {}
    for member in members:
        record = api.evaluate(
            parsed.run,
            episodes=parsed.episodes,
            gymnasium=parsed.gymnasium,
            policy=parsed.policy,
            seed=parsed.seed,
            member=member,
        )
        if parsed.json:
            print(json.dumps(record if member is None else {"member": member, **record}))
        rows[f"{parsed.policy} policy" + (f" of {member}" if member else "")] = record
    if parsed.json:
        return 0
    if parsed.gymnasium:
        spec = RunFolder(parsed.run).read_spec()
        baseline = evaluate_random(
            record["env"], parsed.episodes, parsed.seed, spec.wrapping, spec.max_episode_steps
        )
        rows["random actions"] = baseline.record()
    print(f"{record['env']}, {parsed.episodes} episodes")
    width = max(15, *(len(name) for name in rows))
    for name, row in rows.items():
        print(
            f"  {name:<{width}} return {row['return_mean']:9.1f} ± {row['return_std']:.1f}   "
            f"length {row['length_mean']:.0f}"
        )
    return 0


def collect(args: list[str]) -> int:
    """``sacformer collect``."""
    from sacformer_jax import api
    from sacformer_jax.checkpoint import RunFolder

    parsed = tyro.cli(CollectArgs, args=args, prog="sacformer collect")
    path = api.collect(
        parsed.run,
        to=parsed.to,
        episodes=parsed.episodes,
        actions=parsed.actions,
        policy=parsed.policy,
        seed=parsed.seed,
        member=parsed.member,
    )
    wrapped = RunFolder(parsed.run).read_spec().wrapping.words()
    use = f"holds what the wrappers show ({', '.join(wrapped)})"
    if not wrapped:
        use = f"start from it with: sacformer train --dataset {parsed.to}"
    print(f"written to {path}; {use}")
    return 0


def report(args: list[str]) -> int:
    """``sacformer report``."""
    from sacformer_jax.report import report as write_report

    parsed = tyro.cli(ReportArgs, args=args, prog="sacformer report")
    print(f"written to {write_report(parsed.runs, parsed.to)}")
    return 0


def describe_run(args: list[str]) -> int:
    """``sacformer describe RUN``."""
    from sacformer_jax.agents.faults import NO_FAULT
    from sacformer_jax.checkpoint import RunFolder
    from sacformer_jax.digests import digest
    from sacformer_jax.population import make_population

    parsed = tyro.cli(DescribeArgs, args=args, prog="sacformer describe")
    folder = RunFolder(parsed.run).opened()
    run = folder.read_config()
    names = [member.name for member in run.members]
    state_facts: dict[str, Any] = {"counters": None, "digest": None}
    if folder.latest_step() is not None:
        population = make_population(run.config, run.members)
        block_axes = population.stored(population.block_axes)
        abstract = population.stored(population.abstract())
        state = folder.restore(abstract, block_axes, move_aside=False).state
        counters = {name: np.asarray(value) for name, value in vars(state.counters).items()}
        # A number where there is one member or they have it in common.
        state_facts["counters"] = {
            name: int(value.reshape(-1)[0]) if value.size == 1 else value.tolist()
            for name, value in counters.items()
        }
        faults = np.atleast_1d(state.counters.first_fault).tolist()
        checked = population.program.agent.checked
        named = [None if fault == NO_FAULT else checked[fault] for fault in faults]
        state_facts["counters"]["first_fault"] = named[0] if len(named) == 1 else named
        state_facts["digest"] = digest(state, block_axes)
    if parsed.json:
        facts = {"config": run.config.to_dict(), "sources": run.sources, "members": names}
        print(json.dumps({**facts, **state_facts}))
        return 0
    print_config(Resolved(run.config, run.sources))
    if len(names) > 1:
        print(f"{'members':<24}{', '.join(names)}")
    for name, value in (state_facts["counters"] or {}).items():
        each = value if isinstance(value, list) else [value]
        print(f"{name:<24}{', '.join(f'{v:,}' if isinstance(v, int) else str(v) for v in each)}")
    print(f"{'digest':<24}{state_facts['digest']}")
    return 0


def print_config(resolved: Resolved) -> None:
    """Every setting and where it comes from."""
    for name, value in resolved.config.flat().items():
        shown = repr(value) if value in ("", None) else str(value)
        print(f"{name:<24}{shown:<15} {resolved.sources[name]}")


def extract(args: list[str]) -> int:
    """``sacformer extract``."""
    from sacformer_jax import extraction

    parsed = tyro.cli(ExtractArgs, args=args, prog="sacformer extract")
    path = extraction.extract(parsed.run, parsed.members, parsed.to)
    print(f"written to {path}; continue it with: sacformer resume {path}")
    return 0


def export(args: list[str]) -> int:
    """``sacformer export``."""
    from sacformer_jax.export import export_policy
    from sacformer_jax.policy import load_policy

    parsed = tyro.cli(ExportArgs, args=args, prog="sacformer export")
    path = export_policy(
        load_policy(parsed.run, parsed.policy, parsed.member),
        parsed.to,
        format=parsed.format,
        num_envs=parsed.num_envs,
        deterministic=not parsed.stochastic,
        platforms=parsed.platforms,
    )
    print(f"written to {path}; how to call it: docs/deploy.md")
    return 0

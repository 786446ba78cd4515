"""The command line: ``sacformer train | resume | evaluate | describe``, from the typed config."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import tyro

from sacformer_jax import checkpoint, compilation_cache
from sacformer_jax.checkpoint import CheckpointError, RunFolder
from sacformer_jax.config import Config, ConfigError
from sacformer_jax.presets import Resolved, resolve

EXIT_BAD_INPUT = 2
"""Exit code of refused input."""
EXIT_INTERRUPTED = 3
"""Exit code of a run stopped by SIGINT or SIGTERM after saving a checkpoint."""

EXIT_KILLED = 130
"""Exit code of a program stopped by SIGINT before it could save (the shell's convention)."""

_USAGE = """usage: sacformer COMMAND ...

commands (each has --help):
  train      train a policy in a new run folder
  resume     continue a run from its newest checkpoint
  evaluate   evaluate a run's policy, here or in Gymnasium
  describe   print every setting and where it comes from, or a run's state
"""


@dataclasses.dataclass(frozen=True)
class ResumeArgs:
    """Continue a run from its newest checkpoint."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    total_env_steps: int | None = None
    """Train up to here instead of the configured total."""


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
    seed: int = 0
    """Seed of the resets."""
    json: bool = False
    """Print one JSON line instead of a table."""


@dataclasses.dataclass(frozen=True)
class DescribeArgs:
    """Print a run's settings, their sources, counters and digest."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    json: bool = False
    """Print JSON; it holds the config, the counters and a SHA-256 digest of the train state."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point of the ``sacformer`` command; returns the exit code."""
    args = list(sys.argv[1:] if argv is None else argv)
    commands: dict[str, Callable[[list[str]], int]] = {
        "train": _train,
        "resume": _resume,
        "evaluate": _evaluate,
        "describe": _describe,
    }
    if not args or args[0] in ("-h", "--help"):
        print(_USAGE, end="")
        return 0 if args else EXIT_BAD_INPUT
    if args[0] == "--version":
        print(checkpoint.__version__)
        return 0
    if args[0] not in commands:
        return _refused(f"command {args[0]!r} does not exist; there are {', '.join(commands)}")
    compilation_cache.enable()
    try:
        return commands[args[0]](args[1:])
    except (ConfigError, CheckpointError) as error:
        return _refused(str(error))
    except (KeyboardInterrupt, jax.errors.JaxRuntimeError) as error:
        # Inside a host call XLA makes an error of its own of it, which holds the traceback.
        if not isinstance(error, KeyboardInterrupt) and "KeyboardInterrupt" not in str(error):
            raise
        print("stopped at once; what was saved before is intact", file=sys.stderr)
        return EXIT_KILLED


def _refused(message: str) -> int:
    print(f"error: {message}", file=sys.stderr)
    return EXIT_BAD_INPUT


def _parse_config(args: list[str], prog: str) -> Resolved:
    """Reads flags over the preset's values for the agent and environment they name."""
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    # A flag without its value is left for the real parser to refuse.
    first.add_argument("--preset", nargs="?", default="cpu", const="cpu")
    first.add_argument("--agent", nargs="?")
    first.add_argument("--env", nargs="?")
    chosen = vars(first.parse_known_args(args)[0])
    preset = chosen.pop("preset")
    base = resolve(preset, {name: value for name, value in chosen.items() if value is not None})
    config = tyro.cli(
        Annotated[Config, tyro.conf.OmitArgPrefixes], args=args, default=base.config, prog=prog
    )
    flags = {arg.split("=")[0].lstrip("-").replace("-", "_") for arg in args if arg[:2] == "--"}
    names = flags | {flag.removeprefix("no_") for flag in flags}
    given = {name: value for name, value in config.flat().items() if name in names}
    return resolve(preset, given, "command line")


def _train(args: list[str]) -> int:
    from sacformer_jax.runner import train

    resolved = _parse_config(args, "sacformer train")
    result = train(resolved.config, resolved.sources)
    return EXIT_INTERRUPTED if result.interrupted else 0


def _resume(args: list[str]) -> int:
    from sacformer_jax.runner import resume

    parsed = tyro.cli(ResumeArgs, args=args, prog="sacformer resume")
    result = resume(parsed.run, parsed.total_env_steps)
    return EXIT_INTERRUPTED if result.interrupted else 0


def _evaluate(args: list[str]) -> int:
    from sacformer_jax.api import evaluate
    from sacformer_jax.gymnasium_eval import evaluate_random

    parsed = tyro.cli(EvaluateArgs, args=args, prog="sacformer evaluate")
    record = evaluate(
        parsed.run,
        episodes=parsed.episodes,
        gymnasium=parsed.gymnasium,
        policy=parsed.policy,
        seed=parsed.seed,
    )
    if parsed.json:
        print(json.dumps(record))
        return 0
    rows = {f"{parsed.policy} policy": record}
    if parsed.gymnasium:
        baseline = evaluate_random(record["env"], parsed.episodes, parsed.seed)
        rows["random actions"] = baseline.record()
    print(f"{record['env']}, {parsed.episodes} episodes")
    for name, row in rows.items():
        print(
            f"  {name:<15} return {row['return_mean']:9.1f} ± {row['return_std']:.1f}   "
            f"length {row['length_mean']:.0f}"
        )
    return 0


def _describe(args: list[str]) -> int:
    if args and not args[0].startswith("-"):
        return _describe_run(tyro.cli(DescribeArgs, args=args, prog="sacformer describe"))
    as_json = "--json" in args
    resolved = _parse_config([a for a in args if a != "--json"], "sacformer describe")
    resolved.config.validated()
    if as_json:
        print(json.dumps({"config": resolved.config.to_dict(), "sources": resolved.sources}))
    else:
        _print_config(resolved)
    return 0


def _describe_run(parsed: DescribeArgs) -> int:
    from sacformer_jax.train import make_program

    folder = RunFolder(parsed.run).opened()
    run = folder.read_config()
    state_facts: dict[str, Any] = {"counters": None, "digest": None}
    if folder.latest_step() is not None:
        program = make_program(run.config)
        state = folder.restore(jax.eval_shape(program.init, jax.random.key(0))).state
        counters = dataclasses.asdict(state.counters)
        state_facts["counters"] = {name: int(value) for name, value in counters.items()}
        state_facts["digest"] = checkpoint.digest(state)
    if parsed.json:
        print(json.dumps({"config": run.config.to_dict(), "sources": run.sources, **state_facts}))
        return 0
    _print_config(Resolved(run.config, run.sources))
    for name, value in (state_facts["counters"] or {}).items():
        print(f"{name:<24}{value:,}")
    print(f"{'digest':<24}{state_facts['digest']}")
    return 0


def _print_config(resolved: Resolved) -> None:
    for name, value in resolved.config.flat().items():
        shown = repr(value) if value in ("", None) else str(value)
        print(f"{name:<24}{shown:<15} {resolved.sources[name]}")


if __name__ == "__main__":
    sys.exit(main())

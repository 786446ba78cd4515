"""The command line: ``sacformer train | resume | evaluate | render | plot | report | …``."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import jax
import tyro

from sacformer_jax import commands, compilation_cache, picture_commands
from sacformer_jax.checkpoint import CheckpointError, RunFolder
from sacformer_jax.config import Config, ConfigError
from sacformer_jax.launch import Launch
from sacformer_jax.loop import DivergedError
from sacformer_jax.presets import Resolved, resolve
from sacformer_jax.tracking import Tracking, resumed_tracking
from sacformer_jax.version import __version__

EXIT_BAD_INPUT = 2
"""Exit code of refused input."""
EXIT_INTERRUPTED = 3
"""Exit code of a run stopped by SIGINT or SIGTERM after saving a checkpoint."""

EXIT_DIVERGED = 4
"""Exit code of a run that ended because too many updates were not finite."""
EXIT_KILLED = 130
"""Exit code of a program stopped by SIGINT before it could save (the shell's convention)."""

_USAGE = """usage: sacformer COMMAND ...

commands (each has --help):
  train      train a policy in a new run folder
  resume     continue a run from its newest checkpoint
  evaluate   evaluate a run's policy, here or in Gymnasium
  render     make a video of a run's policy
  plot       draw the pictures of a run, or compare several
  collect    write a policy's episodes as a Minari dataset
  report     write an HTML page about one or several runs
  describe   print every setting and where it comes from, or a run's state
  extract    write some seeds of a run as a run of their own
  export     write a run's policy as a file that runs without this package
"""


@dataclasses.dataclass(frozen=True)
class ResumeArgs:
    """Continue a run from its newest checkpoint."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    total_env_steps: int | None = None
    """Train up to here instead of the configured total."""
    launch: Annotated[Launch, tyro.conf.OmitArgPrefixes] = dataclasses.field(default_factory=Launch)


@dataclasses.dataclass(frozen=True)
class _ConfigArgs:
    """Settings of a run, where it runs and where it is tracked."""

    config: Config
    launch: Launch
    tracking: Tracking


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point of the ``sacformer`` command; returns the exit code."""
    args = list(sys.argv[1:] if argv is None else argv)
    by_name: dict[str, Callable[[list[str]], int]] = {
        "train": _train,
        "resume": _resume,
        "evaluate": commands.evaluate,
        "render": picture_commands.render,
        "plot": picture_commands.plot,
        "collect": commands.collect,
        "report": commands.report,
        "describe": _describe,
        "extract": commands.extract,
        "export": commands.export,
    }
    if not args or args[0] in ("-h", "--help"):
        print(_USAGE, end="")
        return 0 if args else EXIT_BAD_INPUT
    if args[0] == "--version":
        print(__version__)
        return 0
    if args[0] not in by_name:
        return _refused(f"command {args[0]!r} does not exist; there are {', '.join(by_name)}")
    return exit_code(lambda: by_name[args[0]](args[1:]))


def exit_code(command: Callable[[], int]) -> int:
    """Runs a command with the compilation cache; errors are told in a line and become codes."""
    compilation_cache.enable()
    try:
        return command()
    except (ConfigError, CheckpointError) as error:
        return _refused(str(error))
    except DivergedError as fault:
        print(f"error: {fault}", file=sys.stderr)
        return EXIT_DIVERGED
    except (KeyboardInterrupt, jax.errors.JaxRuntimeError) as error:
        # Inside a host call XLA makes an error of its own of it, which holds the traceback.
        if not isinstance(error, KeyboardInterrupt) and "KeyboardInterrupt" not in str(error):
            raise
        print("stopped at once; what was saved before is intact", file=sys.stderr)
        return EXIT_KILLED


def _refused(message: str) -> int:
    print(f"error: {message}", file=sys.stderr)
    return EXIT_BAD_INPUT


@dataclasses.dataclass(frozen=True)
class Parsed:
    """What the flags of ``train`` and ``describe`` say."""

    resolved: Resolved
    launch: Launch
    tracking: Tracking


def parse_config(args: list[str], prog: str) -> Parsed:
    """Reads flags over the preset's values for the agent and environment they name."""
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    # A flag without its value is left for the real parser to refuse.
    first.add_argument("--preset", nargs="?", default="cpu", const="cpu")
    first.add_argument("--agent", nargs="?")
    first.add_argument("--env", nargs="?")
    chosen = vars(first.parse_known_args(args)[0])
    preset = chosen.pop("preset")
    base = resolve(preset, {name: value for name, value in chosen.items() if value is not None})
    parsed = tyro.cli(
        Annotated[_ConfigArgs, tyro.conf.OmitArgPrefixes],
        args=args,
        default=_ConfigArgs(base.config, Launch(), Tracking()),
        prog=prog,
    )
    flags = {arg.split("=")[0].lstrip("-").replace("-", "_") for arg in args if arg[:2] == "--"}
    names = flags | {flag.removeprefix("no_") for flag in flags}
    given = {name: value for name, value in parsed.config.flat().items() if name in names}
    resolved = resolve(preset, given, "command line")
    return Parsed(resolved, parsed.launch, parsed.tracking)


def _train(args: list[str]) -> int:
    from sacformer_jax.runner import train

    parsed = parse_config(args, "sacformer train")
    config = parsed.resolved.config.validated()
    callbacks = parsed.tracking.callbacks()
    devices = parsed.launch.start(config, len(config.all_seeds))
    result = train(config, parsed.resolved.sources, devices=devices, callbacks=callbacks)
    return EXIT_INTERRUPTED if result.interrupted else 0


def _resume(args: list[str]) -> int:
    from sacformer_jax.runner import resume

    parsed = tyro.cli(ResumeArgs, args=args, prog="sacformer resume")
    folder = RunFolder(parsed.run).opened()
    known, begun_with = folder.read_config(), folder.latest_devices().get("members")
    devices = parsed.launch.start(known.config, len(known.members), begun_with)
    callbacks = resumed_tracking(folder.path)
    result = resume(parsed.run, parsed.total_env_steps, devices=devices, callbacks=callbacks)
    return EXIT_INTERRUPTED if result.interrupted else 0


def _describe(args: list[str]) -> int:
    if args and not args[0].startswith("-"):
        return commands.describe_run(args)
    as_json = "--json" in args
    flags = [flag for flag in args if flag != "--json"]
    resolved = parse_config(flags, "sacformer describe").resolved
    resolved.config.validated()
    if as_json:
        print(json.dumps({"config": resolved.config.to_dict(), "sources": resolved.sources}))
    else:
        commands.print_config(resolved)
    return 0


if __name__ == "__main__":
    sys.exit(main())

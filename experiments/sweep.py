"""A sweep: numeric settings over a grid or random draws, all trained side by side in one program.

python experiments/sweep.py --env Hopper --total-env-steps 30000 --run-dir runs/sweep --seeds 2 \\
    --grid actor_learning_rate=1e-4,3e-4,1e-3 tau=0.005,0.02
python experiments/sweep.py --env Hopper --run-dir runs/drawn --random 16 --draw-seed 0 \\
    --draw actor_learning_rate=log:1e-4:3e-3 discount=uniform:0.95:0.999

Every other flag is one of `sacformer train`. It stops like that (exit code 3), and the same command
goes on. In the run's folder it leaves sweep.csv (a row a member), sweep_settings.csv (a row a
setting, best first), sweep.png, and best-setting: the best setting's members as a run of their own.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import math
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from sweep_results import report, save_best

from sacformer_jax import (
    CheckpointError,
    Config,
    ConfigError,
    Devices,
    DivergedError,
    Member,
    resume,
    train,
)  # fmt: skip
from sacformer_jax.checkpoint import RunConfigFile, RunFolder
from sacformer_jax.cli import EXIT_INTERRUPTED, Parsed, exit_code, parse_config
from sacformer_jax.processes import is_first
from sacformer_jax.types import Hyperparameters
from sacformer_jax.values import unknown

Setting = dict[str, float]

_Needs = dict[str, tuple[Any, ...]]
_ENTROPY: _Needs = {"agent": ("sacformer", "sac")}
_RETURNS: _Needs = {"return_conditioning": ("hindsight", "commanded")}
_NEEDS: dict[str, _Needs] = {
    "alpha": {**_ENTROPY, "policy": ("gaussian",)},
    "alpha_learning_rate": {**_ENTROPY, "tune_alpha": (True,)},
    "target_entropy": {**_ENTROPY, "tune_alpha": (True,)},
    "tau": {"agent": ("sacformer", "sac", "td3", "ddpg")},
    "target_return": _RETURNS,
    "return_scale": _RETURNS,
    "rtg_discount": {"return_conditioning": ("hindsight",)},
}
"""Settings without any effect unless others have such values."""
_MAY_DIFFER = {"run_dir", "total_env_steps"}
"""Of a sweep that is gone on with."""


# --- what is asked for -------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Range:
    """Where a number is drawn from, uniformly, or so that its logarithm is uniform."""

    low: float
    high: float
    log: bool = False

    def draw(self, rng: np.random.Generator, count: int) -> list[float]:
        """So many numbers."""
        low, high = (math.log(end) if self.log else end for end in (self.low, self.high))
        drawn = rng.uniform(low, high, count)
        # exp(log(x)) may lie a hair beyond x.
        return np.clip(np.exp(drawn) if self.log else drawn, self.low, self.high).tolist()


def grid(values: Mapping[str, Sequence[float]]) -> list[Setting]:
    """Every combination; the last field changes fastest."""
    return [
        dict(zip(values, combination, strict=True))
        for combination in itertools.product(*values.values())
    ]


def draws(ranges: Mapping[str, Range], count: int, seed: int) -> list[Setting]:
    """So many random settings; of a field they do not depend on which others are drawn."""
    columns = {
        name: each.draw(np.random.default_rng([seed, *name.encode()]), count)
        for name, each in ranges.items()
    }
    return [{name: column[row] for name, column in columns.items()} for row in range(count)]


def assignments(flag: str, texts: Sequence[str]) -> dict[str, str]:
    """``NAME=WHAT`` by name.

    Raises:
      ConfigError: it is none, or the name is not one of a numeric setting, or there twice.
    """
    known = [field.name for field in dataclasses.fields(Hyperparameters)]
    found: dict[str, str] = {}
    for text in texts:
        name, equals, what = text.partition("=")
        name = name.replace("-", "_")
        if not equals:
            raise ConfigError(f"{flag} {text!r}: must be NAME=…")
        if name not in known:
            raise ConfigError(f"{flag} {text}: {unknown('numeric setting', name, known)}")
        if name in found:
            raise ConfigError(f"{flag} {text}: {name} is given twice")
        found[name] = what
    return found


def number(name: str, text: str) -> float:
    """Raises ConfigError where the text is no finite number."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ConfigError(f"{name}={text!r}: must be a finite number")
    return value


def parse_grid(texts: Sequence[str]) -> dict[str, list[float]]:
    """``NAME=VALUE,VALUE,…`` by name."""
    values: dict[str, list[float]] = {}
    for name, text in assignments("--grid", texts).items():
        values[name] = [number(name, value) for value in text.split(",")]
        if len({float(np.float32(value)) for value in values[name]}) < len(values[name]):
            raise ConfigError(f"{name}={text!r}: two values are the same in float32")
    return values


def parse_ranges(texts: Sequence[str]) -> dict[str, Range]:
    """``NAME=uniform:LOW:HIGH`` or ``NAME=log:LOW:HIGH`` by name."""
    ranges: dict[str, Range] = {}
    for name, text in assignments("--draw", texts).items():
        kind, *ends = text.split(":")
        if kind not in ("uniform", "log") or len(ends) != 2:
            raise ConfigError(f"{name}={text!r}: must be uniform:LOW:HIGH or log:LOW:HIGH")
        low, high = (number(name, end) for end in ends)
        if not low < high or (kind == "log" and low <= 0):
            above = "above 0 and " if kind == "log" else ""
            raise ConfigError(f"{name}={text!r}: LOW must be {above}below HIGH")
        ranges[name] = Range(low, high, log=kind == "log")
    return ranges


def settings_of(args: argparse.Namespace) -> list[Setting]:
    """The settings that the flags ask for.

    Raises:
      ConfigError: they do not go together, or one of them cannot be.
    """
    if bool(args.grid) == (args.random is not None):
        raise ConfigError("give either --grid, or --random with --draw")
    if args.grid:
        if args.draw:
            raise ConfigError("--draw: is for --random, not for --grid")
        return grid(parse_grid(args.grid))
    if not args.draw or args.random < 1 or args.draw_seed < 0:
        raise ConfigError(
            f"--random {args.random} --draw-seed {args.draw_seed}: must be at least 1 and 0, and "
            "--draw says what is drawn"
        )
    return draws(parse_ranges(args.draw), args.random, args.draw_seed)


def members_of(settings: Sequence[Setting], config: Config) -> tuple[Member, ...]:
    """A member for each seed of each setting.

    Raises:
      ConfigError: a value cannot be, or has no effect in this configuration.
    """
    flat = config.flat()
    for name in settings[0]:
        for field, good in _NEEDS.get(name, {}).items():
            if flat[field] not in good:
                other = " or ".join(map(str, good))
                raise ConfigError(f"{name}: has no effect with {field}={flat[field]}; use {other}")
        if flat[name] == "auto":
            raise ConfigError(f"{name}: cannot be swept with {name}='auto'; give it a number")
    width = max(2, len(str(len(settings))))
    members = [
        Member(f"setting-{place:0{width}}-seed-{seed}", seed, dict(values))
        for place, values in enumerate(settings, 1)
        for seed in config.all_seeds
    ]
    for member in members:
        member.config(config).validated()
    return tuple(members)


# --- training ----------------------------------------------------------------------------------


def difference(there: RunConfigFile, config: Config, members: Sequence[Member]) -> str | None:
    """How a run differs from the sweep that is asked for; None where it is the same."""
    then = there.config.flat()
    for name, value in config.flat().items():
        if name not in _MAY_DIFFER and then[name] != value:
            return f"{name}={then[name]!r} there, {value!r} here"
    if len(there.members) != len(members):
        return f"{len(there.members)} members there, {len(members)} here"
    for old, new in zip(there.members, members, strict=True):
        if old != new:
            return f"{old.name} with {old.values} there, {new.name} with {new.values} here"
    return None


def train_or_resume(parsed: Parsed, members: Sequence[Member], devices: Devices) -> bool:
    """Trains what is not trained yet; whether all is.

    Raises:
      CheckpointError: the folder holds another run.
    """
    config, callbacks = parsed.resolved.config, parsed.tracking.callbacks()
    folder, total = RunFolder(config.run.run_dir), config.run.total_env_steps
    latest = folder.latest_step()
    if latest is None:
        sources = parsed.resolved.sources
        result = train(config, sources, members=members, devices=devices, callbacks=callbacks)
        return not result.interrupted
    if reason := difference(folder.opened().read_config(), config, members):
        raise CheckpointError(
            f"run_dir={config.run.run_dir!r} holds another run already ({reason}): choose another "
            "folder, or give the flags it was started with"
        )
    if latest >= total:
        print(f"run {folder.path} has done its {total:,} env steps already")
        return True
    return not resume(folder.path, total, devices=devices, callbacks=callbacks).interrupted


# --- the command -------------------------------------------------------------------------------


def sweep(args: argparse.Namespace, flags: list[str]) -> int:
    """Trains, and reports when all is done; the exit code."""
    settings = settings_of(args)
    parsed = parse_config(flags, "sweep.py")
    config = parsed.resolved.config.validated()
    if not config.run.run_dir:
        raise ConfigError("run_dir='': give a folder, so that the same command can go on there")
    members = members_of(settings, config)
    folder = RunFolder(config.run.run_dir)
    begun_with = folder.latest_devices().get("members")
    devices = parsed.launch.start(config, len(members), begun_with)
    try:
        done = train_or_resume(parsed, members, devices)
    except DivergedError:
        if is_first():
            report(folder, members)  # tells which settings broke down
        raise
    if not done:
        print("or by the same command, which then compares the settings")
        return EXIT_INTERRUPTED
    if not is_first():
        return 0
    best = report(folder, members)[0]["setting"]
    if jax.process_count() > 1:
        print("for best-setting give the same command once more in one process")
        return 0
    path = save_best(folder, [m.name for m in members if m.name.startswith(f"{best}-seed-")])
    print(f"the best, {best}: {path}")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; exit codes are those of ``sacformer train``."""
    parser = argparse.ArgumentParser(
        description="Trains numeric settings side by side, and finds the best.",
        epilog="Every other flag is one of `sacformer train`; --seeds are those of every setting.",
        allow_abbrev=False,
    )
    parser.add_argument("--grid", nargs="+", action="extend", metavar="NAME=VALUE,…",
                        help="every combination of these values")  # fmt: skip
    parser.add_argument("--random", type=int, metavar="N", help="so many random settings")
    parser.add_argument("--draw", nargs="+", action="extend", metavar="NAME=log:LOW:HIGH",
                        help="what --random draws; uniform:LOW:HIGH, too")  # fmt: skip
    parser.add_argument("--draw-seed", type=int, default=0, metavar="N", help="of the draws")
    args, flags = parser.parse_known_args(arguments)
    return exit_code(lambda: sweep(args, flags))


if __name__ == "__main__":
    sys.exit(main())

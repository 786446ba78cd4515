"""What the networks of trained runs are like, to find what holds an agent back.

Of the newest checkpoint of each run, replay included, of agent sacformer or sac, and of each seed:

- gradients of the actor's and the critics' loss over 32 batches at the restored state: norm of
  their mean, and signal-to-noise ratio |mean g|² / mean |g - mean g|², whole and by part of the
  network (noise scale: McCandlish et al., arXiv 1812.06162);
- entropy of the policy in batches and in acting beside the target, and α;
- bias of the smaller Q: against the discounted return, with the entropy bonus of later steps, of
  episodes under the policy's random actions; mean and standard deviation over the mean absolute
  return (REDQ, arXiv 2101.05982), and the correlation. Of episodes that a time limit cut off, steps
  whose unknown remainder counts for 5 % or more (γ^remaining) are left out;
- effective rank of the features that go into the actor's and the critics' heads (srank, δ = 0.01,
  arXiv 2010.14498), and the share of dormant units behind each activation (τ = 0.025, arXiv
  2302.12902), on windows from the replay;
- attention of the state acted on by steps back and kind of token, on full windows from the replay,
  with the return tokens that acting would show;
- percentiles of the return tokens in batches and in evaluation (mean action), and the share of
  those in evaluation outside the 1st to 99th percentile of training;
- evaluation return from the same resets as it is, with the newest pair alone, with the time step
  held at 0, with the target return halved and doubled; and the mean absolute change of the mean
  action on replayed states, in half ranges of the action bounds;
- how far features and mean actions of a window's steps, of the first and the last one learnt from
  and of the first of all, lie from those in acting, which sees another length of the past.

python experiments/diagnose.py runs/sacformer runs/sac --json diagnosis.json --picture diagnosis.png
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from diagnosis.measuring import Amounts, diagnose
from diagnosis.picture import draw
from diagnosis.table import Runs, rows, table
from rich.console import Console

from sacformer_jax import CheckpointError, ConfigError
from sacformer_jax.cli import EXIT_BAD_INPUT
from sacformer_jax.run_folder import labels


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description="What the networks of trained runs are like.")
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="folder of a run")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers there")
    parser.add_argument("--picture", type=Path, metavar="FILE.png", help="draw them there")
    defaults = Amounts()
    parser.add_argument("--batches", type=int, default=defaults.batches, help="of gradients")
    parser.add_argument("--episodes", type=int, default=defaults.episodes, help="side by side")
    parser.add_argument("--windows", type=int, default=defaults.windows, help="replayed, full")
    parser.add_argument("--seed", type=int, default=defaults.seed, help="of all that is drawn")
    args = parser.parse_args(arguments)
    for name, least in (("batches", 2), ("episodes", 1), ("windows", 1), ("seed", 0)):
        if getattr(args, name) < least:
            parser.error(f"{name}={getattr(args, name)}: must be at least {least}")
    if args.picture is not None and args.picture.suffix != ".png":
        parser.error(f"picture={str(args.picture)!r}: must end in .png")
    for file in (args.json, args.picture):
        if file is not None and not file.parent.is_dir():
            parser.error(f"{file}: there is no folder {file.parent}")
    amounts = Amounts(args.batches, args.episodes, args.windows, args.seed)
    console = Console()
    runs: Runs = {}
    failure: Exception | None = None
    try:
        for label, run in zip(labels(args.runs), args.runs, strict=True):
            runs[label] = diagnose(run, amounts, lambda line: print(line, file=sys.stderr))
    except (CheckpointError, ConfigError, FloatingPointError) as error:
        if not runs:
            parser.error(str(error))
        failure = error  # the others took minutes
    console.print(table(runs))
    if args.json is not None:
        args.json.write_text(json.dumps(rows(runs), indent=1) + "\n")
    if args.picture is not None:
        draw(runs, amounts.batches, args.picture)
    if failure is not None:
        print(f"{parser.prog}: error: {failure}", file=sys.stderr)
        return EXIT_BAD_INPUT
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Search hyperparameters with Optuna, ending hopeless trials early.

    pip install 'sacformer-jax[optuna]'
    python examples/optuna_pruning.py --trials 8 --env Hopper --total-env-steps 30000

Each trial is a run of its own under --runs, and stays there: a pruned one was saved, and
`sacformer resume` would carry it on. Run the command again, and the study (in --storage) goes on.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import optuna

from sacformer_jax import Callback, Config, Event, train


class Pruning(Callback):
    """Reports each evaluation to the trial and stops the run when Optuna prunes it."""

    def __init__(self, trial: optuna.Trial):
        self.trial, self.pruned = trial, False

    def on_eval(self, event: Event) -> bool:
        self.trial.report(event.mean("return_mean"), event.env_steps)
        self.pruned = self.trial.should_prune()
        return not self.pruned


def objective(trial: optuna.Trial, args: argparse.Namespace) -> float:
    """Trains with the trial's values; the mean of the last three evaluations."""
    config = Config.from_preset(
        "cpu",
        env=args.env,
        agent=args.agent,
        total_env_steps=args.total_env_steps,
        run_dir=str(Path(args.runs) / f"trial-{trial.number}"),
        actor_learning_rate=trial.suggest_float("actor_learning_rate", 1e-4, 3e-3, log=True),
        critic_learning_rate=trial.suggest_float("critic_learning_rate", 1e-4, 3e-3, log=True),
        tau=trial.suggest_float("tau", 1e-3, 2e-2, log=True),
    )
    pruning = Pruning(trial)
    result = train(config, quiet=True, callbacks=[pruning])
    if pruning.pruned:
        raise optuna.TrialPruned
    last = [record["return_mean"] for record in result.evaluations[-3:]]
    return sum(last) / len(last)


def main(arguments: list[str] | None = None) -> optuna.Study:
    """The command; returns the study."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=8)
    parser.add_argument("--env", default="Hopper")
    parser.add_argument("--agent", default="sacformer")
    parser.add_argument("--total-env-steps", type=int, default=30_000)
    parser.add_argument("--runs", default="runs/optuna")
    parser.add_argument("--storage", default="sqlite:///optuna.db")
    args = parser.parse_args(arguments)
    study = optuna.create_study(
        study_name=f"{args.agent}-{args.env}",
        storage=args.storage,
        load_if_exists=True,
        direction="maximize",
        sampler=optuna.samplers.TPESampler(seed=0),
        # Worse than the median of the earlier trials at the same step, after the first evaluations.
        pruner=optuna.pruners.MedianPruner(n_startup_trials=3, n_warmup_steps=10_000),
    )
    study.optimize(lambda trial: objective(trial, args), n_trials=args.trials)
    print(f"best {study.best_value:.1f} with {study.best_params}")
    return study


if __name__ == "__main__":
    main()

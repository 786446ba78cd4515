"""Scores of runs, and statistics over them as rliable defines them (Agarwal et al. 2021, arXiv
2108.13264): interquartile mean, stratified bootstrap intervals, probability of improvement.

Everywhere below, ``by_task`` is a sequence with an array for each task, whose last axis is the runs
(seeds); axes before it, the same in all arrays, are kept (evaluations along a curve, say).
"""

from __future__ import annotations

import dataclasses
import math
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats

from report.published import PUBLISHED, ZOO

Array = np.ndarray

LAST_EVALUATIONS = 5
"""A run's score is the mean of so many: one evaluation of a few episodes is noisy."""
REFERENCE_SOURCE = (
    "Stable-Baselines3 zoo's SAC on the v3 tasks, one run of 1 M steps, on Humanoid 2 M"
)
REFERENCE_RETURNS = PUBLISHED[ZOO]["sac"]
"""Returns of normalized score 1, those of ``REFERENCE_SOURCE``. Our tasks are the v5 ones."""
RANDOM_RETURNS = {
    "HalfCheetah": -284.5,  # ± 2.5 (standard error)
    "Hopper": 17.7,  # ± 0.5
    "Walker2d": 1.7,  # ± 0.2
    "Ant": -52.5,  # ± 2.9
    "Humanoid": 112.6,  # ± 1.0
}
"""Returns of normalized score 0: uniformly random actions, 1,024 episodes of each task on the
native engine, measured by random_returns.py."""

_TRIMMED = 0.25
_RESAMPLES = 10_000
_BATCH = 500
"""Resamples held in memory at a time; changing it changes the intervals a little."""


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A statistic with its 95 % interval.

    Attributes:
      value: of the runs as they are.
      low: lower end, NaN where there is no interval.
      high: upper end, likewise.
    """

    value: Any
    low: Any
    high: Any


def variant_of(row: Mapping[str, Any]) -> str:
    """What a run stands for: its name without task and seeds.

    Seeds that were added to a variant are a run of its own, whose name ends in ``-from-SEED``, the
    first of them. Older tables have a run for each seed, with the seed at the end of its name. So
    a variant's own name must end in neither.
    """
    name = str(row["run"]).removeprefix(f"{row['env']}-")
    variant, added = re.subn(r"-from-\d+$", "", name)
    return variant if added else name.removesuffix(f"-{row['seed']}")


def run_scores(returns: Array) -> Array:
    """Score of each run ``[...]`` from its evaluations ``[..., T]``: the mean of the last five.

    The mean of all where there are fewer, NaN where there is none.
    """
    if returns.shape[-1] == 0:
        return np.full(returns.shape[:-1], np.nan)
    return np.asarray(returns[..., -LAST_EVALUATIONS:].mean(axis=-1))


def can_normalize(task: str) -> bool:
    """Whether both ends of the task's scale are known."""
    return task in REFERENCE_RETURNS and task in RANDOM_RETURNS


def normalized(task: str, returns: Array) -> Array:
    """Returns on the scale from 0 (random actions) to 1 (the reference), not clipped."""
    low = RANDOM_RETURNS[task]
    return (np.asarray(returns) - low) / (REFERENCE_RETURNS[task] - low)


def interquartile_mean(by_task: Sequence[Array]) -> Any:
    """Mean of the middle half of all runs of all tasks together, over the last axis.

    Of n runs, floor(n / 4) are cut off at each end and none in part, as in rliable: with 6 runs the
    mean is of the middle 4, with 3 of all. Every task counts the same: see :func:`_pooled`.
    """
    return stats.trim_mean(_pooled(by_task), _TRIMMED, axis=-1)


def _pooled(by_task: Sequence[Array]) -> Array:
    """All runs of all tasks together, those of tasks with fewer runs as often as makes them equal.

    Otherwise seeds added on one task would move the mean towards that task.
    """
    numbers = [np.shape(runs)[-1] for runs in by_task]
    most = math.lcm(*numbers)
    pairs = zip(by_task, numbers, strict=True)
    return np.concatenate([np.repeat(runs, most // n, axis=-1) for runs, n in pairs], axis=-1)


def iqm_estimate(by_task: Sequence[Array], resamples: int = _RESAMPLES) -> Estimate:
    """The interquartile mean with its stratified bootstrap interval."""
    return _estimate(interquartile_mean, by_task, resamples)


def mean_estimate(by_task: Sequence[Array], resamples: int = _RESAMPLES) -> Estimate:
    """The mean over all runs, every task counting the same, with its stratified bootstrap
    interval.
    """
    return _estimate(lambda all_: _pooled(all_).mean(axis=-1), by_task, resamples)


def iqm_difference(
    of: Sequence[Array], less: Sequence[Array], resamples: int = _RESAMPLES
) -> Estimate:
    """The interquartile mean of one less that of the other. Both are resampled independently.

    Args:
      of: by task.
      less: by task, the same tasks.
      resamples: of the bootstrap.

    Raises:
      ValueError: there are other numbers of tasks.
    """
    tasks = _common(of, less)

    def statistic(samples: Sequence[Array]) -> Any:
        return interquartile_mean(samples[:tasks]) - interquartile_mean(samples[tasks:])

    return _estimate(statistic, [*of, *less], resamples)


def _common(one: Sequence[Array], other: Sequence[Array]) -> int:
    """How many tasks both have."""
    if len(one) != len(other):
        raise ValueError(f"{len(one)} tasks against {len(other)}")
    return len(one)


def probability_of_improvement(
    of: Sequence[Array], over: Sequence[Array], resamples: int = _RESAMPLES
) -> Estimate:
    """How likely a run of one is better than a run of the other: P(X > Y) + P(X = Y) / 2.

    The mean over tasks of that share of all pairs. Both are resampled independently.

    Args:
      of: X by task.
      over: Y by task, the same tasks.
      resamples: of the bootstrap.

    Raises:
      ValueError: there are other numbers of tasks.
    """
    tasks = _common(of, over)

    def statistic(samples: Sequence[Array]) -> Any:
        pairs = zip(samples[:tasks], samples[tasks:], strict=True)
        return np.mean([_share_of_pairs(x, y) for x, y in pairs], axis=0)

    return _estimate(statistic, [*of, *over], resamples)


def _share_of_pairs(x: Array, y: Array) -> Array:
    # U counts the pairs with x > y, ties half. The p-value is not used: the cheap method.
    u = stats.mannwhitneyu(x, y, axis=-1, method="asymptotic").statistic
    return np.asarray(u / (x.shape[-1] * y.shape[-1]))


def _estimate(
    statistic: Callable[[Sequence[Array]], Any], samples: Sequence[Array], resamples: int
) -> Estimate:
    """The statistic with its percentile interval; runs are resampled within each array.

    The random numbers are the same in every call. One run tells nothing of how runs differ: where
    any array has only one there is no interval (NaN).
    """
    samples = [np.asarray(sample, float) for sample in samples]
    value = statistic(samples)
    if any(sample.shape[-1] < 2 for sample in samples):
        nothing = np.full(np.shape(value), np.nan)[()]
        return Estimate(value, nothing, nothing)
    with warnings.catch_warnings():
        # Where a return is NaN, so is the interval.
        warnings.simplefilter("ignore", stats.DegenerateDataWarning)
        interval = stats.bootstrap(
            samples, lambda *resampled, axis: statistic(resampled), axis=-1, paired=False,
            vectorized=True, method="percentile", n_resamples=resamples, batch=_BATCH,
            confidence_level=0.95, rng=np.random.default_rng(0),
        ).confidence_interval  # fmt: skip
    return Estimate(value, interval.low, interval.high)

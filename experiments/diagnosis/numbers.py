"""The numbers of a diagnosis, as functions of NumPy arrays; NaN where there is nothing."""

from __future__ import annotations

import dataclasses
import math

import numpy as np


@dataclasses.dataclass(frozen=True)
class Signal:
    """How far gradients of M batches agree.

    Attributes:
      norm: of their mean ḡ.
      snr: ``|ḡ|² / mean |g - ḡ|²``. Gradients of pure noise give 1/(M-1), not 0. Its inverse times
        the batch size is the noise scale of McCandlish et al., arXiv 1812.06162.
    """

    norm: float
    snr: float


def signal(gradients: np.ndarray) -> Signal:
    """Of gradients ``[M, P]``, one of each batch."""
    each = gradients.astype(np.float64)
    mean = each.mean(axis=0)
    squared, noise = float(np.sum(mean**2)), float(np.sum((each - mean) ** 2)) / len(each)
    if noise == 0.0:
        return Signal(math.sqrt(squared), math.inf if squared else math.nan)
    return Signal(math.sqrt(squared), squared / noise)


def effective_rank(features: np.ndarray, delta: float = 0.01) -> int:
    """srank: the fewest singular values of ``features [N, D]`` that make up ``1 - delta`` of their
    sum (Kumar et al., arXiv 2010.14498).
    """
    values = np.linalg.svd(features.astype(np.float64), compute_uv=False)
    total = values.sum()
    if total == 0.0:
        return 0
    return int(np.argmax(np.cumsum(values) / total >= 1.0 - delta)) + 1


def dormant_share(activations: np.ndarray, tau: float = 0.025) -> float:
    """Share of the units of ``activations [N, H]`` that are τ-dormant (Sokar et al., arXiv
    2302.12902): their mean absolute activation is at most τ times the layer's.
    """
    each = np.abs(activations.astype(np.float64)).mean(axis=0)
    return float(np.mean(each <= tau * each.mean()))


def soft_returns(
    reward: np.ndarray, log_prob: np.ndarray, discount: float, alpha: float
) -> np.ndarray:
    """What SAC's Q stands for, of each step of an episode:
    ``G_t = r_t + γ (G_{t+1} - α log π(a_{t+1}|s_{t+1}))``, nothing after the last one.

    Args:
      reward: ``[T]``.
      log_prob: ``[T]``, of the actions taken.
      discount: γ.
      alpha: entropy temperature.

    Returns:
      ``[T]``.
    """
    returns, later = np.zeros(len(reward)), 0.0
    for t in reversed(range(len(reward))):
        returns[t] = reward[t] + discount * later
        later = returns[t] - alpha * log_prob[t]
    return returns


def num_known(length: int, terminated: bool, discount: float, remainder: float = 0.05) -> int:
    """First steps of an episode whose return is known.

    All of one that terminated. Of one that was cut off, those before which what it would have had
    after its ``length`` steps counts for less than ``remainder``: ``discount^(length - t)``.
    """
    if terminated:
        return length
    return int(np.sum(discount ** (length - np.arange(length)) < remainder))


def value_bias(values: np.ndarray, returns: np.ndarray) -> dict[str, float]:
    """How values ``[N]`` differ from the returns ``[N]`` that they estimate.

    ``mean`` and ``std`` of the difference over the mean absolute return (that is REDQ's |mean
    return| wherever returns have one sign; Chen et al., arXiv 2101.05982), and the ``correlation``.
    """
    if not len(values):
        return {"mean": math.nan, "std": math.nan, "correlation": math.nan}
    scale = float(np.abs(returns).mean())
    bias = (values - returns) / scale if scale else np.full(len(values), math.nan)
    varies = min(np.std(values), np.std(returns)) > 0
    return {
        "mean": float(bias.mean()),
        "std": float(bias.std()),
        "correlation": float(np.corrcoef(values, returns)[0, 1]) if varies else math.nan,
    }


PERCENTILES = (1, 50, 99)


def percentiles(values: np.ndarray) -> dict[str, float]:
    """Of ``values [N]``: ``p1``, ``p50``, ``p99``."""
    found = np.percentile(values, PERCENTILES)
    return {f"p{p}": float(value) for p, value in zip(PERCENTILES, found, strict=True)}


def share_outside(values: np.ndarray, reference: np.ndarray) -> float:
    """Share of ``values [N]`` outside the 1st to 99th percentile of ``reference [M]``."""
    low, high = np.percentile(reference, (PERCENTILES[0], PERCENTILES[-1]))
    return float(np.mean((values < low) | (values > high)))

"""Statistics over runs, against values by hand and against enumeration."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from random_returns import random_returns
from report import scores
from report.published import CLEANRL, PUBLISHED, ratio_to_cleanrl
from report.scores import (
    iqm_difference,
    iqm_estimate,
    mean_estimate,
    probability_of_improvement,
)

pytestmark = pytest.mark.filterwarnings("error")


def brute_iqm(values: np.ndarray) -> float:
    ordered = sorted(values)
    cut = len(ordered) // 4
    kept = ordered[cut : len(ordered) - cut]
    return sum(kept) / len(kept)


def brute_improvement(x: np.ndarray, y: np.ndarray) -> float:
    return float(np.mean([(a > b) + 0.5 * (a == b) for a in x for b in y]))


def test_a_runs_score_is_the_mean_of_its_last_five_evaluations() -> None:
    returns = np.array([[100.0, 1, 2, 3, 4, 5], [0, 10, 10, 10, 10, 20]])
    assert scores.run_scores(returns).tolist() == [3.0, 12.0]
    assert scores.run_scores(returns[:, :2]).tolist() == [50.5, 5.0]
    assert np.isnan(scores.run_scores(returns[:, :0])).tolist() == [True, True]


def test_normalized_scores_run_from_random_actions_to_the_reference() -> None:
    for task, reference in scores.REFERENCE_RETURNS.items():
        low = scores.RANDOM_RETURNS[task]
        ends = np.array([low, reference, 2 * reference - low])
        np.testing.assert_allclose(scores.normalized(task, ends), [0, 1, 2], atol=1e-12)
        assert scores.can_normalize(task)
    assert scores.REFERENCE_RETURNS["Hopper"] == 2326
    assert not scores.can_normalize("brax:ant")


def test_interquartile_mean_by_hand() -> None:
    # Four runs: the two in the middle. Six: a run and a half at each end would be a quarter, one
    # is cut. Three: nothing is cut.
    assert scores.interquartile_mean([np.array([1.0, 100]), np.array([3.0, 4])]) == 3.5
    assert scores.interquartile_mean([np.array([1.0, 2, 3]), np.array([10.0, 20, 100])]) == 8.75
    assert scores.interquartile_mean([np.array([1.0, 2, 9])]) == 4.0


@pytest.mark.parametrize("num", range(1, 14))
def test_interquartile_mean_of_any_number_of_runs(num: int) -> None:
    values = np.random.default_rng(num).normal(size=(5, 2 * num))
    found = scores.interquartile_mean([values[:, :num], values[:, num:]])
    np.testing.assert_allclose(found, [brute_iqm(row) for row in values])
    found = scores.interquartile_mean([values[:, :num]])
    np.testing.assert_allclose(found, [brute_iqm(row) for row in values[:, :num]])


def test_the_interval_of_two_runs_on_two_tasks() -> None:
    # 16 equally likely resamples of (0 or 4, 0 or 4, 10 or 20, 10 or 20): the lowest is (0, 0, 10,
    # 10), trimmed to 5, the highest (4, 4, 20, 20), trimmed to 12; each has 1/16 > 2.5 %.
    estimate = iqm_estimate([np.array([0.0, 4]), np.array([10.0, 20])])
    assert (estimate.value, estimate.low, estimate.high) == (7.0, 5.0, 12.0)


def test_the_interval_is_the_quantiles_of_all_resamples() -> None:
    tasks = [np.array([0.0, 0, 1, 2]), np.array([1.0, 3])]  # of two seeds each counts twice
    draws = itertools.product(
        itertools.product(tasks[0], repeat=4), itertools.product(tasks[1], repeat=2)
    )
    everything = np.sort([brute_iqm(np.array([*a, *b, *b])) for a, b in draws])
    # Where quantiles lie within atoms, so that no random number matters.
    for end in (0.025, 0.975):
        assert len(set(np.quantile(everything, [end - 0.008, end + 0.008]))) == 1
    estimate = iqm_estimate(tasks)
    assert estimate.value == brute_iqm(np.array([0.0, 0, 1, 2, 1, 3, 1, 3])) == 1.25
    assert estimate.low == np.quantile(everything, 0.025) == 0.5
    assert estimate.high == np.quantile(everything, 0.975) == 2.5


def test_runs_are_resampled_within_their_task_only() -> None:
    seen: list[tuple[np.ndarray, ...]] = []

    def keep(samples: list[np.ndarray]) -> np.ndarray:
        seen.append(tuple(samples))
        return np.concatenate(samples, axis=-1).mean(axis=-1)

    scores._estimate(keep, [np.array([0, 1, 2]), np.array([100, 101])], 1000)
    firsts = np.concatenate([first for first, _ in seen if first.ndim == 2])
    seconds = np.concatenate([second for _, second in seen if second.ndim == 2])
    assert firsts.shape == (1000, 3)
    assert seconds.shape == (1000, 2)
    assert {*firsts.ravel()} == {0, 1, 2}
    assert {*seconds.ravel()} == {100, 101}
    # All 27 x 4 pairs of resamples occur: the tasks are drawn independently, with replacement.
    assert len({(*a, *b) for a, b in zip(firsts, seconds, strict=True)}) == 108


def test_along_a_curve_whole_runs_are_resampled() -> None:
    curve = np.array([[0.0, 1, 5], [0, 1, 5], [10, 11, 15]])
    estimate = mean_estimate([curve])
    np.testing.assert_allclose(estimate.value, [2, 2, 12])
    for end in (estimate.low, estimate.high):
        assert end.shape == (3,)
        assert end[0] == end[1]
        assert end[2] == pytest.approx(end[0] + 10)


def test_intervals_are_the_same_every_time() -> None:
    tasks = list(np.random.default_rng(0).normal(size=(4, 3)))
    assert iqm_estimate(tasks) == iqm_estimate(tasks)


def test_probability_of_improvement_by_hand_with_ties() -> None:
    # Task 1: of the pairs only (2, 2) counts, half: 0.5 / 4. Task 2: 0 + 0.5 + 1 of 3.
    x = [np.array([1.0, 2]), np.array([5.0, 6, 7])]
    y = [np.array([2.0, 3]), np.array([6.0])]
    assert probability_of_improvement(x, y).value == pytest.approx((0.125 + 0.5) / 2)
    assert probability_of_improvement(y, x).value == pytest.approx(1 - (0.125 + 0.5) / 2)
    same = [np.ones(3)]
    estimate = probability_of_improvement(same, same)
    assert (estimate.value, estimate.low, estimate.high) == (0.5, 0.5, 0.5)


def test_probability_of_improvement_is_the_share_of_pairs() -> None:
    rng = np.random.default_rng(1)
    x = [rng.integers(0, 6, size).astype(float) for size in (3, 5, 2)]
    y = [rng.integers(0, 6, size).astype(float) for size in (4, 2, 2)]
    expected = np.mean([brute_improvement(a, b) for a, b in zip(x, y, strict=True)])
    estimate = probability_of_improvement(x, y)
    assert estimate.value == pytest.approx(expected)
    assert estimate.low < estimate.value < estimate.high


def test_both_sides_of_an_improvement_are_resampled() -> None:
    # x is (1, 1), (1, 3) twice or (3, 3) and y (0, 0), (0, 2) twice or (2, 2): 16 cases, the worst
    # of them (1, 1) against (2, 2), the best any against (0, 0).
    estimate = probability_of_improvement([np.array([1.0, 3])], [np.array([0.0, 2])])
    assert (estimate.value, estimate.low, estimate.high) == (0.75, 0.0, 1.0)


def test_the_difference_of_two_interquartile_means() -> None:
    # x is 1 + {0, 2} of two draws, so 1, 2 (twice as likely) or 3, and y likewise 0, 1 or 2: of the
    # 16 cases the least difference is 1 - 2, the greatest 3 - 0, each in one.
    x, y = [np.array([1.0, 3])], [np.array([0.0, 2])]
    estimate = iqm_difference(x, y)
    assert (estimate.value, estimate.low, estimate.high) == (1.0, -1.0, 3.0)
    back = iqm_difference(y, x)
    assert (back.value, back.low, back.high) == (-1.0, -3.0, 1.0)
    # The middle half is taken of all tasks together: 2, 3 of 1, 2, 3, 50 less 0.
    many = iqm_difference([np.array([1.0, 50]), np.array([2.0, 3])], [np.zeros(2), np.zeros(2)])
    assert many.value == 2.5


def test_different_tasks_are_not_compared() -> None:
    for compare in (probability_of_improvement, iqm_difference):
        with pytest.raises(ValueError, match="1 tasks against 2"):
            compare([np.ones(2)], [np.ones(2), np.ones(2)])


def test_single_seeds_have_no_interval() -> None:
    for tasks in ([np.array([2.0])], [np.array([1.0, 3]), np.array([2.0])]):
        estimate = iqm_estimate(tasks)
        assert estimate.value == 2.0
        assert np.isnan([estimate.low, estimate.high]).all()
    curve = iqm_estimate([np.array([[1.0], [2.0]])])
    assert curve.value.tolist() == [1, 2]
    assert np.isnan(curve.low).tolist() == np.isnan(curve.high).tolist() == [True, True]


def test_a_task_with_more_runs_counts_no_more() -> None:
    four, two = np.array([0.0, 1.0, 2.0, 3.0]), np.array([10.0, 20.0])
    # Two runs count twice: of 0, 1, 2, 3, 10, 10, 20, 20 the middle four.
    assert scores.interquartile_mean([four, two]) == pytest.approx((2 + 3 + 10 + 10) / 4)
    assert mean_estimate([four, two]).value == pytest.approx((1.5 + 15) / 2)
    # The same seeds once more change nothing.
    more = np.concatenate([four, four])
    assert scores.interquartile_mean([more, two]) == pytest.approx(25 / 4)
    assert scores.interquartile_mean([four, four]) == 1.5


def test_equal_runs_and_runs_that_diverged() -> None:
    equal = iqm_estimate([np.ones(3), np.ones(2)])
    assert (equal.value, equal.low, equal.high) == (1, 1, 1)
    lost = iqm_estimate([np.array([1.0, np.nan, 2]), np.ones(3)])
    assert np.isnan([lost.value, lost.low, lost.high]).all()


def test_a_runs_name_without_task_and_seed_is_its_variant() -> None:
    row = {"env": "Hopper", "seed": "1"}
    names = {"Hopper-sac-1": "sac", "Hopper-td3": "td3", "Hopper-K=1": "K=1",
             "64-windows-1": "64-windows", "Ant-sac-1": "Ant-sac",
             "Hopper-sac-from-0": "sac", "Hopper-td3-from-1": "td3"}  # fmt: skip
    assert {name: scores.variant_of({**row, "run": name}) for name in names} == names


def test_published_returns() -> None:
    assert PUBLISHED[CLEANRL]["ddpg"]["Walker2d"] == 1240
    assert ratio_to_cleanrl("Hopper", "td3", 3135 * 0.75) == 0.75
    assert ratio_to_cleanrl("Ant", "td3", 1.0) is None
    assert ratio_to_cleanrl("Hopper", "sacformer", 1.0) is None


@pytest.mark.filterwarnings("default")
def test_random_actions_give_what_is_written_down() -> None:
    returns = random_returns("Hopper", episodes=32, seed=5)
    error = returns.std(ddof=1) / np.sqrt(returns.size)
    assert returns.shape == (32,)
    assert error > 0
    assert abs(returns.mean() - scores.RANDOM_RETURNS["Hopper"]) < 4 * error

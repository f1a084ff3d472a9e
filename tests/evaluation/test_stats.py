"""Statistics against numbers worked out by hand, in closed form, and by the reference library."""

from __future__ import annotations

import math

import numpy as np
import pytest

from marl_explore.evaluation import stats

# Scores of 5 and of 3 seeds on 4 arenas. The numbers they are held against are those of rliable
# 1.2.0 (with numpy 2.4.6, pandas 2.3.3): aggregate_iqm, probability_of_improvement, and the 95 %
# intervals of get_interval_estimates after np.random.seed(0) with 50000 reps (5000 for the last).
X = np.array(
    [[12, 30, 25, 41], [15, 28, 25, 60], [11, 35, 22, 44], [18, 30, 27, 39], [13, 31, 40, 52]]
)
Y = np.array([[14, 30, 29, 40], [16, 33, 25, 58], [15, 36, 31, 49]])


def test_the_interquartile_mean_leaves_out_a_quarter_at_either_end():
    assert stats.interquartile_mean([0, 1, 2, 100]) == 1.5
    assert stats.interquartile_mean([-50, 1, 2, 3, 100]) == 2.0  # 5 / 4 = 1 at either end
    assert stats.interquartile_mean([7]) == 7
    assert stats.interquartile_mean(X) == pytest.approx(29.2)
    assert stats.interquartile_mean(Y) == pytest.approx(30 + 2 / 3)


@pytest.mark.parametrize(
    ("statistic", "low", "high"), [(stats.interquartile_mean, 26.9, 32.5), (np.mean, 27.75, 32.3)]
)
def test_the_stratified_interval_is_the_reference_librarys(statistic, low, high):
    estimate = stats.interval(X, statistic, "stratified", resamples=20_000)
    assert estimate.value == statistic(X)
    assert (estimate.low, estimate.high) == pytest.approx((low, high), abs=0.15)


def test_the_probability_of_improvement_is_the_reference_librarys():
    estimate = stats.probability_of_improvement(X, Y, "stratified", resamples=5000)
    assert estimate.value == pytest.approx(0.3416666666666667)
    assert (estimate.low, estimate.high) == pytest.approx((0.158333, 0.533333), abs=0.03)
    assert stats.probability_of_improvement(Y, X).value == pytest.approx(0.6583333333333332)


def test_ties_improve_by_one_half():
    assert stats.probability_of_improvement([1, 2, 3, 4], [0, 2, 3, 9]).value == 0.5
    assert stats.probability_of_improvement([1, 2], [0, 2]).value == 0.75
    assert stats.probability_of_improvement(
        [[1, 2]], [[0, 2], [3, 2], [1, 1]]
    ).value == pytest.approx(3.5 / 6)


def test_the_interval_of_a_mean_over_arenas_has_the_width_of_the_normal_one():
    scores = np.random.default_rng(1).normal(40, 10, size=400)
    estimate = stats.interval(scores, np.mean)
    half = 1.96 * scores.std() / math.sqrt(400)
    assert estimate.value == scores.mean()
    assert estimate.low == pytest.approx(scores.mean() - half, abs=0.1)
    assert estimate.high == pytest.approx(scores.mean() + half, abs=0.1)


def test_a_seeds_luck_is_shared_by_all_its_arenas():
    """With scores that differ by seed alone more arenas make the mean no surer."""
    luck = np.array([30.0, 34, 38, 42, 46, 50])
    scores = np.repeat(luck[:, None], 100, axis=1)
    half = 1.96 * luck.std() / math.sqrt(6)
    crossed = stats.interval(scores, np.mean)
    assert (crossed.high - crossed.low) / 2 == pytest.approx(half, rel=0.1)
    stratified = stats.interval(scores, np.mean, "stratified")
    assert (stratified.high - stratified.low) / 2 == pytest.approx(half / 10, rel=0.1)


def test_what_makes_arenas_hard_for_both_cancels_in_a_paired_difference():
    hard = np.random.default_rng(2).normal(0, 100, size=50)
    estimate = stats.paired_difference(hard + 3, hard)
    assert estimate == pytest.approx((3, 3, 3))
    noise = np.random.default_rng(3).normal(0, 1, size=50)
    estimate = stats.paired_difference(hard + 3 + noise, hard)
    half = 1.96 * noise.std() / math.sqrt(50)
    assert estimate.low == pytest.approx(3 + noise.mean() - half, abs=0.05)
    assert estimate.high == pytest.approx(3 + noise.mean() + half, abs=0.05)


def test_policies_with_different_numbers_of_seeds_are_paired_by_arena():
    estimate = stats.paired_difference(X, Y[0])
    assert estimate.value == pytest.approx(X.mean() - Y[0].mean())
    assert estimate.low < estimate.value < estimate.high


def test_joint_draws_give_intervals_of_means_and_of_paired_differences():
    rng = np.random.default_rng(1)
    hardness = rng.normal(0, 3, 60)
    x, y = (shift + hardness + rng.normal(0, 1, (4, 60)) for shift in (1.0, 0.0))
    draws = stats.joint_draws({"x": x, "y": y}, {"x": np.mean, "y": np.mean}, resamples=4000)
    alone, apart = stats.interval(x, np.mean), stats.paired_difference(x, y)
    assert stats.bounds(draws["x"]) == pytest.approx((alone.low, alone.high), abs=0.1)
    difference = stats.bounds(draws["x"] - draws["y"])
    assert difference == pytest.approx((apart.low, apart.high), abs=0.05)
    assert (draws["x"] > draws["y"]).mean() > 0.99


def test_joint_draws_keep_what_belongs_together():
    """Events and all of their kind, [S, A, 2], are drawn as pairs; draws without any are NaN."""
    events = np.array([[[1, 2], [3, 6], [0, 0]]])

    def share(drawn):
        part, whole = drawn.sum((0, 1))
        return part / whole if whole else np.nan

    draws = stats.joint_draws({"x": events}, {"x": share}, resamples=500)["x"]
    assert set(draws[~np.isnan(draws)]) == {0.5}
    assert np.isnan(draws).any()  # three times the third arena
    assert stats.bounds(draws) == (0.5, 0.5)
    assert np.isnan(stats.bounds([np.nan])).all()


def test_samples_of_different_arenas_are_not_drawn_together():
    with pytest.raises(ValueError, match=r"samples of \[3, 4\] arenas cannot be drawn together"):
        stats.joint_draws({"x": X, "y": Y[:, :3]}, {"x": np.mean, "y": np.mean})


def test_intervals_repeat_and_depend_on_the_seed():
    assert stats.interval(X) == stats.interval(X)
    assert stats.interval(X) != stats.interval(X, seed=1)


def test_the_interval_over_two_seeds_is_between_them():
    # a quarter of the draws is twice the same seed, at either end
    assert stats.seed_mean([3, 1]) == (2, 1, 3)
    # and a sixteenth of those of both is so for both
    assert stats.seed_difference([3, 1], [10, 11]) == (-8.5, -10, -7)


def test_the_interval_of_a_difference_is_that_of_independent_means():
    generator = np.random.default_rng(2)
    a, b = generator.normal(5, 3, 60), generator.normal(1, 8, 90)
    estimate = stats.seed_difference(a, b)
    half = 1.96 * math.sqrt(a.var() / 60 + b.var() / 90)
    assert estimate.value == a.mean() - b.mean()
    assert estimate.low == pytest.approx(estimate.value - half, abs=0.1)
    assert estimate.high == pytest.approx(estimate.value + half, abs=0.1)
    # the same seeds on both sides do not cancel
    same = stats.seed_difference(a, a)
    assert same.high - same.low > 3.9 * math.sqrt(2 * a.var() / 60) * 0.9


@pytest.mark.parametrize(
    "estimate",
    [
        stats.seed_mean([4]),
        stats.seed_difference([5], [1, 1]),
        stats.seed_difference([5, 5], [1]),
    ],
)
def test_one_seed_has_no_interval(estimate):
    assert estimate.value == 4
    assert math.isnan(estimate.low)
    assert math.isnan(estimate.high)


def test_intervals_of_curves_are_those_of_each_point():
    curves = np.stack((X[:, 0], X[:, 3], np.full(5, 7)), 1).astype(float)
    band = stats.curve_interval(curves, resamples=20_000)
    assert band.value.tolist() == curves.mean(0).tolist()
    for point in range(3):
        alone = stats.interval(curves[:, [point]], np.mean, resamples=20_000)
        assert band.low[point] == pytest.approx(alone.low, abs=0.3)
        assert band.high[point] == pytest.approx(alone.high, abs=0.3)


def test_the_middle_half_lies_between_the_quartiles():
    band = stats.middle_half([[0, 5], [1, 5], [2, 5], [3, 5], [100, 5]])
    assert band.value.tolist() == [21.2, 5]
    assert (band.low.tolist(), band.high.tolist()) == ([1, 5], [3, 5])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: stats.interval([]), r"scores of shape \(1, 0\) .* \[S, A\]"),
        (lambda: stats.interval(np.zeros((2, 2, 2))), r"scores of shape \(2, 2, 2\)"),
        (lambda: stats.interval([1, math.nan]), "1 are not finite"),
        (lambda: stats.interval([1, 2], resample="all"), "resample='all' .*crossed"),
        (lambda: stats.interval([1, 2], resample="stratified"), "at least 2 seeds"),
        (lambda: stats.paired_difference([1, 2], [1, 2, 3]), "of 2 and of 3 arenas"),
        (lambda: stats.seed_mean([[1], [2]]), r"of shape \(2, 1\) are not allowed"),
        (lambda: stats.seed_difference([1], [math.nan]), "the second scores"),
    ],
)
def test_scores_that_cannot_be_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()

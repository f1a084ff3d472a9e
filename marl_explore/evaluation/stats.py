"""Statistics of scores: interquartile mean, bootstrap intervals, comparisons of two policies.

Scores are arrays [S, A] of S training seeds on A arenas, or [A] of one seed. ``docs/metrics.md``
has every formula. The definitions are those of Agarwal et al., "Deep Reinforcement Learning at
the Edge of the Statistical Precipice" (2021) and of their library rliable, except for what the
bootstrap resamples by default (see ``Resample``).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import trim_mean

Array = NDArray[np.float64]

Resample = Literal["crossed", "stratified"]
"""What a bootstrap resamples with replacement.

"crossed": seeds as whole rows, and arenas as whole columns. The interval is for other seeds and
other arenas, and takes into account that all scores of a seed are correlated. With one seed it is
over arenas alone.

"stratified", the default of rliable: seeds within every arena, independently of the other arenas.
The interval is for the same arenas, and is valid when a policy was trained for each of them.
"""

CONFIDENCE = 0.95
RESAMPLES = 2000


class Estimate(NamedTuple):
    """A number and its 95 % interval."""

    value: float
    low: float
    high: float


class Band(NamedTuple):
    """A curve [X] with a lower and an upper one."""

    value: Array
    low: Array
    high: Array


def interquartile_mean(scores: ArrayLike) -> float:
    """Mean of the middle half of all scores: floor(n / 4) of n are dropped at either end."""
    return float(trim_mean(np.asarray(scores, np.float64), 0.25, axis=None))


def interval(
    scores: ArrayLike,
    statistic: Callable[[Array], float] = interquartile_mean,
    resample: Resample = "crossed",
    seed: int = 0,
    resamples: int = RESAMPLES,
) -> Estimate:
    """A statistic of scores with its percentile bootstrap interval.

    Args:
        scores: [S, A] or [A].
        statistic: of an array [S, A].
        resample: what is resampled; "stratified" needs at least two seeds.
        seed: of the draws.
        resamples: number of draws.

    Raises:
        ValueError: for scores with another shape, without entries or not finite, and for a
            ``resample`` that is unknown or that the scores do not allow.
    """
    return _estimate(statistic, [_matrix("scores", scores)], resample, seed, resamples)


def joint_draws(
    samples: Mapping[str, ArrayLike],
    statistics: Mapping[str, Callable[[Array], float]],
    seed: int = 0,
    resamples: int = RESAMPLES,
) -> dict[str, Array]:
    """Statistics of several policies in bootstrap draws of the same arenas, [resamples] each.

    In every draw the arenas are the same for all, and the seeds of each are drawn on their own, so
    whatever follows from several of the statistics can be judged in each draw.

    Args:
        samples: [S, A, ...] by name, S for each its own, A the same for all.
        statistics: by the same names, of an array [S, A, ...].
        seed: of the draws.
        resamples: number of draws.

    Raises:
        ValueError: for different numbers of arenas.
    """
    arrays = {name: np.asarray(sample, np.float64) for name, sample in samples.items()}
    counts = {array.shape[1] for array in arrays.values()}
    if len(counts) != 1:
        raise ValueError(f"samples of {sorted(counts)} arenas cannot be drawn together")
    generator = np.random.default_rng(seed)
    draws = {name: np.empty(resamples) for name in arrays}
    for i in range(resamples):
        drawn = _crossed([*arrays.values()], generator)
        for name, array in zip(arrays, drawn, strict=True):
            draws[name][i] = statistics[name](array)
    return draws


def bounds(draws: ArrayLike) -> tuple[float, float]:
    """The 95 % interval of bootstrap draws; draws that are NaN do not count."""
    values = np.asarray(draws, np.float64)
    if np.isnan(values).all():
        return np.nan, np.nan
    low, high = np.nanquantile(values, _TAILS)
    return float(low), float(high)


def paired_difference(
    a: ArrayLike, b: ArrayLike, seed: int = 0, resamples: int = RESAMPLES
) -> Estimate:
    """Mean score of ``a`` minus that of ``b`` on the same arenas, with its bootstrap interval.

    Arenas are resampled for both together, so that an arena's difficulty for both cancels; seeds
    are resampled separately.

    Args:
        a: [S, A] or [A].
        b: [S', A] or [A]; column j is the arena of column j of ``a``.
        seed: of the draws.
        resamples: number of draws.

    Raises:
        ValueError: as ``interval``, and for different numbers of arenas.
    """
    pair = _pair(a, b)
    return _estimate(lambda x, y: float(x.mean() - y.mean()), pair, "crossed", seed, resamples)


def probability_of_improvement(
    x: ArrayLike,
    y: ArrayLike,
    resample: Resample = "crossed",
    seed: int = 0,
    resamples: int = RESAMPLES,
) -> Estimate:
    """Probability that ``x`` scores more than ``y`` on an arena, ties counted one half.

    It is the mean over arenas of the Mann-Whitney statistic over pairs of seeds, divided by the
    number of pairs. Where less is better, as with steps, swap the arguments.

    Args:
        x: [S, A] or [A].
        y: [S', A] or [A]; column j is the arena of column j of ``x``.
        resample: what is resampled, independently for x and y except for whole arenas.
        seed: of the draws.
        resamples: number of draws.

    Raises:
        ValueError: as ``interval``, and for different numbers of arenas.
    """
    return _estimate(_superiority, _pair(x, y), resample, seed, resamples)


def seed_mean(scores: ArrayLike) -> Estimate:
    """The mean over training seeds with its bootstrap interval; NaN bounds for one seed.

    Args:
        scores: [S], for each seed the mean over its arenas; the interval is for other seeds on the
            same arenas.

    Raises:
        ValueError: for scores of another shape, without entries or not finite.
    """
    values = _seeds("scores", scores)
    return _over_seeds(float(values.mean()), [values], lambda means: means)


def seed_difference(a: ArrayLike, b: ArrayLike) -> Estimate:
    """Mean of ``a`` minus that of ``b`` with its bootstrap interval; NaN bounds for one seed.

    Seeds of both are resampled independently: under other settings the same seed is another run,
    so they are not paired.

    Args:
        a: [S], for each seed the mean over its arenas.
        b: [S'], on the same arenas.

    Raises:
        ValueError: as ``seed_mean``.
    """
    pair = [_seeds("the first scores", a), _seeds("the second scores", b)]
    difference = float(pair[0].mean() - pair[1].mean())
    return _over_seeds(difference, pair, lambda x, y: x - y)


def curve_interval(curves: ArrayLike, seed: int = 0, resamples: int = RESAMPLES) -> Band:
    """The mean of curves [S, X] of S seeds with its bootstrap interval at every point.

    Raises:
        ValueError: for curves of another shape, or not finite.
    """
    values = _matrix("curves", curves)
    rows = len(values)
    drawn = np.random.default_rng(seed).integers(rows, size=(resamples, rows))
    weights = (drawn[:, :, None] == np.arange(rows)).mean(1)  # share of each seed in each draw
    return Band(values.mean(0), *np.quantile(weights @ values, _TAILS, axis=0))


def middle_half(curves: ArrayLike) -> Band:
    """The mean of curves [B, X], with their quartiles at every point."""
    values = _matrix("curves", curves)
    return Band(values.mean(0), *np.quantile(values, (0.25, 0.75), axis=0))


_TAILS = ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2)


def _estimate(
    statistic: Callable[..., float],
    samples: list[Array],
    resample: Resample,
    seed: int,
    resamples: int,
) -> Estimate:
    """A statistic of arrays over the same arenas, and its quantiles over bootstrap draws."""
    if resample not in get_args(Resample):
        raise ValueError(f"resample={resample!r} is not allowed: use one of {get_args(Resample)}")
    if resample == "stratified" and min(map(len, samples)) < 2:
        raise ValueError("resample='stratified' is not allowed: it needs at least 2 seeds")
    generator = np.random.default_rng(seed)
    arenas = samples[0].shape[1]
    draws = np.empty(resamples)
    for i in range(resamples):
        if resample == "stratified":
            drawn = [
                s[generator.integers(len(s), size=s.shape), np.arange(arenas)] for s in samples
            ]
        else:
            drawn = _crossed(samples, generator)
        draws[i] = statistic(*drawn)
    low, high = np.quantile(draws, _TAILS)
    return Estimate(statistic(*samples), float(low), float(high))


def _crossed(samples: list[Array], generator: np.random.Generator) -> list[Array]:
    """One draw of samples [S, A, ...]: the same arenas for all, seeds for each on its own."""
    arenas = samples[0].shape[1]
    columns = generator.integers(arenas, size=arenas)
    return [s[generator.integers(len(s), size=(len(s), 1)), columns] for s in samples]


def _over_seeds(value: float, samples: list[Array], combine: Callable[..., Array]) -> Estimate:
    """A value, and the quantiles of ``combine`` over bootstrap means of each sample [S]."""
    if min(map(len, samples)) < 2:  # one seed gives no interval
        return Estimate(value, np.nan, np.nan)
    generator = np.random.default_rng(0)
    means = (generator.choice(s, (RESAMPLES, len(s))).mean(1) for s in samples)
    return Estimate(value, *map(float, np.quantile(combine(*means), _TAILS)))


def _superiority(x: Array, y: Array) -> float:
    larger = x[:, None] > y
    return float(larger.mean() + (x[:, None] == y).mean() / 2)


def _pair(a: ArrayLike, b: ArrayLike) -> list[Array]:
    first, second = _matrix("the first scores", a), _matrix("the second scores", b)
    if first.shape[1] != second.shape[1]:
        raise ValueError(
            f"scores of {first.shape[1]} and of {second.shape[1]} arenas cannot be compared: "
            "column j of both must be the same arena"
        )
    return [first, second]


def _seeds(name: str, values: ArrayLike) -> Array:
    rows = _matrix(name, values)
    if len(rows) != 1:
        raise ValueError(f"{name} of shape {rows.shape} are not allowed: they must be [S]")
    return rows[0]


def _matrix(name: str, values: ArrayLike) -> Array:
    array = np.atleast_2d(np.asarray(values, np.float64))
    if array.ndim != 2 or array.size == 0:
        raise ValueError(f"{name} of shape {array.shape} are not allowed: they must be [S, A]")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} are not allowed: {(~np.isfinite(array)).sum()} are not finite")
    return array

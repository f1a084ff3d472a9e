"""Rows of a leaderboard: statistics of an entry's cells on one suite."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from marl_explore.evaluation.leaderboard.cells import Result
from marl_explore.evaluation.stats import Array, Estimate, interval, paired_difference
from marl_explore.evaluation.stats import probability_of_improvement as improvement

RANKED_BY = "steps_to_100"


def title(rows: Sequence[Row]) -> str:
    """The suite of some rows, and how it was measured."""
    settings = rows[0].settings
    return f"{settings['suite']}: {settings['num_arenas']} arenas, {settings['steps']} steps"


@dataclass
class Row:
    """An entry on one suite."""

    name: str
    results: Sequence[Result]
    """One per training seed."""
    measures: dict[str, float] = field(default_factory=dict)
    """Numbers by name: those of docs/metrics.md, and what ``rank`` adds."""

    @property
    def settings(self) -> dict[str, Any]:
        """What it was measured on; the same for every seed, except the policy."""
        return self.results[0]["settings"]

    @property
    def sees(self) -> str:
        """What the policy sees."""
        return self.results[0]["sees"]

    @property
    def reference(self) -> bool:
        """Whether it uses information that no robot has, and is ranked separately."""
        return self.results[0]["reference"]

    @property
    def played(self) -> bool:
        """Whether there were episodes; the bound has none."""
        return "coverage" in self.results[0]

    @property
    def planner(self) -> bool:
        """Whether it is a planner."""
        return self.results[0]["planner"]

    def scores(self, measure: str) -> Array:
        """A measure for every seed and arena, [S, A]."""
        return np.array([result["scores"][measure] for result in self.results], np.float64)

    def share(self, name: str) -> tuple[Array, Array]:
        """Counts of a kind of event and of all events, for every seed and arena, [S, A] each."""
        counts = [result["shares"][name] for result in self.results]
        part, whole = (np.array([c[key] for c in counts], np.float64) for key in ("part", "whole"))
        return part, whole


def rank(entries: Mapping[str, Sequence[Result]]) -> list[Row]:
    """The rows of one suite, ordered by mean steps to 100 %, references last.

    In addition to the means of all measures, a row has for these steps "_low" and "_high" (interval
    of the mean), "_iqm", "_iqm_low", "_iqm_high" and "_p90". Compared with the fastest planner that
    is not a reference, it has "difference", "difference_low", "difference_high" (paired) and
    "improvement" (probability of fewer steps); NaN for that planner itself and without one.
    """
    rows = [Row(name, results) for name, results in entries.items()]
    rows.sort(key=_place)
    best = next((row for row in rows if row.planner and not row.reference), None)
    for row in rows:
        row.measures |= _means(row) | _steps(row.scores(RANKED_BY)) | _against(row, best)
    return rows


def _place(row: Row) -> tuple[bool, float, float]:
    """Sort key of rows; coverage decides between those that never complete a map."""
    steps = row.scores(RANKED_BY).mean()
    coverage = row.scores("final_largest_coverage").mean() if row.played else 0
    return row.reference, float(steps), -float(coverage)


def _means(row: Row) -> dict[str, float]:
    first = row.results[0]
    means = {name: float(row.scores(name).mean()) for name in first["scores"]}
    for name in first["shares"]:
        part, whole = row.share(name)
        means[name] = float(part.sum() / whole.sum()) if whole.any() else float("nan")
    return means


def _steps(steps: Array) -> dict[str, float]:
    mean, middle = interval(steps, lambda x: float(x.mean())), interval(steps)
    return {
        f"{RANKED_BY}_low": mean.low,
        f"{RANKED_BY}_high": mean.high,
        f"{RANKED_BY}_iqm": middle.value,
        f"{RANKED_BY}_iqm_low": middle.low,
        f"{RANKED_BY}_iqm_high": middle.high,
        f"{RANKED_BY}_p90": float(np.quantile(steps, 0.9)),
    }


def _against(row: Row, best: Row | None) -> dict[str, float]:
    difference = Estimate(*[float("nan")] * 3)
    probability = float("nan")
    if best is not None and best is not row:
        steps, fewest = row.scores(RANKED_BY), best.scores(RANKED_BY)
        difference = paired_difference(steps, fewest)
        probability = improvement(fewest, steps).value  # fewer steps are better
    return {
        "difference": difference.value,
        "difference_low": difference.low,
        "difference_high": difference.high,
        "improvement": probability,
    }

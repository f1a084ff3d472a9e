"""Figures that compare policies on the same arenas."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from marl_explore.evaluation.plots.style import STYLE, draw_band, legend, line_styles, save
from marl_explore.evaluation.stats import Array, Band, middle_half, seed_mean

MARKED_STEPS = (20, 50, 150)
"""Steps that are marked with a dot in ``tradeoff_figure``."""

_DONE = 0.995
"""Mean coverage at which a team counts as done."""


def coverage_figure(
    curves: Mapping[str, Tensor | Band],
    path: str | Path,
    covers: str = "coverage of the largest map",
    whole: bool = False,
) -> Path:
    """Coverage of the largest map over steps, a line per policy with the middle half shaded.

    The horizontal axis ends when all policies but the slowest are done, and the legend says what
    that one covers at the last step.

    Args:
        curves: per policy [B, T + 1], as from ``metrics.coverage``, or ``stats.middle_half`` of
            it; shares of the target cells.
        path: image file to write.
        covers: label of the vertical axis.
        whole: whether the horizontal axis shows all steps.
    """
    with matplotlib.rc_context(STYLE):
        # without pyplot, so that a user's backend and open figures are not affected
        figure = Figure(figsize=(7, 3.6), layout="constrained")
        axes = figure.subplots()
        bands = {
            name: curve if isinstance(curve, Band) else middle_half(curve.numpy())
            for name, curve in curves.items()
        }
        means = [band.value for band in bands.values()]
        end = max(map(len, means)) - 1
        if not whole:
            end = min(end, _end_of_interest(means))
        for name, style in line_styles(bands):
            *_, last = value = bands[name].value
            steps = np.arange(len(value), dtype=np.float64)
            if value[min(end, len(value) - 1)] < min(_DONE, last):  # goes on beyond the axis
                style["label"] = f"{name} ({last:.0%} at {len(value) - 1})"
            draw_band(axes, steps, Band(*(100 * line for line in bands[name])), style)
        axes.set(
            xlabel="step",
            ylabel=f"{covers} (%)",
            xlim=(0, end),
            ylim=(0, 102),
            title="How fast teams map arenas\n(mean over arenas, middle half shaded)",
        )
        axes.grid(alpha=0.25)
        legend(figure, axes)
        return save(figure, path)


def _end_of_interest(curves: Sequence[Array]) -> int:
    """The step at which all curves but the slowest have arrived, and a little more."""
    arrivals = sorted(
        int((curve >= _DONE).argmax()) if curve[-1] >= _DONE else len(curve) - 1 for curve in curves
    )
    second = arrivals[-2:][0]
    return max(1, second + second // 10)


def lab_figure(coverage: Mapping[str, Tensor], path: str | Path) -> Path:
    """Coverage of the best map and of the merged maps over the steps of robots in the lab.

    Args:
        coverage: "best" and "merged", float [A, T + 1], as from ``lab.LabRecord.coverage``.
        path: image file to write.
    """
    curves = {"best map": coverage["best"], "merged map": coverage["merged"]}
    return coverage_figure(curves, path, covers="known target cells", whole=True)


def communication_figure(shares: Mapping[str, Mapping[str, Tensor]], path: str | Path) -> Path:
    """How often robots communicate, and how often that enlarges the sender's map.

    Per policy and arena: mean (dot), middle half (thick) and 5 to 95 % (thin) over arenas.

    Args:
        shares: per policy "communication_share" and "useful_share", float [B] each, such as the
            ``each`` of ``metrics.shares``; NaN (no communication) is left out.
        path: image file to write.
    """
    panels = {
        "communication_share": "communicate actions / all actions (%)",
        "useful_share": "communicate actions that\nenlarged the sender's map (%)",
    }
    with matplotlib.rc_context(STYLE):
        height = 1.6 + 0.28 * len(shares)
        figure = Figure(figsize=(7, height), layout="constrained")
        figure.suptitle(
            "How often robots communicate, and how often it helps\n"
            "(mean, middle half, 5 to 95 % of arenas)",
            fontsize=STYLE["axes.titlesize"],
        )
        for axes, (key, title) in zip(
            figure.subplots(1, 2, sharey=True), panels.items(), strict=True
        ):
            for row, (name, style) in enumerate(line_styles(shares)):
                values = 100 * shares[name][key].numpy()
                values = values[np.isfinite(values)]
                if not len(values):
                    axes.text(0, row, " none", va="center", color="0.4")
                    continue
                low, first, third, high = np.percentile(values, (5, 25, 75, 95))
                axes.hlines(row, low, high, color=style["color"], linewidth=1.2)
                axes.hlines(row, first, third, color=style["color"], linewidth=6, alpha=0.5)
                axes.plot(
                    values.mean(), row, "o", color=style["color"], markersize=5, clip_on=False
                )
            axes.set(xlabel=title, ylim=(len(shares) - 0.4, -0.6))
            axes.set_xlim(left=0)
            axes.set_yticks(range(len(shares)), list(shares))
            axes.grid(axis="x", alpha=0.25)
        return save(figure, path)


def seeds_figure(
    scores: Mapping[str, Sequence[float]], path: str | Path, label: str, scale: float = 1
) -> Path:
    """One measure of several trainings: a dot per seed, and the mean with its interval.

    Args:
        scores: per training, the measure of every seed [S]; one seed has no interval.
        path: image file to write.
        label: of the horizontal axis.
        scale: factor for the scores.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7, 1 + 0.28 * len(scores)), layout="constrained")
        axes = figure.subplots()
        for row, (name, style) in enumerate(line_styles(scores)):
            values = scale * np.asarray(scores[name])
            color, mean = style["color"], seed_mean(values)
            if np.isfinite(mean.low):
                axes.hlines(row, mean.low, mean.high, color=color, linewidth=6, alpha=0.4)
            axes.plot(values, [row] * len(values), "o", color=color, markersize=4, clip_on=False)
            axes.plot(mean.value, row, "|", color=color, markersize=14, markeredgewidth=2)
        axes.set(
            xlabel=label,
            ylim=(len(scores) - 0.4, -0.6),
            title="How well each training explores\n"
            "(a dot per seed; bar: mean with its 95 % interval)",
        )
        axes.set_yticks(range(len(scores)), list(scores))
        axes.grid(axis="x", alpha=0.25)
        return save(figure, path)


def enlargement_figure(
    enlargements: Mapping[str, Tensor], max_discovery: int | Sequence[int], path: str | Path
) -> Path:
    """Distribution of what merges add to maps: the share of merges that add more than x cells.

    The value of a curve at e_max is the share of merges that added more than any move could have
    discovered.

    Args:
        enlargements: per policy int [any], as from ``metrics.enlargements``, including zeros; a
            policy without any is left out.
        max_discovery: e_max (cells), of each robot if they differ; the largest is drawn.
        path: image file to write.
    """
    most = max_discovery if isinstance(max_discovery, int) else max(max_discovery)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7, 3.6), layout="constrained")
        axes = figure.subplots()
        for name, style in line_styles(enlargements):
            if not len(enlargements[name]):
                continue
            counts = enlargements[name].bincount().numpy()
            more = 100 * (1 - counts.cumsum() / counts.sum())
            axes.step(np.arange(len(more)), more, where="post", **style)
        axes.axvline(most, color="black", linewidth=1)
        axes.annotate(
            f" $e_{{max}}$ = {most}",
            (most, 1),
            xycoords=("data", "axes fraction"),
            va="top",
        )
        axes.set(
            xlabel="cells",
            ylabel="merges that add more than this\nto a member's map (%)",
            title="What merges add to maps\n(line: the most that a move can discover)",
        )
        axes.set_xlim(left=0)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.25)
        legend(figure, axes)
        return save(figure, path)


def tradeoff_figure(curves: Mapping[str, tuple[Tensor, Tensor]], path: str | Path) -> Path:
    """Coverage against cells sent, a line per policy from the reset to the last step.

    Args:
        curves: per policy, cells sent so far by all robots and coverage of the largest map (share
            of the target cells), means over arenas, float [T + 1] each.
        path: image file to write.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7, 3.6), layout="constrained")
        axes = figure.subplots()
        for name, style in line_styles(curves):
            sent, covered = (curve.numpy() for curve in curves[name])
            marks = [step for step in MARKED_STEPS if step < len(sent)]
            axes.plot(sent, 100 * covered, marker="o", markevery=marks, markersize=4, **style)
        axes.set(
            xlabel="map cells sent by all robots so far",
            ylabel="coverage of the largest map (%)",
            ylim=(0, 102),
            title="What coverage costs in cells sent\n(means over arenas, dots at steps "
            f"{', '.join(map(str, MARKED_STEPS))})",
        )
        axes.set_xscale("symlog", linthresh=100)  # includes 0, for robots that never communicate
        axes.set_xlim(left=-5)
        axes.grid(alpha=0.25)
        legend(figure, axes)
        return save(figure, path)

"""Training curves from run folders."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

from marl_explore.evaluation.plots.style import STYLE, draw_band, legend, line_styles, save
from marl_explore.evaluation.stats import Array, curve_interval
from marl_explore.utils.curves import read_curve

MEASURES = {
    "episode_return": "return of an episode",
    "final_coverage": "coverage at an episode's end",
    "communication_share": "communicate actions / all actions",
}
"""Training metrics that are shown by default, and their labels."""


def training_figure(
    runs: Mapping[str, Sequence[str | Path]],
    path: str | Path,
    measures: Mapping[str, str] = MEASURES,
    steps: str = "steps of single arenas",
) -> Path:
    """Training curves: mean over seeds, with its 95 % bootstrap interval shaded.

    Args:
        runs: per name, the run folders of its seeds; one seed has no interval.
        path: image file to write.
        measures: names of docs/metrics.md ("Training") and the labels of their panels.
        steps: label of the horizontal axis.

    Raises:
        ValueError: when a run folder has no such measure.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(1.5 + 3 * len(measures), 3), layout="constrained")
        panels = figure.subplots(1, len(measures), squeeze=False)[0]
        for axes, (measure, label) in zip(panels, measures.items(), strict=True):
            for name, style in line_styles(runs):
                frames, curves = _curves(runs[name], measure)
                draw_band(axes, frames, curve_interval(curves), style)
            axes.set(xlabel=steps, ylabel=label)
            axes.xaxis.set_major_locator(MaxNLocator(5))
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))  # 200k, 1M
            axes.grid(alpha=0.25)
        figure.suptitle("How training goes\n(mean over seeds, 95 % interval shaded)")
        legend(figure, panels[0])
        return save(figure, path)


def _curves(folders: Sequence[str | Path], measure: str) -> tuple[Array, Array]:
    """One measure of all seeds [S, X] at the same frames [X], interpolated between updates.

    Seeds may lack different updates: no episode ends in some of them.
    """
    seeds = [_scalars(Path(folder), measure) for folder in folders]
    first, last = max(s[0, 0] for s in seeds), min(s[-1, 0] for s in seeds)
    frames = np.unique(np.concatenate([s[:, 0] for s in seeds]))
    frames = frames[(first <= frames) & (frames <= last)]
    return frames, np.stack([np.interp(frames, *s.T) for s in seeds])


def _scalars(folder: Path, measure: str) -> Array:
    """Frames and values of one run, float64 [updates, 2], without unmeasured ones."""
    file = folder / "scalars" / f"{measure}.csv"
    if not file.is_file():
        raise ValueError(f"{str(folder)!r} is not a run folder with {measure!r}: no {file}")
    values = read_curve(file)
    values = values[np.isfinite(values[:, 1])]
    if not len(values):
        raise ValueError(f"{file} has no value")
    return values

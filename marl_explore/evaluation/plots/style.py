"""Shared by all figures: colours, line styles, and writing to files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import cycle, product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from marl_explore.evaluation.stats import Array, Band
from marl_explore.utils.files import atomic_write
from marl_explore.utils.palette import COLORS

STYLE: dict[Any, Any] = {
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10,
    "font.size": 9,
    "legend.frameon": False,
    "figure.dpi": 100,
    "savefig.dpi": 150,
    "svg.hashsalt": "marl_explore",  # so that the same data give the same file
}

# yellow is too faint for a line on white
_LINE_COLORS = [color for color in COLORS if color != "#F0E442"]


def line_styles(names: Iterable[str]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Each name with the colour and dashes of its line; colours repeat with other dashes."""
    styles = cycle(product(("-", "--", ":"), _LINE_COLORS))
    for name, (dashes, color) in zip(names, styles, strict=False):
        yield name, {"color": color, "linestyle": dashes, "linewidth": 1.8, "label": name}


def draw_band(axes: Axes, x: Array, band: Band, style: dict[str, Any]) -> None:
    """Draw a line with the band around it shaded."""
    axes.plot(x, band.value, **style)
    if not np.array_equal(band.low, band.high):
        axes.fill_between(x, band.low, band.high, color=style["color"], alpha=0.15, linewidth=0)


def legend(figure: Figure, axes: Axes) -> None:
    """A legend next to the panels, where it hides nothing."""
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right upper")


def save(figure: Figure, path: str | Path) -> Path:
    """Write a figure in the format that the file's ending selects."""
    path = Path(path)
    kind = path.suffix.removeprefix(".")
    with atomic_write(path) as unfinished:
        # otherwise an SVG holds the time of its creation
        metadata = {"Date": None} if kind == "svg" else None
        figure.savefig(unfinished, format=kind, metadata=metadata)
    return path

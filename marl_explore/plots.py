"""Figures and animations (matplotlib): coverage over steps, and one episode's maps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.animation import (
    AbstractMovieWriter,
    FFMpegWriter,
    FuncAnimation,
    PillowWriter,
)
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from tensordict import TensorDictBase
from torch import Tensor

from marl_explore.palette import COLORS

UNKNOWN_COLOR, FREE_COLOR, OBSTACLE_COLOR = "#B8B8B8", "#FFFFFF", "#404040"
STYLE: dict[Any, Any] = {
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10,
    "font.size": 9,
    "figure.dpi": 100,
    "savefig.dpi": 150,
}


def coverage_figure(curves: Mapping[str, Tensor], path: str | Path) -> Path:
    """Coverage of the largest map over steps, a line per policy with the middle half shaded.

    Args:
        curves: per policy [B, T + 1], shares of the target cells.
        path: image file to write.
    """
    with matplotlib.rc_context(STYLE):
        # without pyplot: a user's backend and open figures stay as they are
        figure = Figure(figsize=(6, 3.6), layout="constrained")
        axes = figure.subplots()
        for (name, curve), color in zip(curves.items(), cycle(COLORS)):
            values = 100 * curve.numpy()
            steps = np.arange(values.shape[1])
            axes.plot(steps, values.mean(0), color=color, label=name, linewidth=1.8)
            low, high = np.percentile(values, (25, 75), axis=0)
            axes.fill_between(steps, low, high, color=color, alpha=0.15, linewidth=0)
        axes.set(
            xlabel="step",
            ylabel="coverage of the largest map (%)",
            xlim=(0, values.shape[1] - 1),
            ylim=(0, 102),
            title=f"mean and middle half over {len(values)} arenas",
        )
        axes.grid(alpha=0.25)
        axes.legend(frameon=False, loc="lower right")
        return _save(figure, path)


def episode_animation(
    steps: Sequence[TensorDictBase], path: str | Path, arena: int = 0, frames_per_second: int = 8
) -> Path:
    """A GIF or MP4 of one arena's episode: the true arena, and every robot's own map.

    Args:
        steps: observations of one episode in order, each with batch [B] as an env returns them.
        path: file ending in .gif, or in .mp4 where ffmpeg is on the PATH.
        arena: row of the batch to show.
        frames_per_second: speed.

    Raises:
        ValueError: for another ending.
        RuntimeError: for .mp4 without ffmpeg.
    """
    path = Path(path)
    writer = _movie_writer(path, frames_per_second)
    frames = [_Frame(step, arena) for step in steps]
    with matplotlib.rc_context(STYLE):
        figure, draw = _panels(frames)
        animation = FuncAnimation(
            figure, lambda t: draw(t), frames=len(frames), interval=1000 / frames_per_second
        )
        animation.save(path, writer, dpi=80)
    return path


def _movie_writer(path: Path, frames_per_second: int) -> AbstractMovieWriter:
    if path.suffix == ".gif":
        return PillowWriter(fps=frames_per_second)
    if path.suffix != ".mp4":
        raise ValueError(f"path={str(path)!r} is not allowed: it must end in .gif or .mp4")
    if not FFMpegWriter.isAvailable():
        raise RuntimeError(
            f"path={str(path)!r} cannot be written: .mp4 takes ffmpeg on the PATH, .gif nothing"
        )
    return FFMpegWriter(fps=frames_per_second)


def episode_figure(steps: Sequence[TensorDictBase], path: str | Path, arena: int = 0) -> Path:
    """The last frame of ``episode_animation`` with the robots' whole paths."""
    frames = [_Frame(step, arena) for step in steps]
    with matplotlib.rc_context(STYLE):
        figure, draw = _panels(frames)
        draw(len(frames) - 1)
        return _save(figure, path)


class _Frame:
    """What is drawn of one observation, as arrays."""

    def __init__(self, observation: TensorDictBase, arena: int) -> None:
        agents = observation.get("agents")
        self.obstacles = observation.get("obstacles")[arena].numpy()
        self.position = agents.get("position")[arena].numpy()
        self.maps = agents.get("map")[arena].numpy()
        self.merged = agents.get("merged")[arena].numpy()


def _panels(frames: Sequence[_Frame]):  # type: ignore[no-untyped-def]
    """The figure of an episode and the function that draws its frame ``t``."""
    robots = len(frames[0].position)
    figure = Figure(figsize=(2.1 * (robots + 1), 2.5), layout="constrained")
    axes = figure.subplots(1, robots + 1, squeeze=False)
    num_cells = frames[0].obstacles.size

    def draw(t: int) -> None:
        truth, *own = axes[0]
        frame = frames[t]
        _draw_grid(truth, frame.obstacles.astype(int), f"step {t}")
        for robot, (panel, color) in enumerate(_colored(own)):
            path = np.array([f.position[robot] for f in frames[: t + 1]])
            known = (frame.maps[robot] >= 0).sum() / num_cells
            _draw_grid(panel, frame.maps[robot], f"robot {robot}: {known:.0%} known", color)
            for place in (truth, panel):
                place.plot(path[:, 1], path[:, 0], color=color, alpha=0.5, linewidth=1.2)
                place.plot(*path[-1, ::-1], "o", color=color, markersize=6)
            if frame.merged[robot]:  # a ring around robots that exchange maps
                truth.plot(*path[-1, ::-1], "o", color=color, markersize=12, fillstyle="none")

    return figure, draw


def _colored(panels: Sequence[Axes]) -> Iterator[tuple[Axes, str]]:
    return ((panel, COLORS[i % len(COLORS)]) for i, panel in enumerate(panels))


def _draw_grid(axes: Axes, grid: np.ndarray, title: str, color: str = "black") -> None:
    """A grid of -1 unknown, 0 free, 1 occupied."""
    axes.clear()
    shades = [UNKNOWN_COLOR, FREE_COLOR, OBSTACLE_COLOR]
    axes.imshow(grid, cmap=ListedColormap(shades), vmin=-1, vmax=1)
    axes.set_title(title, color=color)
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(True)


def _save(figure: Figure, path: str | Path) -> Path:
    path = Path(path)
    figure.savefig(path)
    return path

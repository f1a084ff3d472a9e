"""Arena, maps and paths of one episode, as a figure and as an animation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.animation import (
    AbstractMovieWriter,
    FFMpegWriter,
    FuncAnimation,
    PillowWriter,
)
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, to_hex, to_rgb
from matplotlib.figure import Figure
from tensordict import TensorDictBase

from marl_explore.evaluation.plots.style import STYLE, save
from marl_explore.utils.palette import COLORS, FREE_COLOR, OBSTACLE_COLOR, UNKNOWN_COLOR


def episode_animation(
    steps: Sequence[TensorDictBase], path: str | Path, arena: int = 0, frames_per_second: int = 8
) -> Path:
    """A GIF or MP4 of one arena's episode: the true arena, and every robot's own map.

    Args:
        steps: observations of one episode in order, each with batch [B], as an env returns them.
        path: file ending in .gif, or in .mp4 if ffmpeg is on the PATH.
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
            f"path={str(path)!r} cannot be written: .mp4 needs ffmpeg on the PATH, .gif does not"
        )
    return FFMpegWriter(fps=frames_per_second)


def episode_figure(steps: Sequence[TensorDictBase], path: str | Path, arena: int = 0) -> Path:
    """The last frame of ``episode_animation``, with the robots' complete paths."""
    frames = [_Frame(step, arena) for step in steps]
    with matplotlib.rc_context(STYLE):
        figure, draw = _panels(frames)
        draw(len(frames) - 1)
        return save(figure, path)


class _Frame:
    """The data of one observation to draw, as arrays."""

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
                place.plot(path[:, 1], path[:, 0], color=color, alpha=0.75, linewidth=1.2)
                place.plot(*path[-1, ::-1], "o", color=color, markersize=6)
            if frame.merged[robot]:  # a ring around robots that exchange maps
                truth.plot(*path[-1, ::-1], "o", color=color, markersize=12, fillstyle="none")

    return figure, draw


def _colored(panels: Sequence[Axes]) -> Iterator[tuple[Axes, str]]:
    return ((panel, COLORS[i % len(COLORS)]) for i, panel in enumerate(panels))


def _draw_grid(axes: Axes, grid: np.ndarray, title: str, color: str = "") -> None:
    """Draw a grid of -1 unknown, 0 free, 1 occupied; a robot's free cells in its colour."""
    axes.clear()
    shades = [UNKNOWN_COLOR, _pale(color) if color else FREE_COLOR, OBSTACLE_COLOR]
    axes.imshow(grid, cmap=ListedColormap(shades), vmin=-1, vmax=1)
    axes.set_title(title, color=color or "black")
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(True)


def _pale(color: str) -> str:
    red, green, blue = (0.75 + 0.25 * part for part in to_rgb(color))
    return to_hex((red, green, blue))

"""Arena, maps and paths of one episode, as a figure and as an animation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.animation import AbstractMovieWriter, FFMpegWriter, FuncAnimation
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap, to_hex, to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image
from tensordict import TensorDictBase
from torch import Tensor
from tqdm import tqdm

from marl_explore.core.mapping import target_cells
from marl_explore.evaluation.plots.style import STYLE, save
from marl_explore.utils.files import atomic_write
from marl_explore.utils.palette import (
    FREE_COLOR,
    OBSTACLE_COLOR,
    UNKNOWN_COLOR,
    WALKER_COLOR,
    robot_color,
)

DPI = 80
"""Of animations."""
PANEL_WIDTH, COLUMNS = 2.1, 6
"""Width of a panel (inches), and panels side by side of a square arena."""


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
        figure.set_dpi(DPI)
        draw(0)
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # the panels stay where they are: no layout per frame
        if writer is None:
            _write_gif(figure, draw, len(frames), path, frames_per_second)
        else:
            animation = FuncAnimation(figure, draw, frames=len(frames))
            animation.save(path, writer, dpi=DPI)
    return path


def _movie_writer(path: Path, frames_per_second: int) -> AbstractMovieWriter | None:
    """Who writes a film; None for a GIF, which needs nobody."""
    if path.suffix == ".gif":
        return None
    if path.suffix != ".mp4":
        raise ValueError(f"path={str(path)!r} is not allowed: it must end in .gif or .mp4")
    if not FFMpegWriter.isAvailable():
        raise RuntimeError(
            f"path={str(path)!r} cannot be written: .mp4 needs ffmpeg on the PATH, .gif does not"
        )
    return FFMpegWriter(fps=frames_per_second)


def _write_gif(
    figure: Figure, draw: Callable[[int], None], count: int, path: Path, frames_per_second: int
) -> None:
    """Frames drawn once each: matplotlib's own writer draws every one twice."""
    canvas = FigureCanvasAgg(figure)
    pictures = []
    for t in tqdm(range(count), desc=path.name, unit=" frames", disable=None, delay=1):
        draw(t)
        canvas.draw()
        pictures.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
    duration = round(1000 / frames_per_second)
    with atomic_write(path) as unfinished:
        first, *others = pictures
        first.save(
            unfinished, "GIF", save_all=True, append_images=others, duration=duration, loop=0
        )


def episode_figure(steps: Sequence[TensorDictBase], path: str | Path, arena: int = 0) -> Path:
    """The last frame of ``episode_animation``, with the robots' complete paths."""
    frames = [_Frame(step, arena) for step in steps]
    with matplotlib.rc_context(STYLE):
        figure, draw = _panels(frames)
        draw(len(frames) - 1)
        return save(figure, path)


def explored_figure(
    obstacles: Tensor, maps: Tensor, cells: Tensor, path: str | Path, moments: int = 4
) -> Path:
    """Who explored what: the arena from above, over the cells that each robot was first to know.

    Args:
        obstacles: bool [H, W].
        maps: every robot's map over the steps, int8 [T + 1, N, H, W].
        cells: the robots' cells over the steps, int64 [T + 1, N, 2].
        path: image file to write.
        moments: number of times to show, from the start to the last step.
    """
    times = np.linspace(0, len(maps) - 1, moments).round().astype(int)
    robots, (height, wide) = cells.shape[1], obstacles.shape
    shape = height, wide
    colors = [robot_color(robot) for robot in range(robots)]
    known = maps.numpy() >= 0
    first = np.where(known.any(0), known.argmax(0), len(maps))  # step of every robot and cell
    owner, when = first.argmin(0), first.min(0)
    shades = np.array([to_rgb(_pale(color)) for color in colors])
    with matplotlib.rc_context(STYLE):
        width = PANEL_WIDTH * moments
        figure = Figure(figsize=(width, 2 * PANEL_WIDTH + 0.6), layout="constrained")
        axes = figure.subplots(2, moments, squeeze=False)
        for time, (above, below) in zip(times, axes.T, strict=True):
            trails = [*cells[: time + 1].movedim(1, 0).numpy()]
            _Panel(above, shape, colors, "").draw(
                obstacles.numpy().astype(int), trails, [False] * robots, f"step {time}"
            )
            explored = np.where((when <= time)[..., None], shades[owner], to_rgb(UNKNOWN_COLOR))
            explored[(when <= time) & obstacles.numpy()] = to_rgb(OBSTACLE_COLOR)
            share = (when <= time).mean()
            panel = _Panel(below, shape, colors, "")
            panel.draw(np.zeros(shape), trails, [False] * robots, f"{share:.0%} of all cells known")
            panel.image.set_data(explored)
        axes[0, 0].set_ylabel("from above")
        axes[1, 0].set_ylabel("explored by")
        return save(figure, path)


class _Frame:
    """The data of one observation to draw, as arrays."""

    def __init__(self, observation: TensorDictBase, arena: int) -> None:
        agents = observation.get("agents")
        self.obstacles = observation.get("obstacles")[arena].numpy()
        self.position = agents.get("position")[arena].numpy()
        self.maps = agents.get("map")[arena].numpy()
        self.merged = agents.get("merged")[arena].numpy()
        self.failed = ~agents.get("alive")[arena].numpy()
        walkers = observation.get("walkers", None)
        self.walkers = np.zeros((0, 2)) if walkers is None else walkers[arena].numpy()


class _Panel:
    """A grid with paths on it, drawn once and then changed from frame to frame."""

    def __init__(self, axes: Axes, shape: tuple[int, int], colors: Sequence[str], own: str) -> None:
        self.axes = axes
        shades = [UNKNOWN_COLOR, _pale(own) if own else FREE_COLOR, OBSTACLE_COLOR]
        blank = np.full(shape, -1)
        self.image = axes.imshow(blank, cmap=ListedColormap(shades), vmin=-1, vmax=1)
        self.title = axes.set_title(" ", color=own or "black")
        axes.set(xticks=[], yticks=[], autoscale_on=False)
        axes.spines[:].set_visible(True)
        self.paths = [axes.plot([], [], color=c, alpha=0.75, linewidth=1.2)[0] for c in colors]
        self.places = [axes.plot([], [], "o", color=c, markersize=6)[0] for c in colors]
        self.rings = [
            axes.plot([], [], "o", color=c, markersize=12, fillstyle="none")[0] for c in colors
        ]
        (self.walkers,) = axes.plot([], [], "D", color=WALKER_COLOR, markersize=4)

    def draw(
        self, grid: NDArray[Any], paths: Sequence[NDArray[Any]], merged: Sequence[bool], title: str
    ) -> None:
        """Show another grid, other paths (row, column) and who exchanges maps."""
        self.image.set_data(grid)
        self.title.set_text(title)
        for path, line, place, ring, exchanges in zip(
            paths, self.paths, self.places, self.rings, merged, strict=True
        ):
            line.set_data(path[:, 1], path[:, 0])
            place.set_data(path[-1:, 1], path[-1:, 0])
            last = path[-1:] if exchanges else path[:0]
            ring.set_data(last[:, 1], last[:, 0])

    def mark(self, failed: Sequence[bool], walkers: NDArray[Any]) -> None:
        """Show robots that have failed as crosses, and walkers (row, column)."""
        for place, has_failed in zip(self.places, failed, strict=True):
            place.set_marker("X" if has_failed else "o")
        self.walkers.set_data(walkers[:, 1], walkers[:, 0])


def _panels(frames: Sequence[_Frame]) -> tuple[Figure, Callable[[int], None]]:
    """The figure of an episode and the function that draws its frame ``t``."""
    first = frames[0]
    robots, (height, width) = len(first.position), first.obstacles.shape
    columns = min(robots + 1, max(2, round(COLUMNS * min(1.5, height / width) ** 0.5)))
    rows = -(-(robots + 1) // columns)
    panel_width = PANEL_WIDTH * min(2.0, max(1.0, (width / height) ** 0.5))
    panel_height = panel_width * min(max(height / width, 0.08), 2.5) + 0.4
    size = (panel_width * columns, panel_height * rows)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).flatten()
    for empty in axes[robots + 1 :]:
        empty.set_axis_off()
    colors = [robot_color(robot) for robot in range(robots)]
    truth = _Panel(axes[0], first.obstacles.shape, colors, "")
    own = [_Panel(axes[1 + i], first.obstacles.shape, [c], c) for i, c in enumerate(colors)]
    target = target_cells(torch.from_numpy(first.obstacles), torch.from_numpy(first.position))
    reachable = target.numpy()
    path = np.stack([frame.position for frame in frames], 1)

    def draw(t: int) -> None:
        frame = frames[t]
        paths = path[:, : t + 1]
        truth.draw(frame.obstacles.astype(int), [*paths], frame.merged.tolist(), f"step {t}")
        truth.mark(frame.failed.tolist(), frame.walkers)
        for robot, panel in enumerate(own):
            known = (frame.maps[robot] >= 0)[reachable].mean()
            title = f"robot {robot}: {known:.0%} known"
            panel.draw(frame.maps[robot], [paths[robot]], [False], title)
            panel.mark([bool(frame.failed[robot])], frame.walkers[:0])

    return figure, draw


def _pale(color: str) -> str:
    red, green, blue = (0.75 + 0.25 * part for part in to_rgb(color))
    return to_hex((red, green, blue))

"""The union of a team's maps, as text and as an image."""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray
from PIL import ImageColor
from torch import Tensor

from marl_explore.config.checks import require
from marl_explore.core.grid import UNKNOWN
from marl_explore.core.mapping import union_of
from marl_explore.utils.palette import (
    FREE_COLOR,
    OBSTACLE_COLOR,
    UNKNOWN_COLOR,
    WALKER_COLOR,
    robot_color,
)

SIDE = 16
"""Pixels of a cell's side."""
RenderMode = Literal["ansi", "rgb_array"]
_MODES: tuple[RenderMode, ...] = get_args(RenderMode)
_SYMBOLS = "?.#"


class Team(NamedTuple):
    """What pictures show of a team and of the people around it."""

    maps: Tensor
    """int8 [N, H, W]."""
    position: Tensor
    """int64 [N, 2]."""
    alive: Tensor
    """bool [N]."""
    walkers: Tensor
    """int64 [W, 2]."""


def picture(team: Team, mode: RenderMode) -> str | NDArray[np.uint8]:
    """The union of the maps of living robots, as ``ascii_picture`` or ``rgb_picture``.

    Raises:
        ValueError: for another mode.
    """
    require(mode in _MODES, "mode", mode, f"it must be one of {_MODES}")
    return (ascii_picture if mode == "ansi" else rgb_picture)(team)


def ascii_picture(team: Team) -> str:
    """One line per row: ? unknown, . free, # occupied, a digit per robot (modulo 10).

    A robot that has failed is x, a walker *.
    """
    known = union_of(team.maps, team.alive)
    rows = [[_SYMBOLS[code - UNKNOWN] for code in row] for row in known.tolist()]
    for row, column in team.walkers.tolist():
        rows[row][column] = "*"
    robots = zip(team.position.tolist(), team.alive.tolist(), strict=True)
    for robot, ((row, column), lives) in enumerate(robots):
        rows[row][column] = str(robot % 10) if lives else "x"
    return "\n".join(map("".join, rows))


def rgb_picture(team: Team) -> NDArray[np.uint8]:
    """An image uint8 [16 H, 16 W, 3]: known cells, and a coloured square per robot.

    The square of a robot that has failed is open, that of a walker small.
    """
    shades = np.array(list(map(ImageColor.getrgb, (UNKNOWN_COLOR, FREE_COLOR, OBSTACLE_COLOR))))
    cells = shades[union_of(team.maps, team.alive).numpy() - UNKNOWN].astype(np.uint8)
    picture = cells.repeat(SIDE, 0).repeat(SIDE, 1)

    def square(cell: list[int], edge: int, color: NDArray[np.uint8]) -> None:
        top, left = (SIDE * part for part in cell)
        picture[top + edge : top + SIDE - edge, left + edge : left + SIDE - edge] = color

    def shade(color: str) -> NDArray[np.uint8]:
        return np.array(ImageColor.getrgb(color), np.uint8)

    for cell in team.walkers.tolist():
        square(cell, 3 * SIDE // 8, shade(WALKER_COLOR))
    robots = zip(team.position.tolist(), team.alive.tolist(), strict=True)
    for robot, (cell, lives) in enumerate(robots):
        square(cell, SIDE // 4, shade(robot_color(robot)))
        if not lives:
            square(cell, 3 * SIDE // 8, shade(FREE_COLOR))
    return picture

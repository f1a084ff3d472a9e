"""The union of a team's maps, as text and as an image."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from PIL import ImageColor
from torch import Tensor

from marl_explore.config.checks import require
from marl_explore.core.grid import UNKNOWN
from marl_explore.core.mapping import union_of
from marl_explore.utils.palette import FREE_COLOR, OBSTACLE_COLOR, UNKNOWN_COLOR, robot_color

SIDE = 16
"""Pixels of a cell's side."""
RenderMode = Literal["ansi", "rgb_array"]
_MODES: tuple[RenderMode, ...] = get_args(RenderMode)
_SYMBOLS = "?.#"


def picture(maps: Tensor, position: Tensor, mode: RenderMode) -> str | NDArray[np.uint8]:
    """The union of a team's maps, as ``ascii_picture`` or ``rgb_picture``.

    Raises:
        ValueError: for another mode.
    """
    require(mode in _MODES, "mode", mode, f"it must be one of {_MODES}")
    return (ascii_picture if mode == "ansi" else rgb_picture)(maps, position)


def ascii_picture(maps: Tensor, position: Tensor) -> str:
    """One line per row: ? unknown, . free, # occupied, a digit per robot (modulo 10).

    Args:
        maps: int8 [N, H, W].
        position: int64 [N, 2].
    """
    rows = [[_SYMBOLS[code - UNKNOWN] for code in row] for row in union_of(maps).tolist()]
    for robot, (row, column) in enumerate(position.tolist()):
        rows[row][column] = str(robot % 10)
    return "\n".join(map("".join, rows))


def rgb_picture(maps: Tensor, position: Tensor) -> NDArray[np.uint8]:
    """An image uint8 [16 H, 16 W, 3]: known cells, and a coloured square per robot.

    Args:
        maps: int8 [N, H, W].
        position: int64 [N, 2].
    """
    shades = np.array(list(map(ImageColor.getrgb, (UNKNOWN_COLOR, FREE_COLOR, OBSTACLE_COLOR))))
    cells = shades[union_of(maps).numpy() - UNKNOWN].astype(np.uint8)
    picture = cells.repeat(SIDE, 0).repeat(SIDE, 1)
    edge = SIDE // 4
    for robot, (row, column) in enumerate(position.tolist()):
        color = ImageColor.getrgb(robot_color(robot))
        top, left = row * SIDE, column * SIDE
        picture[top + edge : top + SIDE - edge, left + edge : left + SIDE - edge] = color
    return picture

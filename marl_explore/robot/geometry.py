"""Metres and cells: x points east, y north, and the origin is in the middle of the arena."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.checks import require_finite

GridCell = tuple[int, int]
"""(row, column); row 0 is north."""


FARTHEST_MOUNT = 5.0
"""How far a sensor is from its robot's middle at most, along either axis (metres)."""
MOST_YAW = 1e4
"""Largest heading, on either side of 0: of a robot that counts its turns (radians)."""


class Mount(NamedTuple):
    """Where a sensor is on its robot, as seen from the robot's middle."""

    x: float = 0.0
    """Ahead (metres)."""
    y: float = 0.0
    """To the left (metres)."""
    yaw: float = 0.0
    """Its own heading, 0 ahead, counter-clockwise (radians)."""

    def check(self, prefix: str = "") -> None:
        """Raise an error for numbers that are none, and for a sensor that is on no robot.

        Args:
            prefix: of the names in the error.

        Raises:
            ValueError: naming the field and its value.
        """
        require_finite(f"{prefix}x", self.x, "metres", FARTHEST_MOUNT)
        require_finite(f"{prefix}y", self.y, "metres", FARTHEST_MOUNT)
        require_finite(f"{prefix}yaw", self.yaw, "radians", MOST_YAW)


class Disc(NamedTuple):
    """A part of the ground, in the arena's frame (metres)."""

    x: float
    y: float
    radius: float


@dataclass(frozen=True)
class Frame:
    """The grid of an arena, in the arena's frame."""

    height: int
    """Rows (cells)."""
    width: int
    """Columns (cells)."""
    cell_size: float
    """Side of a cell (metres)."""

    @classmethod
    def of(cls, config: ArenaConfig) -> Frame:
        """The frame of a configuration's arena."""
        return cls(config.height, config.width, config.cell_size)

    def cell(self, x: float, y: float) -> GridCell:
        """The cell that contains a point (metres); it may be outside the arena."""
        row = math.floor(self.height / 2 - y / self.cell_size)
        return row, math.floor(self.width / 2 + x / self.cell_size)

    def centre(self, cell: GridCell) -> tuple[float, float]:
        """Middle of a cell, (x, y) in metres."""
        row, column = cell
        x = (column + 0.5 - self.width / 2) * self.cell_size
        return x, (self.height / 2 - row - 0.5) * self.cell_size

    def nearest(self, cell: GridCell) -> GridCell:
        """The cell inside the arena that is nearest to a cell."""
        row, column = cell
        return min(max(row, 0), self.height - 1), min(max(column, 0), self.width - 1)

    def inside(self, cell: GridCell) -> bool:
        """Whether a cell is inside the arena."""
        return 0 <= cell[0] < self.height and 0 <= cell[1] < self.width


def wrapped(angle: float) -> float:
    """The same angle in [-pi, pi] (radians)."""
    return math.remainder(angle, 2 * math.pi)

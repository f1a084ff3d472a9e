"""A robot's knowledge: its map, and its discoveries since its last merge with each other robot."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from marl_explore.config.constants import NEVER, UNKNOWN
from marl_explore.robot.geometry import Frame, GridCell
from marl_explore.robot.mapper import square

Map = NDArray[np.int8]


class Knowledge:
    """One robot's map and counts, as in docs/environment.md, Entries.

    Args:
        robot: number of the robot.
        robots: size of the team, N.
        frame: the arena's grid.
    """

    def __init__(self, robot: int, robots: int, frame: Frame) -> None:
        self.robot = robot
        self.frame = frame
        self.map: Map = np.full((frame.height, frame.width), UNKNOWN, np.int8)
        self.unshared = np.zeros(robots, np.int64)
        self.steps_since_merge = np.full(robots, NEVER, np.int64)
        self.steps_since_merge[robot] = 0
        self._began = False

    def sense(self, cell: GridCell, seen: Map) -> int:
        """Write the cells seen around a cell into the map; known cells keep their values.

        Args:
            cell: middle of the square.
            seen: ``mapper.sight``, int8 [2k + 1, 2k + 1].

        Returns:
            Number of cells that were new.
        """
        discovered = 0
        for place, code in zip(square(cell, len(seen) // 2), seen.flat, strict=True):
            if code != UNKNOWN and self.frame.inside(place) and self.map[place] == UNKNOWN:
                self.map[place] = code
                discovered += 1
        self.unshared += discovered
        self.unshared[self.robot] = 0
        if self._began:
            others = np.arange(len(self.unshared)) != self.robot
            self.steps_since_merge = np.minimum(self.steps_since_merge + others, NEVER)
        self._began = True
        return discovered

    def merge(self, maps: Mapping[int, Map]) -> int:
        """Merge the maps of the other members of a network into the own map.

        Args:
            maps: by robot, int8 [H, W] each.

        Returns:
            Number of cells that were new.
        """
        before = self.known
        for robot, grid in maps.items():
            self.map = np.where(self.map == UNKNOWN, grid, self.map)
            self.unshared[robot] = self.steps_since_merge[robot] = 0
        return self.known - before

    @property
    def known(self) -> int:
        """Number of known cells."""
        return int((self.map != UNKNOWN).sum())


def union(maps: Iterable[Map]) -> Map:
    """The union of several maps; if they contradict each other, the first counts."""
    maps = iter(maps)
    total = next(maps)
    for grid in maps:
        total = np.where(total == UNKNOWN, grid, total)
    return total

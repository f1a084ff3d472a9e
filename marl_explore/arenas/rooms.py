"""Rooms with doors, by binary space partition."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from marl_explore.arenas.generator import ArenaGenerator, Board, Draw, one_by_one

SMALLEST = 5  # smallest side of a room; rooms have sides of 5 to 10 cells
DOOR = 2  # cells, so that two robots can pass
DOOR_EVERY = 12  # cells of a wall per door, so that long walls have several, which makes loops


@dataclass(frozen=True)
class Rooms(ArenaGenerator):
    """Rectangular rooms: walls split the arena recursively, each with at least one door."""

    def obstacles(self, keys: Tensor) -> Tensor:
        """Obstacles bool [A, H, W], free cells connected."""
        return one_by_one(self._board, keys, count=self.config.num_cells)

    def _board(self, draw: Draw) -> Board:
        board = np.zeros((self.config.height, self.config.width), bool)
        # each wall is a row of its view of the board: the board itself or its transpose
        walls = _build_walls(board, draw)
        for view, row, columns in walls:
            _open_doors(view, row, columns, draw)
        return board


def _build_walls(board: Board, draw: Draw) -> list[tuple[Board, int, slice]]:
    """Split the board into rooms; returns views, rows and columns of the walls."""
    walls = []
    regions = [(board, 0, 0, *board.shape)]
    while regions:
        view, top, left, height, width = regions.pop()
        if width > height or (width == height and draw() % 2):
            view, top, left, height, width = view.T, left, top, width, height
        if height <= 2 * SMALLEST or width < DOOR:
            continue
        above = SMALLEST + draw() % (height - 2 * SMALLEST)
        row, columns = top + above, slice(left, left + width)
        view[row, columns] = True
        walls.append((view, row, columns))
        regions.append((view, top, left, above, width))
        regions.append((view, row + 1, left, height - above - 1, width))
    return walls


def _open_doors(view: Board, row: int, columns: slice, draw: Draw) -> None:
    """Open doors where there is no other wall on either side."""
    wall = view[row, columns]
    clear = ~(view[row - 1, columns] | view[row + 1, columns])
    # never empty: the first SMALLEST cells of a wall have rooms on both sides
    places = np.flatnonzero(clear[1:] & clear[:-1])
    for _ in range(1 + len(wall) // DOOR_EVERY):
        place = places[draw() % len(places)]
        wall[place : place + DOOR] = False

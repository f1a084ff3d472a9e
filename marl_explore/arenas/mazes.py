"""Mazes by depth-first search, with loops."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import numpy as np
from torch import Tensor

from marl_explore.arenas.generator import ArenaGenerator, Board, Draw, one_by_one

PASSAGE = 2  # width of passages (cells), so that two robots can pass
LOOP_ONE_IN = 8  # one in so many remaining walls is opened; without loops a maze is a tree
_ORDERS = list(permutations(((-1, 0), (0, 1), (1, 0), (0, -1))))


@dataclass(frozen=True)
class Mazes(ArenaGenerator):
    """Winding passages, two cells wide, between walls of one cell, with a few loops."""

    def obstacles(self, keys: Tensor) -> Tensor:
        """Obstacles bool [A, H, W], free cells connected."""
        return one_by_one(self._board, keys, count=self.config.num_cells)

    def _board(self, draw: Draw) -> Board:
        rows, columns = (_widths(size) for size in (self.config.height, self.config.width))
        lattice = _open_loops(_lattice(len(rows), len(columns), draw), draw)
        return lattice.repeat(rows, axis=0).repeat(columns, axis=1)


def _widths(size: int) -> list[int]:
    """Widths of alternating passages and walls; the last passage takes the remainder."""
    ways = max(1, (size + 1) // (PASSAGE + 1))
    widths = [PASSAGE, 1] * ways
    return [*widths[:-2], size - sum(widths[:-2])]


def _lattice(rows: int, columns: int, draw: Draw) -> Board:
    """A maze without loops, with odd sides: cells at even indices, walls between them."""
    closed = np.ones((rows, columns), bool)
    path = [(2 * (draw() % (rows // 2 + 1)), 2 * (draw() % (columns // 2 + 1)))]
    closed[path[0]] = False
    while path:
        row, column = path[-1]
        for down, right in _ORDERS[draw() % len(_ORDERS)]:
            to = row + 2 * down, column + 2 * right
            if 0 <= to[0] < rows and 0 <= to[1] < columns and closed[to]:
                closed[row + down, column + right] = closed[to] = False
                path.append(to)
                break
        else:
            path.pop()
    return closed


def _open_loops(closed: Board, draw: Draw) -> Board:
    """Open some of the walls between two cells."""
    for start in ((0, 1), (1, 0)):
        walls = closed[start[0] :: 2, start[1] :: 2]
        for place in np.argwhere(walls):
            walls[tuple(place)] = draw() % LOOP_ONE_IN != 0
    return closed

"""Room for others: where a robot that has nothing left to explore does not stand in the way."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from marl_explore.config.constants import COMPASS, FREE, NUM_DIRECTIONS, OCCUPIED, STAY
from marl_explore.robot.geometry import GridCell
from marl_explore.robot.observation import Observation
from marl_explore.robot.paths import paths_to
from marl_explore.robot.wavefront import Mask

_AROUND = np.array(COMPASS)


def is_only_way(grid: NDArray[np.int8], cell: GridCell) -> bool:
    """Whether a cell is the only way between cells around it.

    Its free neighbours then fall apart into several groups, between which no move of a robot leads
    that does not use the cell.

    Args:
        grid: a map, int8 [H, W].
        cell: a free cell of it.
    """
    padded = np.pad(grid, 1, constant_values=OCCUPIED)
    rows, columns = (_AROUND + cell + 1).T
    free = (padded[rows, columns] == FREE).tolist()
    beside = [number for number in range(0, NUM_DIRECTIONS, 2) if free[number]]
    # robots drive diagonals past a free corner: the one between two cells beside joins them
    joined = sum(free[number + 1] and free[(number + 2) % NUM_DIRECTIONS] for number in beside)
    return len(beside) - joined > 1


def step_aside(grid: NDArray[np.int8], cell: GridCell, held: Collection[GridCell]) -> int:
    """The first move to the nearest cell that is nobody's only way, or STAY if there is none.

    Args:
        grid: a map, int8 [H, W].
        cell: where the robot is.
        held: cells of other robots.
    """
    if not is_only_way(grid, cell):
        return STAY
    around = grid.copy()
    for place in held:
        around[place] = OCCUPIED
    free = around == FREE
    moves, lengths = paths_to(around, free, cell)
    order = np.argsort(lengths, kind="stable")
    places = np.argwhere(free)[order]
    for place, move, length in zip(places.tolist(), moves[order], lengths[order], strict=True):
        if length and not is_only_way(grid, tuple(place)):
            return int(move)
    return STAY


def is_crowded(observed: Observation) -> bool:
    """``core.ways.crowded`` of one robot: whether something beside it may wait for it.

    That is a cell that is not seen free and closed to it, although its own map has the way there
    open, and that holds no robot to which it is linked.
    """
    around = np.pad(observed.map, 1, constant_values=OCCUPIED)
    rows, columns = (_AROUND + observed.position + 1).T
    values = around[rows, columns]
    middle = len(observed.fov) // 2
    rows, columns = (_AROUND + middle).T
    seen_free = observed.fov[rows, columns] == 0
    closed = (values == FREE) & ~seen_free & ~observed.action_mask[:NUM_DIRECTIONS]
    beside = values[::2] == OCCUPIED
    closed[1::2] &= ~(beside & np.roll(beside, -1))  # between two obstacles
    cells = {tuple(cell) for cell in (_AROUND[closed] + observed.position).tolist()}
    return not cells <= set(observed.mates.values())


def roomy(grid: NDArray[np.int8]) -> Mask:
    """``core.ways.roomy``: cells of a square of two by two free cells, bool [H, W]."""
    free = grid == FREE
    rows = free[:-1] & free[1:]
    square = np.pad(rows[:, :-1] & rows[:, 1:], 1)
    columns = square[:, :-1] | square[:, 1:]
    return columns[:-1] | columns[1:]


def make_room(observed: Observation) -> int:
    """The first move to the nearest roomy cell; STAY in one, and if the robot can reach none."""
    cells = roomy(observed.map)
    if cells[observed.position]:
        return STAY
    moves, lengths = paths_to(observed.map, cells, observed.position)
    order = (lengths * NUM_DIRECTIONS + moves)[lengths > 0]
    return int(order.min() % NUM_DIRECTIONS) if len(order) else STAY


class Room:
    """Keeps in mind that a robot was crowded until it has made room."""

    def __init__(self) -> None:
        self._crowded = False
        self._cell: GridCell | None = None

    def is_wanted(self, observed: Observation) -> bool:
        """``core.ways.has_to_make_room`` of one robot; to be asked once per step."""
        waits = self._crowded and observed.step > 0
        if waits:
            cells = roomy(observed.map)
            waits = not (cells[observed.position] if cells.any() else self._has_moved(observed))
        self._crowded, self._cell = waits or is_crowded(observed), observed.position
        return self._crowded

    def _has_moved(self, observed: Observation) -> bool:
        return observed.position != self._cell

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
    blocked, shut = blocked_beside(observed)
    closed = blocked & ~shut & ~observed.action_mask[:NUM_DIRECTIONS]
    cells = {tuple(cell) for cell in (_AROUND[closed] + observed.position).tolist()}
    return not cells <= set(observed.mates.values())


def blocked_beside(observed: Observation) -> tuple[Mask, Mask]:
    """``core.ways.blocked_beside`` of one robot, two of bool [8]."""
    around = np.pad(observed.map, 1, constant_values=OCCUPIED)
    rows, columns = (_AROUND + observed.position + 1).T
    values = around[rows, columns]
    rows, columns = (_AROUND + len(observed.fov) // 2).T
    wall, shut = values[::2] == OCCUPIED, np.zeros(NUM_DIRECTIONS, np.bool_)
    shut[1::2] = wall & np.roll(wall, -1)
    return (values == FREE) & (observed.fov[rows, columns] > 0), shut


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
            cells, cell = roomy(observed.map), observed.position
            waits = not (cells[cell] if cells.any() else cell != self._cell)
        self._crowded, self._cell = waits or is_crowded(observed), observed.position
        return self._crowded

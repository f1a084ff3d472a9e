"""Shortest 8-connected paths on one map, by propagating label sets: ``core.wavefront`` in numpy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from marl_explore.config.constants import COMPASS, FREE, OCCUPIED
from marl_explore.robot.geometry import GridCell

Labels = NDArray[np.uint8]
Lengths = NDArray[np.int64]
Mask = NDArray[np.bool_]


def first_moves(
    grid: NDArray[np.int8], position: GridCell, closed: Mask | None = None
) -> tuple[Labels, Lengths]:
    """``core.frontier.first_moves`` of one map.

    Args:
        grid: int8 [H, W].
        position: the robot's cell, which need not be known.
        closed: cells that paths may not enter, bool [H, W]; they close no diagonals.

    Returns:
        Sets of directions uint8 (bit d for direction d) and lengths (cells), [H, W] each; both 0 in
        the robot's own cell and in unreachable cells.
    """
    passable = np.pad(grid != OCCUPIED, 1)
    fresh = np.pad(grid == FREE if closed is None else (grid == FREE) & ~closed, 1)
    front = np.zeros(passable.shape, np.uint8)
    row, column = position[0] + 1, position[1] + 1
    fresh[row, column] = False
    for direction, (up, side) in enumerate(COMPASS):
        if passable[row + up, column] | passable[row, column + side]:
            front[row + up, column + side] = 1 << direction
    labels, length = _flood(front, fresh, passable)
    return labels[1:-1, 1:-1], length[1:-1, 1:-1]


def lengths_from(grid: NDArray[np.int8], starts: NDArray[np.integer]) -> Lengths:
    """Lengths of the shortest paths from cells to every known free cell (cells).

    Args:
        grid: int8 [H, W].
        starts: cells [S, 2], which need not be free.

    Returns:
        int64 [S, H, W]; the number of cells where there is no path.
    """
    passable, free = np.pad(grid != OCCUPIED, 1), np.pad(grid == FREE, 1)
    begin = np.zeros((len(starts), *passable.shape), bool)
    begin[np.arange(len(starts)), starts[:, 0] + 1, starts[:, 1] + 1] = True
    front = _spread(begin.view(np.uint8), passable | begin)
    labels, length = _flood(front, free & ~begin, passable)
    length = np.where(labels != 0, length, grid.size)
    length[begin] = 0
    return length[:, 1:-1, 1:-1]


def beside_any(cells: Mask) -> Mask:
    """Cells with a 4-neighbour in a set, bool [H, W] like the set."""
    padded = np.pad(cells, 1)
    beside: Mask = padded[:-2, 1:-1] | padded[2:, 1:-1] | padded[1:-1, :-2] | padded[1:-1, 2:]
    return beside


def _flood(front: Labels, fresh: Mask, passable: Mask) -> tuple[Labels, Lengths]:
    """Labels and lengths where labels at distance 1 spread to, [*B, H+2, W+2]; 0 elsewhere."""
    fresh, labels = fresh.copy(), np.zeros_like(front)
    length, level = np.zeros(front.shape, np.int64), 0
    while (front := front * fresh).any():
        level += 1
        labels |= front
        reached = front != 0
        length[reached] = level
        fresh &= ~reached
        front = _spread(front, passable)
    return labels, length


def _spread(front: Labels, passable: Mask) -> Labels:
    """Every cell with the labels of its eight neighbours, diagonals past a passable cell."""
    sideways = front.copy()
    sideways[..., 1:-1] |= front[..., :-2] | front[..., 2:]
    sideways *= passable
    upright = np.zeros_like(front)
    upright[..., 1:-1, :] = front[..., :-2, :] | front[..., 2:, :]
    upright *= passable
    spread = sideways.copy()
    spread[..., 1:-1, :] |= sideways[..., :-2, :] | sideways[..., 2:, :]
    spread[..., 1:-1] |= upright[..., :-2] | upright[..., 2:]
    return spread

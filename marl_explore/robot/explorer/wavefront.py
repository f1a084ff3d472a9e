"""Shortest ways over free cells, by a wave from a start; lengths are counted in half cells.

A straight step is 2 half cells and a diagonal 3, so lengths are at most 6 % off.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from marl_explore.robot.explorer.grids import Mask
from marl_explore.robot.geometry import GridCell

Lengths = NDArray[np.int32]
NO_WAY = -1


def ways(free: Mask, start: GridCell, most: int = 2**31 - 1) -> Lengths:
    """Lengths of the shortest ways from a start to every cell, int32 [H, W]; NO_WAY without one.

    Args:
        free: cells that can be passed, bool [H, W]; the start need not be.
        start: (row, column).
        most: longer ways are not looked for (half cells).
    """
    height, width = free.shape
    stride = width + 2
    fresh = np.pad(free, 1).ravel()
    lengths = np.full(fresh.size, NO_WAY, np.int32)
    cell = (start[0] + 1) * stride + start[1] + 1
    fresh[cell], lengths[cell] = False, 0
    straight = np.array([-stride, stride, -1, 1])
    diagonal = np.array([-stride - 1, -stride + 1, stride - 1, stride + 1])
    nothing = np.empty(0, np.int64)
    waves = [nothing, nothing, np.array([cell])]
    """Cells reached three, two and one half cells before the next."""
    level = 0
    while level < most and any(len(wave) for wave in waves):
        level += 1
        new = np.concatenate(
            ((waves[1][:, None] + straight).ravel(), (waves[0][:, None] + diagonal).ravel())
        )
        new = np.unique(new[fresh[new]])
        fresh[new], lengths[new] = False, level
        waves = [*waves[1:], new]
    return lengths.reshape(height + 2, stride)[1:-1, 1:-1]


def path(lengths: Lengths, goal: GridCell) -> list[GridCell]:
    """The cells of a shortest way from the start of ``ways`` to a cell, both included.

    Args:
        lengths: from ``ways``.
        goal: a cell that it reached.
    """
    cells, (height, width) = [goal], lengths.shape
    while (length := lengths[cells[-1]]) > 0:
        row, column = cells[-1]
        for up, side, step in _STEPS:
            before = row + up, column + side
            inside = 0 <= before[0] < height and 0 <= before[1] < width
            if inside and lengths[before] == length - step:
                cells.append(before)
                break
    return cells[::-1]


_STEPS = (
    *((up, side, 2) for up, side in ((-1, 0), (1, 0), (0, -1), (0, 1))),
    *((up, side, 3) for up in (-1, 1) for side in (-1, 1)),
)

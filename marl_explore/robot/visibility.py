"""What a robot's sensor covers, and what walls hide from it: ``core.sight`` in numpy."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from marl_explore.config.constants import FREE
from marl_explore.config.shapes import Ring, Sight, half_widths, rings
from marl_explore.core import native
from marl_explore.robot.evidence import Map
from marl_explore.robot.geometry import GridCell

Mask = NDArray[np.bool_]


@lru_cache
def shape_mask(sight: Sight) -> Mask:
    """Cells of one robot's shape in its window, bool [2k + 1, 2k + 1]."""
    (reach,) = sight.ranges_cells
    steps = np.abs(np.arange(-sight.radius, sight.radius + 1))
    mask: Mask = steps <= np.array(half_widths(sight.shape, reach))[steps, None]
    return mask


def line_of_sight(wall: Mask) -> Mask:
    """``core.sight.line_of_sight`` of one window, with the native kernel or else with numpy.

    Args:
        wall: bool [2k + 1, 2k + 1], contiguous.
    """
    return plain_line_of_sight(wall) if native.missing("sight") else native_line_of_sight(wall)


def native_line_of_sight(wall: Mask) -> Mask:
    """``line_of_sight`` from the C kernel."""
    seen, side = np.empty_like(wall), len(wall)
    failed = native.kernel("sight")(wall.ctypes.data, 1, side, seen.ctypes.data)
    native.check(failed, side, side)
    return seen


def plain_line_of_sight(wall: Mask) -> Mask:
    """``line_of_sight`` from numpy."""
    flat, seen = wall.ravel(), np.zeros(wall.size, bool)
    seen[wall.size // 2] = True
    for ring in _rings(len(wall) // 2):
        passes = seen[ring.parent] & ~flat[ring.parent] & ~flat[ring.side].all(-1)
        seen[ring.cell] = passes.any(-1)
    return seen.reshape(wall.shape)


@lru_cache
def _rings(radius: int) -> list[Ring]:
    return rings(radius)


def surely_seen(grid: Map, cell: GridCell, sight: Sight) -> tuple[tuple[slice, slice], Mask]:
    """``core.memory.surely_seen`` of one teammate: a part of the map, and what it sees of that.

    Args:
        grid: the map of the robot that asks, int8 [H, W].
        cell: where the teammate is, inside the map.
        sight: of the teammate alone.
    """
    radius, (row, column) = sight.radius, cell
    top, left = max(row - radius, 0), max(column - radius, 0)
    part = np.s_[top : row + radius + 1, left : column + radius + 1]
    known = grid[part]
    up, side = top - row + radius, left - column + radius
    inside = np.s_[up : up + known.shape[0], side : side + known.shape[1]]
    seen = shape_mask(sight)
    if sight.line_of_sight:
        wall = np.zeros_like(seen)
        wall[inside] = known != FREE
        wall[radius, radius] = False  # the teammate stands there
        seen = seen & line_of_sight(wall)
    return part, seen[inside]

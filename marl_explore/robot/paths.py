"""Shortest paths to listed cells, with the native kernel if it was built, else with numpy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from marl_explore.core import native
from marl_explore.robot.wavefront import Mask, first_moves

Integers = NDArray[np.int64]
_LOWEST_BIT = np.array([(byte & -byte).bit_length() - 1 if byte else 0 for byte in range(256)])


def paths_to(grid: NDArray[np.int8], cells: Mask, start: tuple[int, int]) -> tuple[Integers, ...]:
    """First moves and lengths of the shortest paths from a cell to others of a map.

    As ``core.frontier.paths_to``: of several shortest paths, the one whose first direction is
    lowest counts.

    Args:
        grid: int8 [H, W].
        cells: those to which paths lead, bool [H, W], of F cells.
        start: the cell that they start from, which need not be known.

    Returns:
        Directions and lengths (cells), int64 [F] each, in the order of rows and columns; both 0 in
        the start and for cells without a path.

    Raises:
        ValueError: for a start outside the map.
    """
    by = plain_paths_to if native.missing("paths") else native_paths_to
    return by(grid, cells, start)


def native_paths_to(
    grid: NDArray[np.int8], cells: Mask, start: tuple[int, int]
) -> tuple[Integers, ...]:
    """``paths_to`` from the C kernel."""
    height, width = grid.shape
    listed = np.flatnonzero(cells).astype(np.int64)
    places = np.array([0, start[0] * width + start[1]], np.int64)
    if not 0 <= start[1] < width:
        places[1] = -1
    found = np.empty((2, len(listed)), np.int64)
    arrays = (np.ascontiguousarray(grid), listed, places[:1], places[1:], *found)
    addresses = [array.ctypes.data for array in arrays]
    queries = native.PathQueries(*addresses, 1, height, width, len(listed))
    native.check(native.kernel("paths")(queries, 0, 1), height, width)
    return found[0], found[1]


def plain_paths_to(
    grid: NDArray[np.int8], cells: Mask, start: tuple[int, int]
) -> tuple[Integers, ...]:
    """``paths_to`` from numpy."""
    height, width = grid.shape
    if not (0 <= start[0] < height and 0 <= start[1] < width):
        raise ValueError(f"a position is outside its map of {height} x {width} cells")
    labels, length = first_moves(grid, start)
    return _LOWEST_BIT[labels[cells]], length[cells]

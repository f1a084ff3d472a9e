"""FPR of one robot's map: with the native kernel if it was built, else with numpy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from marl_explore.config.constants import (
    COMPASS,
    FREE,
    NORMALIZATIONS,
    NUM_DIRECTIONS,
    NUM_FEATURES,
    OCCUPIED,
    UNKNOWN,
    Normalization,
)
from marl_explore.core import native
from marl_explore.robot.geometry import GridCell

Table = NDArray[np.float32]
_BITS = NDArray[np.uint8]


def feature_table(
    grid: NDArray[np.int8], position: GridCell, normalize: Normalization | None = "relative"
) -> Table:
    """``core.frontier.feature_table`` of one map, bit-identical.

    Args:
        grid: int8 [H, W].
        position: the robot's cell.
        normalize: "relative", "proximity", "absolute" or None.

    Returns:
        float32 [8, 3].

    Raises:
        ValueError: for an unknown normalisation, or a position outside the map.
    """
    if normalize not in NORMALIZATIONS:
        raise ValueError(f"normalize={normalize!r} is not one of {NORMALIZATIONS}")
    by = plain_table if native.missing() else native_table
    return by(grid, position, normalize)


def native_table(
    grid: NDArray[np.int8], position: GridCell, normalize: Normalization | None
) -> Table:
    """The table from the C kernel."""
    grid = np.ascontiguousarray(grid, np.int8)
    height, width = grid.shape
    cell = np.array(position, np.int64)
    table = np.empty((NUM_DIRECTIONS, NUM_FEATURES), np.float32)
    failed = native.kernel()(
        grid.ctypes.data,
        cell.ctypes.data,
        1,
        height,
        width,
        native.MODES[normalize],
        True,
        table.ctypes.data,
    )
    native.check(failed, height, width)
    return table


def plain_table(
    grid: NDArray[np.int8], position: GridCell, normalize: Normalization | None
) -> Table:
    """The table from numpy."""
    height, width = grid.shape
    if not (0 <= position[0] < height and 0 <= position[1] < width):
        raise ValueError(f"a position is outside its map of {height} x {width} cells")
    padded = np.pad(grid, 1, constant_values=OCCUPIED)
    unknown = np.pad(grid == UNKNOWN, 1)
    beside = unknown[:-2, 1:-1] | unknown[2:, 1:-1] | unknown[1:-1, :-2] | unknown[1:-1, 2:]
    labels, distance = _search(padded, (position[0] + 1, position[1] + 1))
    found = (labels != 0) & np.pad(beside, 1)
    first = labels[found] & -labels[found].astype(np.int16)  # the lowest direction's bit
    direction = np.log2(first).astype(np.int64)
    length = distance[found].astype(np.float64)
    powers = np.stack((np.ones_like(length), length, length * length), -1)
    sums = np.zeros((NUM_DIRECTIONS, len(powers.T)))
    np.add.at(sums, direction, powers)
    return _normalized(sums, length.max(initial=0), normalize, height, width)


def _search(padded: NDArray[np.int8], start: GridCell) -> tuple[_BITS, NDArray[np.int64]]:
    """Bits of the first moves of the shortest paths to every cell, and their lengths."""
    passable, fresh = padded != OCCUPIED, padded == FREE
    front = np.zeros(padded.shape, np.uint8)
    row, column = start
    fresh[row, column] = False
    for direction, (up, side) in enumerate(COMPASS):
        if passable[row + up, column] | passable[row, column + side]:
            front[row + up, column + side] = 1 << direction
    labels, distance = np.zeros_like(front), np.zeros(padded.shape, np.int64)
    level = 0
    while (front := front * fresh).any():
        level += 1
        labels |= front
        distance[front != 0] = level
        fresh &= front == 0
        front = _spread(front, passable)
    return labels, distance


def _spread(front: _BITS, passable: NDArray[np.bool_]) -> _BITS:
    """Every cell with the bits of its eight neighbours, diagonals past a passable cell."""
    sideways = front.copy()
    sideways[:, 1:-1] |= front[:, :-2] | front[:, 2:]
    sideways *= passable
    upright = np.zeros_like(front)
    upright[1:-1] = front[:-2] | front[2:]
    upright *= passable
    spread = sideways.copy()
    spread[1:-1] |= sideways[:-2] | sideways[2:]
    spread[:, 1:-1] |= upright[:, :-2] | upright[:, 2:]
    return spread


def _normalized(
    sums: NDArray[np.float64],
    longest: float,
    normalize: Normalization | None,
    height: int,
    width: int,
) -> Table:
    count, total, squares = sums.T
    some = np.maximum(count, 1)
    mean = total / some
    deviation = np.sqrt(count * squares - total * total) / some
    if normalize == "absolute":
        count = count / (height * width)
        mean, deviation = mean / (height + width), deviation / (height + width)
    elif normalize is not None:
        count = count / max(count.sum(), 1)
        deviation = deviation / max(longest, 1)
        if normalize == "relative":
            mean = mean / max(longest, 1)
        else:
            nearest = mean[mean > 0].min(initial=np.inf)
            mean = np.divide(nearest, mean, out=np.zeros_like(mean), where=mean > 0)
    return np.stack((count, mean, deviation), -1).astype(np.float32)

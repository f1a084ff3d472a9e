"""FPR of one robot's map: with the native kernel if it was built, else with numpy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from marl_explore.config.constants import (
    NORMALIZATIONS,
    NUM_DIRECTIONS,
    NUM_FEATURES,
    UNKNOWN,
    Normalization,
)
from marl_explore.core import native
from marl_explore.robot.geometry import GridCell
from marl_explore.robot.wavefront import beside_any, first_moves

Table = NDArray[np.float32]


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
    labels, distance = first_moves(grid, position)
    found = (labels != 0) & beside_any(grid == UNKNOWN)
    first = labels[found] & -labels[found].astype(np.int16)  # the lowest direction's bit
    direction = np.log2(first).astype(np.int64)
    length = distance[found].astype(np.float64)
    powers = np.stack((np.ones_like(length), length, length * length), -1)
    sums = np.zeros((NUM_DIRECTIONS, len(powers.T)))
    np.add.at(sums, direction, powers)
    return _normalized(sums, length.max(initial=0), normalize, height, width)


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

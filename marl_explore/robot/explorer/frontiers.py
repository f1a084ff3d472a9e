"""Frontiers: unknown cells beside free ones that can be reached, in clusters, with goals."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_explore.config.constants import UNKNOWN
from marl_explore.robot.explorer.grids import CoarseGrid, Mask
from marl_explore.robot.explorer.wavefront import NO_WAY, Lengths
from marl_explore.robot.geometry import GridCell

Cluster = list[GridCell]
"""Unknown cells that touch each other, also at corners."""


class Candidate(NamedTuple):
    """A place from which a robot can look behind a frontier."""

    cell: GridCell
    """A free cell beside the frontier."""
    faces: GridCell
    """The unknown cell beside it."""
    way: float
    """Length of the way there (metres)."""
    gain: float
    """Share of unknown cells around it."""


def border(codes: NDArray[np.int8], free: Mask) -> Mask:
    """Unknown cells beside some of the free ones; the grid's border must be unknown."""
    beside = np.zeros_like(free)
    beside[1:] |= free[:-1]
    beside[:-1] |= free[1:]
    beside[:, 1:] |= free[:, :-1]
    beside[:, :-1] |= free[:, 1:]
    return beside & (codes == UNKNOWN)


def clusters(cells: Mask) -> list[Cluster]:
    """The cells in clusters, each in the order in which it is found."""
    left = set(zip(*(index.tolist() for index in cells.nonzero()), strict=True))
    found = []
    for seed in sorted(left):
        if seed not in left:
            continue
        left.remove(seed)
        cluster = [seed]
        for row, column in cluster:  # it grows meanwhile
            around = {(row + up, column + side) for up in (-1, 0, 1) for side in (-1, 0, 1)} & left
            left -= around
            cluster += sorted(around)
        found.append(cluster)
    return found


def long_clusters(cells: Mask, side: float, least: float) -> tuple[list[Cluster], int]:
    """The clusters of at least ``least`` metres, and the number of the others."""
    found = clusters(cells)
    long = [cluster for cluster in found if len(cluster) * side >= least - 1e-9]
    return long, len(found) - len(long)


def cells_of(found: Iterable[Cluster], shape: tuple[int, ...]) -> Mask:
    """The cells of clusters, bool [H, W]."""
    cells = np.zeros(shape, bool)
    for cluster in found:
        cells[tuple(np.array(cluster).T)] = True
    return cells


def candidates(
    grid: CoarseGrid, lengths: Lengths, found: Sequence[Cluster], spread: float, view: float
) -> list[Candidate]:
    """Goals for every cluster, the nearest first, and others at least ``spread`` metres apart.

    Args:
        grid: the map, with a border of unknown cells.
        lengths: of ways from the robot.
        found: clusters of unknown cells beside reached ones.
        spread: metres.
        view: how far around a goal unknown cells are counted (metres).
    """
    if not found:
        return []
    gains = _shares(grid.codes == UNKNOWN, round(view / grid.side))
    chosen = []
    for cluster in found:
        stands = sorted(_stands(lengths, cluster))
        cells = np.array([cell for _, cell, _ in stands])
        left = np.ones(len(stands), bool)
        while left.any():
            first = int(left.argmax())
            length, cell, faces = stands[first]
            left[first] = False
            left &= np.hypot(*(cells - cell).T) * grid.side >= spread
            way, gain = length * grid.side / 2, float(gains[cell])
            chosen.append(Candidate(cell, faces, way, gain))
    return chosen


def _stands(lengths: Lengths, cluster: Cluster) -> list[tuple[int, GridCell, GridCell]]:
    """For each unknown cell the nearest reached cell beside it: length, that cell, itself."""
    stands = []
    height, width = lengths.shape
    for row, column in cluster:
        beside = ((row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1))
        inside = [c for c in beside if 0 <= c[0] < height and 0 <= c[1] < width]
        reached = [(int(lengths[c]), c, (row, column)) for c in inside if lengths[c] != NO_WAY]
        stands.append(min(reached))
    return stands


def _shares(cells: Mask, reach: int) -> NDArray[np.floating]:
    """Share of some cells in the square around every cell; cells outside count, too."""
    padded = np.pad(cells, ((reach + 1, reach), (reach + 1, reach)), constant_values=True)
    sums = padded.cumsum(0, np.int32).cumsum(1, np.int32)
    side = 2 * reach + 1
    rows = sums[side:] - sums[:-side]
    return (rows[:, side:] - rows[:, :-side]) / side**2

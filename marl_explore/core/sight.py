"""Sight: which cells around a place belong to a sensor's shape, and which of them walls hide.

Windows are squares of side 2k + 1 around a robot, row 0 north; offsets are (row, column).
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from marl_explore.config.arena import TOLERANCE
from marl_explore.core.grid import COMPASS

Shape = Literal["square", "disc"]
"""square: the largest one inside the sensing disc (the paper's); disc: every cell in range."""


def shape_radius(shape: Shape, range_cells: float) -> int:
    """k of the smallest window that holds the shape of a sensor with this range (cells)."""
    if shape == "square":
        return math.floor(range_cells / math.sqrt(2) - 0.5 + TOLERANCE)
    return math.floor(range_cells + TOLERANCE)


@lru_cache
def shape_mask(shape: Shape, range_cells: float, radius: int, device: torch.device) -> Tensor:
    """Cells of a sensor's shape in a window of the same or a larger radius, bool [2k+1, 2k+1]."""
    steps = torch.arange(-radius, radius + 1, device=device)
    if shape == "square":
        inside = steps.abs() <= shape_radius(shape, range_cells)
        return inside & inside.unsqueeze(-1)
    squares = steps * steps
    limit = math.floor((range_cells + TOLERANCE) ** 2)
    return squares + squares.unsqueeze(-1) <= limit


def most_discovered(shape: Shape, range_cells: float) -> int:
    """The most cells of a shape that one move brings in; of a square 4k + 1."""
    radius = shape_radius(shape, range_cells) + 1
    here = shape_mask(shape, range_cells, radius, torch.device("cpu"))
    moved = (here.roll(move, (0, 1)) for move in COMPASS)  # the rim of the window is empty
    return max(int((there & ~here).sum()) for there in moved)


class _Ring(NamedTuple):
    """The cells at one distance from the centre, as indices of a flattened window."""

    cell: Tensor
    """int64 [C], C = 8 m."""
    parent: Tensor
    """The cells through which each is seen, int64 [C, 2]; twice the same if there is one."""
    side: Tensor
    """The cells beside a diagonal step from each parent, int64 [C, 2, 2]; of a straight step the
    parent itself, which is no obstacle if the cell is seen through it."""


@lru_cache
def _rings(radius: int, device: torch.device) -> list[_Ring]:
    """The rings of a window, from the inside out."""
    return [_ring(m, radius, device) for m in range(1, radius + 1)]


def _ring(m: int, radius: int, device: torch.device) -> _Ring:
    side = 2 * radius + 1
    offsets = [
        (r, c) for r in range(-m, m + 1) for c in range(-m, m + 1) if max(abs(r), abs(c)) == m
    ]

    def index(r: int, c: int) -> int:
        return (r + radius) * side + c + radius

    parents, sides = [], []
    for r, c in offsets:
        # only the shorter coordinate can lie halfway between two cells
        rows, columns = (_nearest(part * (m - 1), m) for part in (r, c))
        pair = [(row, column) for row in rows for column in columns]
        pair = [pair[0], pair[-1]]
        parents.append([index(*parent) for parent in pair])
        sides.append([[index(row, c), index(r, column)] for row, column in pair])
    every = (torch.tensor(x, device=device) for x in ([index(*o) for o in offsets], parents, sides))
    return _Ring(*every)


def _nearest(numerator: int, denominator: int) -> tuple[int, ...]:
    """The integer nearest to a fraction, or both if it lies halfway between two."""
    below, rest = divmod(numerator, denominator)
    if 2 * rest == denominator:
        return below, below + 1
    return (below + (2 * rest > denominator),)


def line_of_sight(wall: Tensor) -> Tensor:
    """Cells of windows that are seen from the centre, bool [*B, 2k + 1, 2k + 1].

    From the inside out, a cell is seen if one of the one or two cells through which the straight
    line to it passes just before is seen and is no obstacle, and the step from there does not pass
    between two obstacles. So obstacles are seen, and what lies behind them is not.

    Args:
        wall: obstacles of each window, bool [*B, 2k + 1, 2k + 1]; no obstacle outside an arena.
    """
    side = wall.shape[-1]
    wall = wall.flatten(-2)
    seen = torch.zeros_like(wall)
    seen[..., side * side // 2] = True
    for ring in _rings(side // 2, wall.device):
        parent = ring.parent.flatten()
        passes = seen.index_select(-1, parent) & ~wall.index_select(-1, parent)
        beside = wall.index_select(-1, ring.side.flatten()).unflatten(-1, (-1, 2))
        passes &= ~(beside[..., 0] & beside[..., 1])
        seen[..., ring.cell] = passes.unflatten(-1, (-1, 2)).any(-1)
    return seen.unflatten(-1, (side, side))

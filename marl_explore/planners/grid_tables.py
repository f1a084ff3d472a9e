"""Lookup tables for planning: of a grid and a field of view, and of what walls leave in sight."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from marl_explore.config.shapes import Sight
from marl_explore.core.grid import COMPASS, flat_cell, square_steps
from marl_explore.core.hashing import combine
from marl_explore.core.sensing import cells_seen_from
from marl_explore.core.sight import line_of_sight, shapes

_CODES = 2**32
"""Sums of hashes below this are exact in float64 for every field of view."""


class GridTables(NamedTuple):
    """Tables of a grid of C = H W cells; cells outside are replaced by the own cell."""

    near: Tensor
    """Target cells of the eight moves and of staying, int64 [C, 9]."""
    inside: Tensor
    """Whether they are on the grid, bool [C, 9]."""
    seen: Tensor
    """Cells in view, int64 [C, (2k + 1)^2]."""
    window: Tensor
    """Whether they are on the grid, bool [C, (2k + 1)^2]."""
    around: Tensor
    """Cells in view after some move, int64 [C, (2k + 3)^2]."""
    views: Tensor
    """1 where a move brings one of these cells into view, float64 [(2k + 3)^2, 9]."""
    place: Tensor
    """Numbers whose sums identify the midpoints between two cells, int64 [C]."""


@lru_cache(maxsize=8)
def grid_tables(height: int, width: int, radius: int, device: torch.device) -> GridTables:
    """The tables of a grid and a field of view."""
    row, column = torch.meshgrid(
        torch.arange(height, device=device), torch.arange(width, device=device), indexing="ij"
    )
    cells = torch.stack((row, column), -1).flatten(0, 1)
    moves = torch.tensor((*COMPASS, (0, 0)), device=device)
    place = cells.unsqueeze(1) + moves
    inside = ((place >= 0) & (place < torch.tensor((height, width), device=device))).all(-1)
    own = torch.arange(len(cells), device=device).unsqueeze(-1)
    side = 2 * radius + 3
    middle = flat_cell(moves + radius + 1, side).unsqueeze(-1)
    in_view = middle + square_steps(radius, side, device)
    views = torch.zeros(len(moves), side * side, dtype=torch.float64, device=device)
    return GridTables(
        near=torch.where(inside, flat_cell(place, width), own),
        inside=inside,
        seen=cells_seen_from(height, width, radius, device),
        window=_in_windows(cells, height, width, radius),
        around=cells_seen_from(height, width, radius + 1, device),
        views=views.scatter_(1, in_view, 1).T.contiguous(),
        place=flat_cell(cells, 2 * width),
    )


def _in_windows(cells: Tensor, height: int, width: int, radius: int) -> Tensor:
    """``GridTables.window``, of cells int64 [C, 2]."""
    steps = torch.arange(-radius, radius + 1, device=cells.device)
    row, column = cells[:, :1] + steps, cells[:, 1:] + steps
    rows, columns = (row >= 0) & (row < height), (column >= 0) & (column < width)
    return (rows.unsqueeze(-1) & columns.unsqueeze(-2)).flatten(1)


def seen_windows(tables: GridTables, occupied: Tensor, sight: Sight) -> Tensor:
    """Which cells of their windows robots would see from each cell if unknown cells were free.

    Args:
        tables: of the grid and ``sight.radius``.
        occupied: known obstacles of M maps, bool [M, C].
        sight: of the robots, of T kinds.

    Returns:
        bool [M, T, C, (2k + 1)^2], for the cells ``tables.seen``.
    """
    seen = shapes(sight, occupied.device).flatten(1).unsqueeze(1) & tables.window
    seen = seen.expand(len(occupied), *seen.shape)
    if sight.line_of_sight:
        wall = occupied[:, tables.seen] & tables.window
        free = line_of_sight(wall.unflatten(-1, (sight.side, sight.side))).flatten(-2)
        seen = seen & free.unsqueeze(1)
    return seen.contiguous()


@lru_cache(maxsize=32)
def cell_hashes(kind: int, cells: int, device: torch.device) -> Tensor:
    """A random number for each cell, int64 [C]."""
    return combine(kind, torch.arange(cells, device=device)) % _CODES


@lru_cache(maxsize=32)
def all_hashes(kinds: int, cells: int, device: torch.device) -> Tensor:
    """``cell_hashes`` of the first kinds, int64 [kinds, C]."""
    return torch.stack([cell_hashes(kind, cells, device) for kind in range(kinds)])

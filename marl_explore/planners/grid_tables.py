"""Lookup tables for planning that depend only on the size of the grid and the field of view."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from marl_explore.core.grid import COMPASS, flat_cell, square_steps
from marl_explore.core.hashing import combine
from marl_explore.core.sensing import cells_seen_from

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
        around=cells_seen_from(height, width, radius + 1, device),
        views=views.scatter_(1, in_view, 1).T.contiguous(),
        place=flat_cell(cells, 2 * width),
    )


@lru_cache(maxsize=32)
def cell_hashes(kind: int, cells: int, device: torch.device) -> Tensor:
    """A random number for each cell, int64 [C]."""
    return combine(kind, torch.arange(cells, device=device)) % _CODES

"""The compass, the cell codes, and reading a grid around a robot."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

UNKNOWN, FREE, OCCUPIED = -1, 0, 1
"""Cell codes of an occupancy map (int8)."""

COMPASS = ((-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1))
"""(row, column) offsets of N, NE, E, SE, S, SW, W, NW; row 0 is north."""
NUM_DIRECTIONS = len(COMPASS)
STAY, COMMUNICATE = 8, 9
NUM_ACTIONS = 10


@lru_cache
def compass(device: torch.device) -> Tensor:
    """Offsets of the eight directions, int64 [8, 2]."""
    return torch.tensor(COMPASS, device=device)


@lru_cache
def action_offsets(device: torch.device) -> Tensor:
    """Offsets of the ten actions, int64 [10, 2]; staying and communicating move by (0, 0)."""
    return torch.tensor((*COMPASS, (0, 0), (0, 0)), device=device)


@lru_cache
def square_offsets(radius: int, device: torch.device) -> Tensor:
    """Offsets of the cells of a square of side 2 radius + 1, row by row, int64 [(2r+1)^2, 2]."""
    side = torch.arange(-radius, radius + 1, device=device)
    return torch.cartesian_prod(side, side)


def read_cells(grid: Tensor, cells: Tensor, outside: bool | int) -> Tensor:
    """Values of a grid [*B, H, W] at cells [*B, ..., 2]; ``outside`` for cells off the grid."""
    height, width = grid.shape[-2:]
    row, column = cells.unbind(-1)
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    index = (row * width + column).where(inside, 0)
    batch = grid.shape[:-2]
    values = grid.flatten(-2).gather(-1, index.reshape(*batch, -1)).view(index.shape)
    return values.where(inside, outside)


def square_around(grid: Tensor, position: Tensor, radius: int, outside: bool | int) -> Tensor:
    """Square cut out of a grid around each robot.

    Args:
        grid: [*B, H, W].
        position: int64 [*B, N, 2].
        radius: half side of the square (cells).
        outside: value of cells off the grid.

    Returns:
        [*B, N, 2 radius + 1, 2 radius + 1], row 0 north.
    """
    cells = position.unsqueeze(-2) + square_offsets(radius, position.device)
    side = 2 * radius + 1
    return read_cells(grid, cells, outside).unflatten(-1, (side, side))


def one_hot_cells(position: Tensor, height: int, width: int, radius: int = 0) -> Tensor:
    """Cells at most ``radius`` rows and columns away, bool [..., H, W], for position [..., 2]."""
    rows = torch.arange(height, device=position.device)
    columns = torch.arange(width, device=position.device)
    near_row = (rows - position[..., 0:1]).abs() <= radius
    near_column = (columns - position[..., 1:2]).abs() <= radius
    return near_row.unsqueeze(-1) & near_column.unsqueeze(-2)

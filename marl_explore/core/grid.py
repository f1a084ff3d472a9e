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
def _ring(device: torch.device) -> Tensor:
    """Places of the eight neighbours in a flattened 3 x 3 square, in compass order, int64 [8]."""
    return torch.tensor([3 * (1 + r) + 1 + c for r, c in COMPASS], device=device)


@lru_cache
def _square(side: int, stride: int, device: torch.device) -> Tensor:
    """Steps from a square's first cell to all its cells in a flattened grid, int64 [side, side]."""
    steps = torch.arange(side, device=device)
    return stride * steps.unsqueeze(-1) + steps


def square_around(grid: Tensor, position: Tensor, radius: int, outside: bool | int) -> Tensor:
    """Square cut out of a grid around each robot.

    Args:
        grid: [*B, H, W].
        position: int64 [*B, N, 2], inside the grid.
        radius: half side of the square (cells).
        outside: value of cells off the grid.

    Returns:
        [*B, N, 2 radius + 1, 2 radius + 1], row 0 north.
    """
    padded = torch.nn.functional.pad(grid, (radius,) * 4, value=outside)
    stride = padded.shape[-1]
    corner = position[..., 0] * stride + position[..., 1]
    index = corner[..., None, None] + _square(2 * radius + 1, stride, grid.device)
    values = padded.flatten(-2).gather(-1, index.flatten(-3))
    return values.view(index.shape)


@lru_cache
def other_robots(robots: int, device: torch.device) -> Tensor:
    """1 for every pair of different robots, 0 for a robot and itself, int64 [N, N]."""
    return 1 - torch.eye(robots, dtype=torch.int64, device=device)


def neighbors(grid: Tensor, position: Tensor, outside: bool | int) -> Tensor:
    """Values of the eight cells around each robot in compass order, [*B, N, 8]."""
    square = square_around(grid, position, 1, outside).flatten(-2)
    return square.index_select(-1, _ring(grid.device))


def with_robots(obstacles: Tensor, position: Tensor) -> Tensor:
    """Obstacles bool [*B, H, W] and the cells of the robots [*B, N, 2] as one grid."""
    cell = position[..., 0] * obstacles.shape[-1] + position[..., 1]
    return obstacles.flatten(-2).scatter(-1, cell, True).view(obstacles.shape)

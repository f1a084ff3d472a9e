"""Sensing: only this module knows the shape and range of the sensors.

It computes what is around each robot, what that writes into its map, and what it could expect to
see from other cells.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from marl_explore.core.grid import (
    COMPASS,
    FREE,
    OCCUPIED,
    UNKNOWN,
    compass,
    flat_cell,
    square_steps,
    straight_distances,
)

OPEN, WALL, ROBOT, UNSEEN = 0, 1, 2, 4
"""Contents of a cell around a robot (int8, one bit each); UNSEEN is outside or hidden."""


def bordered(obstacles: Tensor, radius: int) -> Tensor:
    """Obstacles bool [*B, H, W] as WALL bits with a border of UNSEEN, int8 [*B, H + 2k, W + 2k]."""
    return torch.nn.functional.pad(obstacles.to(torch.int8), (radius,) * 4, value=UNSEEN)


def surroundings(walls: Tensor, position: Tensor, radius: int, occlusion: bool = False) -> Tensor:
    """Contents of the square around each robot; the own cell is OPEN.

    Args:
        walls: ``bordered`` obstacles, int8 [*B, H + 2k, W + 2k].
        position: int64 [*B, N, 2].
        radius: half side k of the square (cells).
        occlusion: whether two obstacles hide the diagonal cell behind them (k = 1 only).

    Returns:
        int8 [*B, N, 2k + 1, 2k + 1], row 0 north.
    """
    side, stride = 2 * radius + 1, walls.shape[-1]
    own = flat_cell(position, stride) + radius * (stride + 1)
    occupied = walls.flatten(-2).scatter(-1, own, ROBOT)
    index = own.unsqueeze(-1) + square_steps(radius, stride, walls.device)
    view = occupied.gather(-1, index.flatten(-2)).view(*own.shape, side, side)
    view[..., radius, radius].fill_(OPEN)
    if occlusion:
        wall = view == WALL
        hidden = wall[..., ::2, 1:2] & wall[..., 1:2, ::2]
        view[..., ::2, ::2].masked_fill_(hidden, UNSEEN)
    return view


def beside(view: Tensor) -> Tensor:
    """The targets of the eight moves, and the own cell, [*B, N, 9], from ``surroundings``."""
    return view.flatten(-2).index_select(-1, _places(view.shape[-1] // 2, view.device))


@lru_cache
def _places(radius: int, device: torch.device) -> Tensor:
    """Targets of the eight moves and of staying in a flattened square, int64 [9]."""
    side = 2 * radius + 1
    cells = [(radius + r) * side + radius + c for r, c in (*COMPASS, (0, 0))]
    return torch.tensor(cells, device=device)


@lru_cache
def cells_seen_from(height: int, width: int, radius: int, device: torch.device) -> Tensor:
    """Cells of the square around each cell of a flattened grid, int64 [H W, (2k + 1)^2].

    Cells outside the grid are replaced by the centre cell.
    """
    cell = torch.arange(height * width, device=device).unsqueeze(-1)
    steps = torch.arange(-radius, radius + 1, device=device)
    row = cell // width + steps.repeat_interleave(len(steps))
    column = cell % width + steps.repeat(len(steps))
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    return torch.where(inside, row * width + column, cell)


def field_of_view(view: Tensor) -> Tensor:
    """Each robot's field of view: obstacles, other robots and unseen cells are 1.

    Args:
        view: ``sensing.surroundings``, int8 [*B, N, 2k + 1, 2k + 1].

    Returns:
        float32 of the same shape; the own cell is 0.
    """
    return view.clamp_max(1).float()


class Sensed(NamedTuple):
    """Maps after sensing, and the new cells."""

    map: Tensor
    """int8 [*B, N, H, W], a new tensor."""
    cell: Tensor
    """Seen cells of the flattened arena, int64 [*B, N, (2k + 1)^2]."""
    fresh: Tensor
    """Whether each of these cells was unknown, bool."""

    @property
    def discovered(self) -> Tensor:
        """Cells that were new to each robot's map, int64 [*B, N]."""
        return self.fresh.sum(-1)

    def discovered_of(self, target: Tensor) -> Tensor:
        """New cells among those of a mask bool [*B, H, W], int64 [*B, N]."""
        chosen = target.flatten(-2).gather(-1, self.cell.flatten(-2)).view(self.cell.shape)
        return (self.fresh & chosen).sum(-1)


def sense(grid: Tensor, view: Tensor, position: Tensor, occlusion: bool = False) -> Sensed:
    """Maps after each robot has sensed the cells around it.

    Args:
        grid: maps in which the robots' own cells are known, int8 [*B, N, H, W].
        view: ``sensing.surroundings``, int8 [*B, N, 2k + 1, 2k + 1].
        position: int64 [*B, N, 2].
        occlusion: whether cells on the grid may be hidden.
    """
    # cells that cannot be seen are replaced by the own cell, which is known and not a wall
    height, width = grid.shape[-2:]
    own = flat_cell(position, width)
    cells = cells_seen_from(height, width, view.shape[-1] // 2, view.device)
    view = view.flatten(-2)
    cell = cells.index_select(0, own.flatten()).view(view.shape)
    if occlusion:
        cell = torch.where(view == UNSEEN, own.unsqueeze(-1), cell)
    known = grid.flatten(-2)
    fresh = known.gather(-1, cell) == UNKNOWN
    return Sensed(known.scatter(-1, cell, view & WALL).view(grid.shape), cell, fresh)


def unknown_around(grid: Tensor, radius: int) -> Tensor:
    """Unknown cells in the square around each cell, float32 [*B, H, W], of maps [*B, H, W]."""
    unknown = (grid == UNKNOWN).float().reshape(-1, 1, *grid.shape[-2:])
    side = 2 * radius + 1
    mean = torch.nn.functional.avg_pool2d(unknown, side, stride=1, padding=radius)
    return (mean * side**2).round().view(grid.shape)


def count_around(cells: Tensor, radius: int) -> Tensor:
    """Cells of a set bool [*B, H, W] in the square around each cell, int64 [*B, H, W]."""
    height, width = cells.shape[-2:]
    corner = torch.nn.functional.pad(cells.long().cumsum(-1).cumsum(-2), (1, 0, 1, 0))
    row = torch.arange(height, device=cells.device)
    column = torch.arange(width, device=cells.device)
    top, bottom = (row - radius).clamp_min(0), (row + radius + 1).clamp_max(height)
    left, right = (column - radius).clamp_min(0), (column + radius + 1).clamp_max(width)
    strip = corner.index_select(-2, bottom) - corner.index_select(-2, top)
    return strip.index_select(-1, right) - strip.index_select(-1, left)


def step_gains(grid: Tensor, position: Tensor, radius: int) -> Tensor:
    """Number of cells that a robot would see for the first time after each move.

    Args:
        grid: maps, int8 [*B, H, W].
        position: int64 [*B, 2].
        radius: of the square that it sees (cells).

    Returns:
        float32 [*B, 8]; 0 where the move is known to be blocked.
    """
    height, width = grid.shape[-2:]
    target = position.unsqueeze(-2) + compass(grid.device)
    size = torch.tensor([height, width], device=grid.device)
    inside = ((target >= 0) & (target < size)).all(-1)
    target = target.clamp(torch.zeros_like(size), size - 1)

    def at(cells: Tensor, row: Tensor, column: Tensor) -> Tensor:
        return cells.flatten(-2).gather(-1, row * width + column)

    row, column = target.unbind(-1)
    own_row, own_column = (entry.expand_as(row) for entry in position.unsqueeze(-2).unbind(-1))
    walled = (at(grid, row, own_column) == OCCUPIED) & (at(grid, own_row, column) == OCCUPIED)
    diagonal = (row != own_row) & (column != own_column)
    allowed = inside & (at(grid, row, column) == FREE) & ~(walled & diagonal)
    return at(unknown_around(grid, radius), row, column) * allowed


def cells_in_view(radius: int) -> int:
    """Number of cells in a robot's field of view, including its own."""
    return (2 * radius + 1) ** 2


def in_view(position: Tensor, height: int, width: int, radius: int) -> Tensor:
    """Cells that a robot at positions int64 [*B, 2] sees, bool [*B, H, W]."""
    return straight_distances(position, height, width) <= radius

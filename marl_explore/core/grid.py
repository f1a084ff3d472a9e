"""The compass, the cell codes, and reading a grid around a robot."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from marl_explore.codes import COMMUNICATE as COMMUNICATE
from marl_explore.codes import COMPASS as COMPASS
from marl_explore.codes import FREE as FREE
from marl_explore.codes import NUM_ACTIONS as NUM_ACTIONS
from marl_explore.codes import NUM_DIRECTIONS as NUM_DIRECTIONS
from marl_explore.codes import OCCUPIED as OCCUPIED
from marl_explore.codes import STAY as STAY
from marl_explore.codes import UNKNOWN as UNKNOWN


@lru_cache
def compass(device: torch.device) -> Tensor:
    """Offsets of the eight directions, int64 [8, 2]."""
    return torch.tensor(COMPASS, device=device)


@lru_cache
def action_offsets(device: torch.device) -> Tensor:
    """Offsets of the ten actions, int64 [10, 2]; staying and communicating move by (0, 0)."""
    return torch.tensor((*COMPASS, (0, 0), (0, 0)), device=device)


@lru_cache
def _places(radius: int, device: torch.device) -> Tensor:
    """Where the eight moves and staying lead to in a flattened square, int64 [9]."""
    side = 2 * radius + 1
    cells = [(radius + r) * side + radius + c for r, c in (*COMPASS, (0, 0))]
    return torch.tensor(cells, device=device)


@lru_cache
def square_steps(radius: int, stride: int, device: torch.device) -> Tensor:
    """Steps from a square's centre to all its cells in a flattened grid, int64 [(2k+1)^2]."""
    steps = torch.arange(-radius, radius + 1, device=device)
    return (stride * steps.unsqueeze(-1) + steps).flatten()


def flat_cell(position: Tensor, stride: int) -> Tensor:
    """Place of each robot's cell [*B, N, 2] in a flattened grid with rows of ``stride`` cells."""
    return torch.add(position[..., 1], position[..., 0], alpha=stride)


@lru_cache
def squares(height: int, width: int, radius: int, device: torch.device) -> Tensor:
    """Cells of the square around each cell of a flattened grid, int64 [H W, (2k + 1)^2].

    Off the grid the cell in the middle stands in.
    """
    cell = torch.arange(height * width, device=device).unsqueeze(-1)
    steps = torch.arange(-radius, radius + 1, device=device)
    row = cell // width + steps.repeat_interleave(len(steps))
    column = cell % width + steps.repeat(len(steps))
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    return torch.where(inside, row * width + column, cell)


@lru_cache
def other_robots(robots: int, device: torch.device) -> Tensor:
    """1 for every pair of different robots, 0 for a robot and itself, int64 [N, N]."""
    return 1 - torch.eye(robots, dtype=torch.int64, device=device)


OPEN, WALL, ROBOT, UNSEEN = 0, 1, 2, 4
"""What stands in a cell around a robot (int8, a bit each); UNSEEN is outside or hidden."""


def bordered(obstacles: Tensor, radius: int) -> Tensor:
    """Obstacles bool [*B, H, W] as codes with a border of UNSEEN, int8 [*B, H + 2k, W + 2k]."""
    return torch.nn.functional.pad(obstacles.to(torch.int8), (radius,) * 4, value=UNSEEN)


def surroundings(walls: Tensor, position: Tensor, radius: int, occlusion: bool = False) -> Tensor:
    """What stands in the square around each robot; the own cell is OPEN.

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
    """The cells that the eight moves lead to, and the own cell, [*B, N, 9] of ``surroundings``."""
    return view.flatten(-2).index_select(-1, _places(view.shape[-1] // 2, view.device))


def with_robots(obstacles: Tensor, position: Tensor) -> Tensor:
    """Obstacles bool [*B, H, W] and the cells of the robots [*B, N, 2] as one grid."""
    cell = flat_cell(position, obstacles.shape[-1])
    return obstacles.flatten(-2).scatter(-1, cell, True).view(obstacles.shape)


def straight_distances(position: Tensor, height: int, width: int) -> Tensor:
    """Moves on an empty grid from positions int64 [*B, 2] to all cells, float32 [*B, H, W]."""
    row = torch.arange(height, device=position.device).unsqueeze(-1)
    column = torch.arange(width, device=position.device)
    rows = (position[..., 0, None, None] - row).abs()
    return torch.maximum(rows, (position[..., 1, None, None] - column).abs()).float()

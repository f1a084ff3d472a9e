"""Directions, cell values, and indexing a grid around a robot."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from marl_explore.config.constants import COMMUNICATE as COMMUNICATE
from marl_explore.config.constants import COMPASS as COMPASS
from marl_explore.config.constants import FREE as FREE
from marl_explore.config.constants import NUM_ACTIONS as NUM_ACTIONS
from marl_explore.config.constants import NUM_DIRECTIONS as NUM_DIRECTIONS
from marl_explore.config.constants import OCCUPIED as OCCUPIED
from marl_explore.config.constants import STAY as STAY
from marl_explore.config.constants import UNKNOWN as UNKNOWN


@lru_cache
def compass(device: torch.device) -> Tensor:
    """Offsets of the eight directions, int64 [8, 2]."""
    return torch.tensor(COMPASS, device=device)


@lru_cache
def action_offsets(device: torch.device) -> Tensor:
    """Offsets of the ten actions, int64 [10, 2]; staying and communicating move by (0, 0)."""
    return torch.tensor((*COMPASS, (0, 0), (0, 0)), device=device)


@lru_cache
def square_steps(radius: int, stride: int, device: torch.device) -> Tensor:
    """Offsets from a square's centre to its cells in a flattened grid, int64 [(2k+1)^2]."""
    steps = torch.arange(-radius, radius + 1, device=device)
    return (stride * steps.unsqueeze(-1) + steps).flatten()


def flat_cell(position: Tensor, stride: int) -> Tensor:
    """Index of each robot's cell [*B, N, 2] in a flattened grid with rows of ``stride`` cells."""
    return torch.add(position[..., 1], position[..., 0], alpha=stride)


@lru_cache
def other_robots(robots: int, device: torch.device) -> Tensor:
    """1 for every pair of different robots, 0 for a robot and itself, int64 [N, N]."""
    return 1 - torch.eye(robots, dtype=torch.int64, device=device)


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


def beside_any(cells: Tensor) -> Tensor:
    """Cells with a 4-neighbour in a set, bool [*B, H, W], of sets bool [*B, H, W]."""
    beside = torch.zeros_like(cells)
    beside[..., 1:, :] |= cells[..., :-1, :]
    beside[..., :-1, :] |= cells[..., 1:, :]
    beside[..., :, 1:] |= cells[..., :, :-1]
    beside[..., :, :-1] |= cells[..., :, 1:]
    return beside

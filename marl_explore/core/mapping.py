"""Sensing, merging and measuring occupancy maps."""

from __future__ import annotations

import torch
from torch import Tensor

from marl_explore.core.grid import (
    NUM_DIRECTIONS,
    UNKNOWN,
    compass,
    one_hot_cells,
    read_cells,
    square_around,
)
from marl_explore.core.wavefront import flood, to_bytes


def field_of_view(
    obstacles: Tensor, position: Tensor, radius: int, occlusion: bool = False
) -> Tensor:
    """What each robot's sensor reads around it: obstacles, other robots and the outside are 1.

    Args:
        obstacles: bool [*B, H, W].
        position: int64 [*B, N, 2].
        radius: half side k of the field of view (cells).
        occlusion: whether two obstacles hide the diagonal cell behind them (k = 1 only).

    Returns:
        float32 [*B, N, 2k + 1, 2k + 1], row 0 north; the own cell is 0.
    """
    occupied = square_around(obstacles, position, radius, outside=True)
    offset = position.unsqueeze(-3) - position.unsqueeze(-2) + radius  # of robot j from robot i
    robots = one_hot_cells(offset, 2 * radius + 1, 2 * radius + 1)
    itself = torch.eye(position.shape[-2], dtype=torch.bool, device=position.device)
    view = occupied | (robots & ~itself[..., None, None]).any(-3)
    if occlusion:
        view |= _corners(blocked_diagonals(obstacles, position))
    return view.float()


def sense(
    grid: Tensor, obstacles: Tensor, position: Tensor, radius: int, occlusion: bool = False
) -> Tensor:
    """Maps with the cells of each robot's field of view written in.

    Args:
        grid: maps, int8 [*B, N, H, W].
        obstacles: bool [*B, H, W].
        position: int64 [*B, N, 2].
        radius: half side k of the field of view (cells).
        occlusion: whether two obstacles hide the diagonal cell behind them (k = 1 only).

    Returns:
        int8 [*B, N, H, W], a new tensor.
    """
    height, width = obstacles.shape[-2:]
    seen = one_hot_cells(position, height, width, radius)
    if occlusion:
        corner = position.unsqueeze(-2) + compass(position.device)[1::2]
        hidden = one_hot_cells(corner, height, width)
        hidden &= blocked_diagonals(obstacles, position)[..., 1::2, None, None]
        seen &= ~hidden.any(-3)
    return torch.where(seen, obstacles.unsqueeze(-3).to(grid.dtype), grid)


def blocked_diagonals(obstacles: Tensor, position: Tensor) -> Tensor:
    """Directions that two static obstacles close, bool [*B, N, 8]; False for straight ones."""
    straight = position.unsqueeze(-2) + compass(position.device)[0::2]
    wall = read_cells(obstacles, straight, outside=False)
    closed = wall & wall.roll(-1, -1)
    return torch.stack((torch.zeros_like(closed), closed), -1).flatten(-2)


def _corners(diagonals: Tensor) -> Tensor:
    """Directions [*B, N, 8] as a 3 x 3 field of view."""
    order = torch.tensor([7, 0, 1, 6, NUM_DIRECTIONS, 2, 5, 4, 3], device=diagonals.device)
    return torch.nn.functional.pad(diagonals, (0, 1))[..., order].unflatten(-1, (3, 3))


def merge(grid: Tensor, network: Tensor) -> Tensor:
    """Maps after every network's members took over the union of their maps.

    Args:
        grid: maps that agree wherever they are known, int8 [*B, N, H, W].
        network: bool [*B, N, N], whether i and j are in one network (see ``radio.networks``).

    Returns:
        int8 [*B, N, H, W], a new tensor.
    """
    others = torch.where(network[..., None, None], grid.unsqueeze(-4), UNKNOWN).amax(-3)
    return torch.maximum(grid, others)


def known_cells(grid: Tensor) -> Tensor:
    """Number of known cells |M|, int64 [*B], of maps [*B, H, W]."""
    return (grid != UNKNOWN).flatten(-2).sum(-1)


def reachable_cells(obstacles: Tensor, position: Tensor) -> Tensor:
    """Free cells that some robot can reach by legal moves, robots not blocking one another.

    Args:
        obstacles: bool [*B, H, W].
        position: int64 [*B, N, 2].

    Returns:
        bool [*B, H, W].
    """
    *batch, height, width = obstacles.shape
    free = to_bytes(~obstacles.reshape(-1, height, width))
    starts = one_hot_cells(position, height, width).any(-3)
    labels, _ = flood(to_bytes(starts.reshape(-1, height, width)), free, free)
    return (labels != 0)[1:-1, 1:-1].permute(2, 0, 1).reshape(*batch, height, width)


def target_cells(obstacles: Tensor, position: Tensor) -> Tensor:
    """Cells an exploration has to map: reachable cells and their 4-neighbours, bool [*B, H, W]."""
    reachable = reachable_cells(obstacles, position)
    target = reachable.clone()
    target[..., 1:, :] |= reachable[..., :-1, :]
    target[..., :-1, :] |= reachable[..., 1:, :]
    target[..., :, 1:] |= reachable[..., :, :-1]
    target[..., :, :-1] |= reachable[..., :, 1:]
    return target


def connected(obstacles: Tensor) -> Tensor:
    """Whether legal moves join all free cells, bool [*B], for obstacles [*B, H, W]."""
    free = ~obstacles.flatten(-2)
    first = free.to(torch.uint8).argmax(-1, keepdim=True)
    width = obstacles.shape[-1]
    start = torch.stack((first // width, first % width), -1)
    reachable = reachable_cells(obstacles, start).flatten(-2)
    return (reachable | ~free).all(-1)


def known_targets(grid: Tensor, target: Tensor) -> Tensor:
    """Target cells [*B, H, W] that each robot's map [*B, N, H, W] knows, int64 [*B, N]."""
    return ((grid != UNKNOWN) & target.unsqueeze(-3)).flatten(-2).sum(-1)

"""Sensing, merging and measuring occupancy maps."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from marl_explore.config import TOLERANCE
from marl_explore.core.grid import square_around, with_robots
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
    view = square_around(with_robots(obstacles, position), position, radius, outside=True)
    view[..., radius, radius] = False
    if occlusion:
        view |= _hidden(obstacles, position)
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
    reach = _reach(radius, position.device)
    # a cell off the grid is drawn in to the nearest one on it, which is in view as well
    row = (position[..., 0:1] + reach).clamp(0, height - 1)
    column = (position[..., 1:2] + reach).clamp(0, width - 1)
    cell = (row.unsqueeze(-1) * width + column.unsqueeze(-2)).flatten(-2)
    seen = obstacles.flatten(-2).gather(-1, cell.flatten(-2)).view(cell.shape).to(grid.dtype)
    known = grid.flatten(-2)
    if occlusion:
        hidden = _hidden(obstacles, position).flatten(-2)
        seen = torch.where(hidden, known.gather(-1, cell), seen)
    return known.scatter(-1, cell, seen).view(grid.shape)


@lru_cache
def _reach(radius: int, device: torch.device) -> Tensor:
    """Steps to the rows or columns in view, int64 [2 radius + 1]."""
    return torch.arange(-radius, radius + 1, device=device)


def _hidden(obstacles: Tensor, position: Tensor) -> Tensor:
    """Corners of the 3 x 3 field of view behind two obstacles, bool [*B, N, 3, 3]."""
    wall = square_around(obstacles, position, 1, outside=False)
    hidden = torch.zeros_like(wall)
    beside_row, beside_column = wall[..., ::2, 1:2], wall[..., 1:2, ::2]
    hidden[..., ::2, ::2] = beside_row & beside_column
    return hidden


def closed_diagonals(wall: Tensor) -> Tensor:
    """Directions between two walls, bool [*B, N, 8], of the walls in all directions [*B, N, 8]."""
    straight = wall[..., 0::2]
    closed = straight & straight.roll(-1, -1)
    return torch.stack((torch.zeros_like(closed), closed), -1).flatten(-2)


def merge(grid: Tensor, network: Tensor) -> Tensor:
    """Maps after every network's members took over the union of their maps.

    Args:
        grid: maps that agree wherever they are known, int8 [*B, N, H, W].
        network: bool [*B, N, N], whether i and j are in one network (see ``radio.networks``).

    Returns:
        int8 [*B, N, H, W], a new tensor.
    """
    # codes 0, 1, 2, so that a product leaves out the maps of others: bytes are fast, masks are not
    codes = (grid + 1).unsqueeze(-4)
    union = (network.to(grid.dtype)[..., None, None] * codes).amax(-3) - 1
    return torch.maximum(grid, union)


def known_mask(grid: Tensor) -> Tensor:
    """1 at known cells, int8, 0 elsewhere; maps of any shape."""
    return (grid + 1).clamp_max(1)


def known_cells(grid: Tensor) -> Tensor:
    """Number of known cells |M|, int64 [*B], of maps [*B, H, W]."""
    return known_mask(grid).flatten(-2).float().sum(-1).long()  # float adds fastest, exact to 2^24


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
    starts = with_robots(torch.zeros_like(obstacles), position)
    labels, _ = flood(to_bytes(starts.reshape(-1, height, width)), free, free)
    reached = (labels != 0)[1:-1, 1:-1].permute(2, 0, 1).contiguous()
    return reached.view(*batch, height, width)


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
    known = known_mask(grid) * target.unsqueeze(-3).to(grid.dtype)
    return known.flatten(-2).float().sum(-1).long()


def cells_of_share(share: float, cells: Tensor) -> Tensor:
    """Fewest whole cells that make up a share of ``cells`` [*B], float64 [*B]."""
    # the slack keeps 0.9 * 110 from asking for one cell more
    return (share * cells.double() - TOLERANCE).ceil()

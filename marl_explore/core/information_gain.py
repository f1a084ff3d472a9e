"""Which frontiers are left to each robot of a team: those to which it is the nearest."""

from __future__ import annotations

import torch
from torch import Tensor

from marl_explore.core.frontier import frontier_mask, paths
from marl_explore.core.grid import (
    FREE,
    NUM_DIRECTIONS,
    OCCUPIED,
    flat_cell,
)
from marl_explore.core.links import linked_others
from marl_explore.core.sensing import cells_in_view, unknown_around
from marl_explore.core.wavefront import nearest_distance

MANY_FRONTIERS = 8
"""Number of frontiers in a direction that is scaled to one half."""
TERRITORY_SIZE = 5
"""Columns of ``territory_table``."""


def territory_table(grid: Tensor, position: Tensor, linked: Tensor, radius: int) -> Tensor:
    """The frontiers to which no other linked robot is nearer, by the first move to them.

    Distances are path lengths as for FPR, on the robot's own map; a linked robot may stand in a
    cell that is unknown there. A robot without such a frontier uses all frontiers. Per direction,
    the columns are: the number n of frontiers, n / (n + 8); the nearness of the nearest,
    1 / moves; the value, the largest share of unknown cells in the square around a frontier,
    divided by the moves to it; then nearness and value as fractions of the best direction's, which
    distinguish directions however far away all frontiers are.

    Args:
        grid: maps of a team, int8 [*B, N, H, W].
        position: int64 [*B, N, 2].
        linked: ``links.links``, bool [*B, N, N].
        radius: of the square that a robot sees (cells).

    Returns:
        float32 [*B, N, 8, 5].
    """
    direction, length = paths(grid, position)
    reachable = frontier_mask(grid) & (length > 0)
    mine = reachable & (length <= _others_distance(grid, position, linked))
    some = mine.flatten(-2).any(-1)[..., None, None]
    bins = torch.where(torch.where(some, mine, reachable), direction, NUM_DIRECTIONS).flatten(-2)
    nearness = 1 / length.clamp_min(1).float()
    value = unknown_around(grid, radius) / cells_in_view(radius) * nearness

    def by_direction(values: Tensor, reduce: str) -> Tensor:
        empty = values.new_zeros(*bins.shape[:-1], NUM_DIRECTIONS + 1)
        return empty.scatter_reduce(-1, bins, values.flatten(-2), reduce)[..., :NUM_DIRECTIONS]

    number = by_direction(torch.ones_like(nearness), "sum")
    best = torch.stack((by_direction(nearness, "amax"), by_direction(value, "amax")), -1)
    top = best.amax(-2, keepdim=True)
    share = best / torch.where(top > 0, top, 1)
    return torch.cat(((number / (number + MANY_FRONTIERS)).unsqueeze(-1), best, share), -1)


def _others_distance(grid: Tensor, position: Tensor, linked: Tensor) -> Tensor:
    """Moves from the nearest other linked robot to every cell of a robot's map, [*B, N, H, W]."""
    height, width = grid.shape[-2:]
    others = linked_others(linked)
    cell = flat_cell(position, width).unsqueeze(-2).expand_as(others)
    starts = torch.zeros_like(grid, dtype=torch.bool).flatten(-2).scatter(-1, cell, others)
    starts, grids = starts.view(-1, height, width), grid.reshape(-1, height, width)
    return nearest_distance(starts, grids == FREE, grids != OCCUPIED).view(grid.shape)

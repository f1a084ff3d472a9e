"""What robots could discover: expected gains, and the frontiers that are left to each of a team.

Gains are expected on a robot's own map, for the shape and the range of its own sensor: unknown
cells, where obstacles end sight those that would be seen if all unknown cells were free.
"""

from __future__ import annotations

import torch
from torch import Tensor

from marl_explore.config.shapes import Sight
from marl_explore.core.frontier import frontier_mask, paths
from marl_explore.core.grid import FREE, NUM_DIRECTIONS, OCCUPIED, compass, flat_cell
from marl_explore.core.links import linked_others
from marl_explore.core.sensing import unknown_around
from marl_explore.core.sight import expected_discoveries
from marl_explore.core.wavefront import nearest_distance

MANY_FRONTIERS = 8
"""Number of frontiers in a direction that is scaled to one half."""
TERRITORY_SIZE = 5
"""Columns of ``territory_table``."""


def expected_gains(grid: Tensor, wanted: Tensor, sight: Sight) -> Tensor:
    """Unknown cells that a robot would see from cells of its map.

    Args:
        grid: maps, int8 [*B, H, W]; of teams [*B, N, H, W] if the robots' sensors differ.
        wanted: the cells to look from, bool of the same shape.
        sight: of the robots.

    Returns:
        float32 of the same shape; other cells hold the same or 0.
    """
    if sight.fills_windows:
        return unknown_around(grid, sight.radius)
    query = wanted.flatten().nonzero().squeeze(-1)
    cells = grid.shape[-2] * grid.shape[-1]
    which = query // cells
    found = expected_discoveries(
        grid.reshape(-1, *grid.shape[-2:]), which, query % cells, _kinds(which, sight), sight
    )
    gains = torch.zeros(grid.shape, dtype=torch.float32, device=grid.device)
    gains.view(-1)[query] = found.float()
    return gains


def _kinds(robot: Tensor, sight: Sight) -> Tensor:
    """The entry of a team's sight for robots numbered over all teams, int64 like ``robot``."""
    return robot % len(sight.ranges_cells)


def shape_sizes(sight: Sight, device: torch.device) -> Tensor:
    """Cells in the shape of each robot, float32 [N, 1], or [1, 1] if all are equal."""
    return torch.tensor(sight.sizes, dtype=torch.float32, device=device).unsqueeze(-1)


def step_gains(grid: Tensor, position: Tensor, sight: Sight) -> Tensor:
    """Number of cells that a robot would see for the first time after each move.

    Args:
        grid: maps, int8 [*B, H, W]; of teams [*B, N, H, W] if the robots' sensors differ.
        position: int64 [*B, 2].
        sight: of the robots.

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
    if sight.fills_windows:
        return at(unknown_around(grid, sight.radius), row, column) * allowed
    which = torch.arange(row[..., 0].numel(), device=grid.device).repeat_interleave(NUM_DIRECTIONS)
    found = expected_discoveries(
        grid.reshape(-1, height, width),
        which,
        (row * width + column).flatten(),
        _kinds(which, sight),
        sight,
    )
    return found.view(row.shape).float() * allowed


def territory_table(grid: Tensor, position: Tensor, linked: Tensor, sight: Sight) -> Tensor:
    """The frontiers to which no other linked robot is nearer, by the first move to them.

    Distances are path lengths as for FPR, on the robot's own map; a linked robot may stand in a
    cell that is unknown there. A robot without such a frontier uses all frontiers. Per direction,
    the columns are: the number n of frontiers, n / (n + 8); the nearness of the nearest,
    1 / moves; the value, the largest expected gain of a frontier as a share of the cells of the
    sensor's shape, divided by the moves to it; then nearness and value as fractions of the best
    direction's, which distinguish directions however far away all frontiers are.

    Args:
        grid: maps of a team, int8 [*B, N, H, W].
        position: int64 [*B, N, 2].
        linked: ``links.links``, bool [*B, N, N].
        sight: of the robots.

    Returns:
        float32 [*B, N, 8, 5].
    """
    direction, length = paths(grid, position)
    reachable = frontier_mask(grid) & (length > 0)
    mine = reachable & (length <= _others_distance(grid, position, linked))
    some = mine.flatten(-2).any(-1)[..., None, None]
    bins = torch.where(torch.where(some, mine, reachable), direction, NUM_DIRECTIONS).flatten(-2)
    nearness = 1 / length.clamp_min(1).float()
    share = expected_gains(grid, reachable, sight) / shape_sizes(sight, grid.device).unsqueeze(-1)
    value = share * nearness

    def by_direction(values: Tensor, reduce: str) -> Tensor:
        empty = values.new_zeros(*bins.shape[:-1], NUM_DIRECTIONS + 1)
        return empty.scatter_reduce(-1, bins, values.flatten(-2), reduce)[..., :NUM_DIRECTIONS]

    number = by_direction(torch.ones_like(nearness), "sum")
    best = torch.stack((by_direction(nearness, "amax"), by_direction(value, "amax")), -1)
    top = best.amax(-2, keepdim=True)
    relative = best / torch.where(top > 0, top, 1)
    return torch.cat(((number / (number + MANY_FRONTIERS)).unsqueeze(-1), best, relative), -1)


def _others_distance(grid: Tensor, position: Tensor, linked: Tensor) -> Tensor:
    """Moves from the nearest other linked robot to every cell of a robot's map, [*B, N, H, W]."""
    height, width = grid.shape[-2:]
    others = linked_others(linked)
    cell = flat_cell(position, width).unsqueeze(-2).expand_as(others)
    starts = torch.zeros_like(grid, dtype=torch.bool).flatten(-2).scatter(-1, cell, others)
    starts, grids = starts.view(-1, height, width), grid.reshape(-1, height, width)
    return nearest_distance(starts, grids == FREE, grids != OCCUPIED).view(grid.shape)

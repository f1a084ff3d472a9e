"""Room for others: who may stand in the way of a robot that it cannot hear, and where it goes."""

from __future__ import annotations

import torch
from torch import Tensor

from marl_explore.core.frontier import paths
from marl_explore.core.grid import (
    FREE,
    NUM_DIRECTIONS,
    OCCUPIED,
    STAY,
    compass,
    flat_cell,
)
from marl_explore.core.links import linked_others
from marl_explore.core.mapping import closed_diagonals
from marl_explore.core.sensing import beside


def crowded(grid: Tensor, position: Tensor, linked: Tensor, mask: Tensor, fov: Tensor) -> Tensor:
    """Robots beside which something stands that may wait for them, bool [*B, N].

    That is a cell that is not seen free and closed to the robot, although its own map has the way
    there open, and that holds no robot to which it is linked: those tell each other what they know.

    Args:
        grid: maps, int8 [*B, N, H, W].
        position: int64 [*B, N, 2].
        linked: ``links.links``, bool [*B, N, N].
        mask: allowed actions, bool [*B, N, 10]; out of its turn all moves are closed to a robot.
        fov: fields of view, [*B, N, 2k + 1, 2k + 1].
    """
    blocked, shut = blocked_beside(fov, grid, position)
    cell = position.unsqueeze(-2) + compass(grid.device)
    same = (cell.unsqueeze(-2) == position[..., None, None, :, :]).all(-1)
    held = (same & linked_others(linked).unsqueeze(-2)).any(-1)
    return (blocked & ~shut & ~held & ~mask[..., :NUM_DIRECTIONS]).any(-1)


def blocked_beside(fov: Tensor, grid: Tensor, position: Tensor) -> tuple[Tensor, Tensor]:
    """Neighbouring cells not seen free that the map has free, and those behind closed diagonals.

    Args:
        fov: fields of view, [*B, 2k + 1, 2k + 1], 1 where blocked or not seen.
        grid: maps, int8 [*B, H, W].
        position: int64 [*B, 2].

    Returns:
        Two of bool [*B, 8].
    """
    height, width = grid.shape[-2:]
    target = position.unsqueeze(-2) + compass(grid.device)
    inside = (target >= 0).all(-1) & (target[..., 0] < height) & (target[..., 1] < width)
    cell = torch.where(inside, flat_cell(target, width), 0)
    value = grid.flatten(-2).gather(-1, cell).masked_fill(~inside, OCCUPIED)
    wall = torch.nn.functional.pad(value == OCCUPIED, (0, 1))  # the own cell is none
    blocked = (value == FREE) & (beside(fov)[..., :NUM_DIRECTIONS] > 0)
    return blocked, closed_diagonals(wall)[..., :NUM_DIRECTIONS]


def roomy(grid: Tensor) -> Tensor:
    """Cells in which a robot is in nobody's only way, bool [*B, H, W], for maps int8 [*B, H, W].

    They are those of a square of two by two free cells: all cells beside one of them are joined by
    moves past it.
    """
    free = grid == FREE
    rows = free[..., :-1, :] & free[..., 1:, :]
    square = rows[..., :-1] & rows[..., 1:]  # whose upper left corner a cell is
    cells = torch.zeros_like(free)
    for row in (slice(-1), slice(1, None)):
        for column in (slice(-1), slice(1, None)):
            cells[..., row, column] |= square
    return cells


def has_to_make_room(
    crowded: Tensor,
    before: Tensor,
    grid: Tensor,
    position: Tensor,
    last: Tensor,
    step_count: Tensor,
) -> Tensor:
    """Robots that were ``crowded`` and have not come to a ``roomy`` cell since, bool [*B, N].

    Who knows none has only to move. Without this a robot in a dead end would stay there as soon as
    another steps back to let it out, and a slow one would for what stands beside it out of its
    turn.

    Args:
        crowded: who is, bool [*B, N].
        before: the result of the step before, bool [*B, N]; where an episode begins it is nothing.
        grid: maps, int8 [*B, N, H, W].
        position: int64 [*B, N, 2].
        last: positions at the step before, int64 [*B, N, 2].
        step_count: of this step, int64 [*B, 1].
    """
    before = before & (step_count > 0)
    if not before.any():
        return crowded
    cells = roomy(grid).flatten(-2)
    here = flat_cell(position, grid.shape[-1]).unsqueeze(-1)
    moved = (position != last).any(-1)
    done = torch.where(cells.any(-1), cells.gather(-1, here).squeeze(-1), moved)
    return crowded | (before & ~done)


def make_room(wanted: Tensor, crowded: Tensor, grid: Tensor, position: Tensor) -> Tensor:
    """The wanted actions; who wants to stay but has to make room goes to the next ``roomy`` cell.

    Of several shortest paths, the one whose first direction is lowest counts. Robots that are in
    such a cell, or know of none that they can reach, still stay.

    Args:
        wanted: int64 [*B, N].
        crowded: who ``has_to_make_room``, bool [*B, N].
        grid: maps, int8 [*B, N, H, W].
        position: int64 [*B, N, 2].
    """
    goes = crowded & (wanted == STAY)
    if not goes.any():
        return wanted
    maps = grid[goes]
    direction, length = (entry.flatten(-2).long() for entry in paths(maps, position[goes]))
    there = roomy(maps).flatten(-2)
    here = flat_cell(position[goes], grid.shape[-1]).unsqueeze(-1)
    far = torch.iinfo(torch.int64).max
    order = (length * NUM_DIRECTIONS + direction).masked_fill(~there | (length == 0), far)
    nearest = order.amin(-1)
    stays = (nearest == far) | there.gather(-1, here).squeeze(-1)
    return wanted.masked_scatter(goes, torch.where(stays, STAY, nearest % NUM_DIRECTIONS))

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
    action_offsets,
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
    size = torch.tensor(grid.shape[-2:], device=grid.device)
    cell = position.unsqueeze(-2) + action_offsets(grid.device)[: STAY + 1]
    inside = ((cell >= 0) & (cell < size)).all(-1)
    place = flat_cell(cell.clamp_min(0).minimum(size - 1), grid.shape[-1])
    value = grid.flatten(-2).gather(-1, place).masked_fill(~inside, OCCUPIED)
    shut = closed_diagonals(value == OCCUPIED)
    same = (cell.unsqueeze(-2) == position[..., None, None, :, :]).all(-1)
    held = (same & linked_others(linked).unsqueeze(-2)).any(-1)
    closed = ~mask[..., : STAY + 1] & (beside(fov) > 0)
    return ((value == FREE) & ~shut & ~held & closed).any(-1)


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

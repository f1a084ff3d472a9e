"""Which moves are open, and the result of simultaneous moves."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from marl_explore.core.grid import (
    NUM_DIRECTIONS,
    STAY,
    action_offsets,
    flat_cell,
)
from marl_explore.core.links import any_linked
from marl_explore.core.mapping import closed_diagonals
from marl_explore.core.sensing import OPEN, WALL, beside


def open_moves(view: Tensor) -> Tensor:
    """Moves without a danger that is visible beforehand, bool [*B, N, 9].

    A move is open unless its target is outside, is an obstacle or holds a robot, or it is a
    diagonal between two obstacles. The ninth, staying, is always open.

    Args:
        view: ``sensing.surroundings``, int8 [*B, N, 2k + 1, 2k + 1].
    """
    cells = beside(view)
    return (cells | closed_diagonals(cells & WALL)) == OPEN


def in_turn(
    period: int | tuple[int, ...], alive: Tensor | None, step_count: Tensor
) -> Tensor | None:
    """Robots that may move: those that live and whose period divides the time.

    Bool [*B, N], or [*B, 1] if the same is true of all; None: all of them may.

    Args:
        period: steps, of each robot or of all.
        alive: bool [*B, N]; None: all.
        step_count: int64 [*B, 1].
    """
    if period == 1:
        return alive
    turn = step_count % torch.tensor(period, device=step_count.device) == 0
    return turn if alive is None else alive & turn


def has_to_give_way(
    refused: Tensor, before: Tensor, period: int | tuple[int, ...], step_count: Tensor
) -> Tensor:
    """Robots of which a move was refused and that have not had their turn since, bool [*B, N].

    Two robots whose turn is the same would else block each other forever: each forgets in between
    that it has to give way.

    Args:
        refused: whether the last move was refused, bool [*B, N].
        before: the result of the step before, bool [*B, N]; where an episode begins it is nothing.
        period: as for ``in_turn``.
        step_count: of this step, int64 [*B, 1].
    """
    turn = in_turn(period, None, step_count - 1)
    return refused if turn is None else refused | (before & ~turn & (step_count > 0))


def action_mask(open_moves: Tensor, linked: Tensor, may_move: Tensor | None = None) -> Tensor:
    """Allowed actions: open moves, staying, and communicating if linked to another robot.

    Args:
        open_moves: bool [*B, N, 9].
        linked: ``links.links``, bool [*B, N, N].
        may_move: robots ``in_turn``, bool [*B, N]; None: all.

    Returns:
        bool [*B, N, 10].
    """
    mask = torch.cat((open_moves, any_linked(linked).unsqueeze(-1)), -1)
    if may_move is not None:
        mask[..., :NUM_DIRECTIONS] &= may_move.unsqueeze(-1)
    return mask


def random_allowed(mask: Tensor) -> Tensor:
    """Uniform random choice of an allowed action, int64 [*B, N], for a mask bool [*B, N, A]."""
    choice = torch.multinomial(mask.flatten(0, -2).float(), 1)
    return choice.view(mask.shape[:-1])


def turns_back(wanted: Tensor, heading: Tensor) -> Tensor:
    """Whether moves lead back the way that the last ones led, bool [*B, N].

    Args:
        wanted: actions, int64 [*B, N].
        heading: direction of each robot's last move, int64 [*B, N]; -1 before the first.
    """
    back = (heading + NUM_DIRECTIONS // 2) % NUM_DIRECTIONS
    return (heading >= 0) & (wanted == back)


def give_way(
    wanted: Tensor, mask: Tensor, refused: Tensor, crowded: Tensor | None = None
) -> Tensor:
    """The wanted actions, with blocked moves replaced by a random choice (the yield rule).

    A move is blocked if it is not allowed, or if the robot's last move was refused. The choice is
    among the open moves and staying: in a corridor one robot has to wait until the other has left
    the only cell in which they can pass. Without this rule two robots that want to pass each other
    would block each other forever. For the same reason a robot does not stay where it is crowded:
    it may be in the only way of a robot that it cannot hear.

    Args:
        wanted: int64 [*B, N].
        mask: allowed actions, bool [*B, N, 10].
        refused: whether the last move was refused, bool [*B, N].
        crowded: who ``ways.has_to_make_room``, bool [*B, N]; None: nobody.

    Returns:
        int64 [*B, N].
    """
    allowed = mask.gather(-1, wanted.unsqueeze(-1)).squeeze(-1)
    moves = mask[..., : STAY + 1]  # staying is always allowed
    blocked = (wanted < NUM_DIRECTIONS) & (refused | ~allowed)
    if crowded is not None:
        blocked = blocked | (crowded & (wanted == STAY))
    return torch.where(blocked, random_allowed(moves), wanted)


def dangerous_moves(allowed: Tensor, position: Tensor, action: Tensor) -> Tensor:
    """Robots whose move is refused: not open, to another robot's target, or across its path.

    Args:
        allowed: ``action_mask``, bool [*B, N, 10], before the moves.
        position: int64 [*B, N, 2], before the moves.
        action: int64 [*B, N].

    Returns:
        bool [*B, N]; all contenders are refused, so the order of the robots does not matter.
    """
    moving = action < NUM_DIRECTIONS
    is_open = allowed.gather(-1, action.unsqueeze(-1)).squeeze(-1)
    start = flat_cell(position, _ROW)
    target = start + _of_each(action, _steps(action.device))
    # two moves with equal sums of start and target have the same midpoint: their paths cross.
    # Robots that do not move never contend: no open move ends in or crosses their cell
    doubled_midpoint = start + target
    conflict = _equal_pairs(target) | _equal_pairs(doubled_midpoint)
    alone = conflict.sum(-1) == 1  # every robot is equal to itself
    return moving & ~(is_open & alone)


def move(position: Tensor, action: Tensor, dangerous: Tensor) -> Tensor:
    """Positions after the step, int64 [*B, N, 2]; refused robots stay."""
    done = action.masked_fill(dangerous, STAY)
    return position + _of_each(done, action_offsets(action.device))


_ROW = 1 << 16
"""Encodes a cell, also outside the grid, as row * _ROW + column; larger than any width."""


@lru_cache
def _steps(device: torch.device) -> Tensor:
    """The moves of the ten actions in this encoding, int64 [10]."""
    row, column = action_offsets(device).T
    return row * _ROW + column


def _of_each(action: Tensor, table: Tensor) -> Tensor:
    """Rows of a table [10, ...] for actions [*B, N]: several times faster than indexing."""
    return table.index_select(0, action.flatten()).view(*action.shape, *table.shape[1:])


def _equal_pairs(number: Tensor) -> Tensor:
    """Pairs of robots with the same number, bool [*B, N, N], for int64 [*B, N]."""
    return number.unsqueeze(-1) == number.unsqueeze(-2)

"""Which moves are open, and what happens when all robots move at once."""

from __future__ import annotations

import torch
from torch import Tensor

from marl_explore.core.grid import (
    NUM_DIRECTIONS,
    action_offsets,
    compass,
    read_cells,
)
from marl_explore.core.mapping import blocked_diagonals
from marl_explore.core.radio import has_neighbor


def open_moves(obstacles: Tensor, position: Tensor) -> Tensor:
    """Moves without a danger that is visible before anyone moves, bool [*B, N, 8].

    A move is open unless its target is outside, is an obstacle or holds a robot, or it is a
    diagonal between two obstacles.

    Args:
        obstacles: bool [*B, H, W].
        position: int64 [*B, N, 2].
    """
    target = position.unsqueeze(-2) + compass(position.device)
    wall = read_cells(obstacles, target, outside=True)
    held = (target.unsqueeze(-2) == position[..., None, None, :, :]).all(-1).any(-1)
    return ~(wall | held | blocked_diagonals(obstacles, position))


def action_mask(open_moves: Tensor, reach: Tensor) -> Tensor:
    """Allowed actions: open moves, always stay, communicate beside another robot in range.

    Args:
        open_moves: bool [*B, N, 8].
        reach: bool [*B, N, N], pairs in range.

    Returns:
        bool [*B, N, 10].
    """
    stay = torch.ones_like(open_moves[..., :1])
    return torch.cat((open_moves, stay, has_neighbor(reach).unsqueeze(-1)), -1)


def dangerous_moves(open_moves: Tensor, position: Tensor, action: Tensor) -> Tensor:
    """Robots whose move is refused: closed, to a cell another one chose, or across its way.

    Args:
        open_moves: bool [*B, N, 8], before the moves.
        position: int64 [*B, N, 2], before the moves.
        action: int64 [*B, N].

    Returns:
        bool [*B, N]; all contenders are refused, so the order of the robots does not matter.
    """
    moving = action < NUM_DIRECTIONS
    direction = action.clamp_max(NUM_DIRECTIONS - 1).unsqueeze(-1)
    closed = ~open_moves.gather(-1, direction).squeeze(-1)
    target = position + action_offsets(action.device)[action]
    doubled_midpoint = position + target
    conflict = _equal_pairs(target) | _equal_pairs(doubled_midpoint)
    others = moving.unsqueeze(-2) & ~torch.eye(
        action.shape[-1], dtype=torch.bool, device=action.device
    )
    return moving & (closed | (conflict & others).any(-1))


def move(position: Tensor, action: Tensor, dangerous: Tensor) -> Tensor:
    """Positions after the step, int64 [*B, N, 2]; refused robots stay."""
    target = position + action_offsets(action.device)[action]
    return torch.where(dangerous.unsqueeze(-1), position, target)


def _equal_pairs(cells: Tensor) -> Tensor:
    """Pairs of robots with the same cell, bool [*B, N, N], for cells [*B, N, 2]."""
    return (cells.unsqueeze(-2) == cells.unsqueeze(-3)).all(-1)

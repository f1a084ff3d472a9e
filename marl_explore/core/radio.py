"""Radio: how far two robots hear each other through walls. ``links`` decides who is linked."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor

from marl_explore.config.arena import TOLERANCE

NEVER_LINKED = -1
"""Largest squared distance of a pair that no distance links."""
FARTHEST = 1 << 50
"""Larger than any squared distance of two cells; stands for an infinite range."""


def most_squared(
    range_cells: float, wall_loss_db: float, path_loss_exponent: float, walls: int, loss: float
) -> int:
    """The largest squared distance at which two robots are linked (cells).

    Args:
        range_cells: the shorter of their ranges; may be infinite.
        wall_loss_db: loss per obstacle between them, L; infinite: one cuts the link.
        path_loss_exponent: n.
        walls: obstacles between them, w.
        loss: further loss of the pair (dB), X.
    """
    through = wall_loss_db * walls if walls else 0.0
    if range_cells == 0 or through == math.inf:
        return NEVER_LINKED
    if range_cells == math.inf:
        return FARTHEST
    exponent = -(through + loss) / (10 * path_loss_exponent)
    gain = math.inf if exponent > 308 else 10.0**exponent  # a larger power raises an error
    return math.floor(min((range_cells * gain + TOLERANCE) ** 2, FARTHEST))


@lru_cache(maxsize=4096)
def reach_table(
    range_cells: float,
    wall_loss_db: float,
    path_loss_exponent: float,
    loss: float = 0.0,
    most_walls: int = 1 << 16,
) -> tuple[int, ...]:
    """``most_squared`` for 0, 1, 2 ... walls, as far as robots can be linked.

    Robots with w > 0 walls between them are at least w + 1 cells apart, so the table ends, at the
    latest after ``most_walls``; more walls than that never link.
    """
    limits: list[int] = []
    for walls in range(most_walls + 1):
        limit = most_squared(range_cells, wall_loss_db, path_loss_exponent, walls, loss)
        if walls and limit < (walls + 1) ** 2:
            break
        limits.append(limit)
    return tuple(limits)


def walls_between(obstacles: Tensor, start: Tensor, end: Tensor, most_moves: int) -> Tensor:
    """Obstacles on the straight lines between pairs of cells, int64 [*B, P].

    Of each line the points between the ends count, one per move; one halfway between two cells
    counts only if both are obstacles. The number is the same from both ends.

    Args:
        obstacles: bool [*B, H, W].
        start: int64 [*B, P, 2].
        end: int64 [*B, P, 2].
        most_moves: lines of more moves than this are followed only so far.
    """
    ahead = end - start
    moves = ahead.abs().amax(-1, keepdim=True)  # m
    step = torch.arange(1, max(most_moves, 1), device=obstacles.device)
    moved = step * ahead.unsqueeze(-1)  # [*B, P, 2, T]
    length = moves.clamp_min(1).unsqueeze(-1)
    below = moved.div(length, rounding_mode="floor")
    rest = 2 * (moved - below * length)
    low, high = below + (rest > length), below + (rest >= length)
    width = obstacles.shape[-1]
    flat, inside = obstacles.flatten(-2), step < moves

    def blocked(offset: Tensor) -> Tensor:
        row, column = (start.unsqueeze(-1) + offset).unbind(-2)
        cell = (row * width + column).masked_fill(~inside, 0)
        return flat.gather(-1, cell.flatten(-2)).view(cell.shape)

    # only one coordinate can lie halfway, so its two cells are those of all low or all high
    return (blocked(low) & blocked(high) & inside).sum(-1)

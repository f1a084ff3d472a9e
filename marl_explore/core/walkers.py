"""Walkers: people who walk about at random, and whom robots have to drive around."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from marl_explore.core.draws import uniform
from marl_explore.core.grid import flat_cell, with_robots
from marl_explore.core.hashing import combine, text_key

STEPS = ((0, 0), (-1, 0), (0, 1), (1, 0), (0, -1))
"""What a walker chooses from: staying, N, E, S, W."""


@lru_cache
def _steps(device: torch.device) -> Tensor:
    return torch.tensor(STEPS, device=device)


def walker_starts(number: int, obstacles: Tensor, position: Tensor, draw_key: Tensor) -> Tensor:
    """Cells of the walkers at the start of an episode, int64 [*B, W, 2].

    They are the free cells without a robot that have the smallest hashes.

    Args:
        number: of walkers W.
        obstacles: bool [*B, H, W].
        position: of the robots, int64 [*B, N, 2].
        draw_key: int64 [*B, 1].

    Raises:
        ValueError: naming the number and the arena, if there are fewer cells.
    """
    batch, width = obstacles.shape[:-2], obstacles.shape[-1]
    if not number:
        return position.new_zeros(*batch, 0, 2)
    taken = with_robots(obstacles, position).flatten(-2)
    room = (~taken).sum(-1).flatten()
    if bool((room < number).any()):
        arena = int((room < number).nonzero()[0])
        raise ValueError(
            f"num_walkers={number} is not allowed: arena {arena} has {room[arena]} free cells "
            "without a robot"
        )
    cells = torch.arange(taken.shape[-1], device=taken.device)
    order = combine(draw_key, text_key("walker-start"), cells)
    order = order.masked_fill(taken, torch.iinfo(torch.int64).max)
    first = order.argsort(dim=-1, stable=True)[..., :number]
    return torch.stack((first // width, first % width), -1)


def move_walkers(
    walkers: Tensor, position: Tensor, obstacles: Tensor, draw_key: Tensor, step_count: Tensor
) -> Tensor:
    """Cells of the walkers after all have drawn a step at once, int64 [*B, W, 2].

    A walker goes if its cell is free, holds no robot after the robots' move and no walker before
    it, and no other walker drew it.

    Args:
        walkers: before, int64 [*B, W, 2].
        position: of the robots after their moves, int64 [*B, N, 2].
        obstacles: bool [*B, H, W].
        draw_key: int64 [*B, 1].
        step_count: before the step, int64 [*B, 1].
    """
    height, width = obstacles.shape[-2:]
    number = torch.arange(walkers.shape[-2], device=walkers.device)
    choice = (len(STEPS) * uniform(draw_key, "walker", number, step_count)).floor().long()
    target = walkers + _steps(walkers.device)[choice]
    size = torch.tensor((height, width), device=walkers.device)
    inside = ((target >= 0) & (target < size)).all(-1)
    cell = flat_cell(target.clamp(torch.zeros_like(size), size - 1), width)
    blocked = with_robots(with_robots(obstacles, position), walkers).flatten(-2).gather(-1, cell)
    drawn = flat_cell(target, 1 << 16)  # distinct outside the grid, too
    alone = (drawn.unsqueeze(-1) == drawn.unsqueeze(-2)).sum(-1) == 1
    goes = inside & ~blocked & alone
    return torch.where(goes.unsqueeze(-1), target, walkers)

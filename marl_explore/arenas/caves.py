"""Caves from a cellular automaton."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from marl_explore.arenas.components import largest_component
from marl_explore.arenas.generator import OBSTACLES, ArenaGenerator, numbers, redraw

ROCK_PERCENT = 45  # of the cells before the first round
ROUNDS = 4
SMALLEST_PERCENT = 35  # of the cells that a cave must leave free


@dataclass(frozen=True)
class Caves(ArenaGenerator):
    """One winding cave: cells become rock where rock prevails, and the largest cave is kept."""

    def obstacles(self, keys: Tensor) -> Tensor:
        """Obstacles bool [A, H, W], free cells connected."""
        failure = f"the largest caves leave less than {SMALLEST_PERCENT} % free"
        return redraw(self.config, keys, self._hollow, _large_enough, failure)

    def _hollow(self, keys: Tensor, attempt: int) -> Tensor:
        size = self.config.height, self.config.width
        lottery = numbers(keys, OBSTACLES, attempt, count=self.config.num_cells)
        rock = (lottery % 100 < ROCK_PERCENT).unflatten(-1, size)
        for _ in range(ROUNDS):
            rock = _rock_nearby(rock) >= 5
        return ~largest_component(~rock)


def _rock_nearby(rock: Tensor) -> Tensor:
    """Number of rocks among each cell and its eight neighbours [A, H, W]; outside all is rock."""
    padded = torch.nn.functional.pad(rock.to(torch.uint8), (1, 1, 1, 1), value=1)
    triples = padded[:, :-2] + padded[:, 1:-1] + padded[:, 2:]
    return triples[..., :-2] + triples[..., 1:-1] + triples[..., 2:]


def _large_enough(obstacles: Tensor) -> Tensor:
    """Whether enough cells are free, bool [A]."""
    cells = obstacles[0].numel()
    return 100 * (~obstacles).flatten(-2).sum(-1) >= SMALLEST_PERCENT * cells

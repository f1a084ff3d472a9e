"""Arenas with a fixed number of uniformly scattered obstacles, all free cells connected."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from marl_explore.arenas.generator import OBSTACLES, ArenaGenerator, numbers, redraw
from marl_explore.config.arena import ArenaConfig
from marl_explore.core.mapping import connected


@dataclass(frozen=True)
class Uniform(ArenaGenerator):
    """The generator of the paper's arenas (docs/environment.md, Arenas)."""

    def obstacles(self, keys: Tensor) -> Tensor:
        """Obstacles bool [A, H, W], redrawn until the free cells are connected."""
        density = self.config.obstacle_density
        failure = f"obstacle_density={density} is too high for connected free cells"
        return redraw(self.config, keys, self._scatter, connected, failure)

    def _scatter(self, keys: Tensor, attempt: int) -> Tensor:
        order = numbers(keys, OBSTACLES, attempt, count=self.config.num_cells)
        return scatter(order, self.config)


def scatter(order: Tensor, config: ArenaConfig) -> Tensor:
    """Obstacles in the cells with the smallest numbers.

    Args:
        order: random numbers of the cells, int64 [A, H W].
        config: size of the arenas and number of obstacles.

    Returns:
        bool [A, H, W].
    """
    smallest = order.topk(config.num_obstacles, largest=False).indices
    obstacles = torch.zeros_like(order, dtype=torch.bool).scatter_(-1, smallest, True)
    return obstacles.unflatten(-1, (config.height, config.width))

"""Arenas with a fixed number of uniformly scattered obstacles, all free cells connected."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from marl_explore.config import ArenaConfig
from marl_explore.core.hashing import combine
from marl_explore.core.mapping import connected

MAX_ATTEMPTS = 1000
_OBSTACLES, _STARTS = 0, 1  # the two streams of random numbers of one arena


@dataclass(frozen=True)
class Uniform:
    """The generator of the paper's arenas (docs/environment.md, Arenas)."""

    config: ArenaConfig

    def __call__(self, seed: int, arenas: Tensor, episodes: Tensor) -> tuple[Tensor, Tensor]:
        """Obstacles bool [A, H, W] and starts int64 [A, N, 2] of arenas and episodes [A]."""
        keys = combine(seed, arenas, episodes)
        obstacles = _connected_obstacles(self.config, keys)
        return obstacles, _starts(self.config, keys, obstacles)


def _connected_obstacles(config: ArenaConfig, keys: Tensor) -> Tensor:
    """Obstacles bool [A, H, W]: drawn again with the next attempt until they are connected."""
    size = (len(keys), config.height, config.width)
    obstacles = torch.zeros(size, dtype=torch.bool, device=keys.device)
    rejected = torch.arange(len(keys), device=keys.device)
    for attempt in range(MAX_ATTEMPTS):
        obstacles[rejected] = _obstacles(config, keys[rejected], attempt)
        rejected = rejected[~connected(obstacles[rejected])]
        if not len(rejected):
            return obstacles
    raise ValueError(
        f"obstacle_density={config.obstacle_density} gave no connected arena of "
        f"{config.height} x {config.width} cells in {MAX_ATTEMPTS} attempts: use a lower density"
    )


def _obstacles(config: ArenaConfig, keys: Tensor, attempt: int) -> Tensor:
    """Obstacles in the cells with the smallest hashes, bool [A, H, W]."""
    cells = torch.arange(config.num_cells, device=keys.device)
    order = combine(keys.unsqueeze(-1), _OBSTACLES, attempt, cells)
    smallest = order.topk(config.num_obstacles, largest=False).indices
    obstacles = torch.zeros_like(order, dtype=torch.bool).scatter_(-1, smallest, True)
    return obstacles.unflatten(-1, (config.height, config.width))


def _starts(config: ArenaConfig, keys: Tensor, obstacles: Tensor) -> Tensor:
    """The free cells with the smallest hashes of the second stream, int64 [A, N, 2]."""
    cells = torch.arange(config.num_cells, device=keys.device)
    order = combine(keys.unsqueeze(-1), _STARTS, cells)
    order = order.masked_fill(obstacles.flatten(-2), torch.iinfo(torch.int64).max)
    cell = order.topk(config.num_agents, largest=False).indices
    return torch.stack((cell // config.width, cell % config.width), -1)

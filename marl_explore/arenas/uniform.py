"""Arenas with a fixed number of uniformly scattered obstacles, all free cells connected."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from marl_explore.config import ArenaConfig
from marl_explore.core.hashing import combine
from marl_explore.core.mapping import connected

MAX_ATTEMPTS = 1000
_OBSTACLES, _STARTS = 0, 1  # the two streams of random numbers of one arena


def uniform(config: ArenaConfig) -> Callable[[int, Tensor, Tensor], tuple[Tensor, Tensor]]:
    """The generator of the paper's arenas for these settings (SPEC, Arena)."""

    def generate(seed: int, arenas: Tensor, episodes: Tensor) -> tuple[Tensor, Tensor]:
        keys = combine(seed, arenas, episodes)
        obstacles = _connected_obstacles(config, keys)
        return obstacles, _starts(config, keys, obstacles)

    return generate


def _connected_obstacles(config: ArenaConfig, keys: Tensor) -> Tensor:
    """Obstacles bool [A, H, W]: drawn again with the next attempt until they are connected."""
    obstacles = _obstacles(config, keys, attempt=0)
    rejected = (~connected(obstacles)).nonzero().squeeze(-1)
    for attempt in range(1, MAX_ATTEMPTS):
        if not len(rejected):
            return obstacles
        obstacles[rejected] = _obstacles(config, keys[rejected], attempt)
        rejected = rejected[~connected(obstacles[rejected])]
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

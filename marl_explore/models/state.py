"""A critic that reads what no robot sees: it is only there in training."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey
from torch import Tensor, nn

from marl_explore.config import ArenaConfig
from marl_explore.core.mapping import known_mask
from marl_explore.models.layers import mlp

STATE_KEYS: list[NestedKey] = ["obstacles", ("agents", "position"), ("agents", "map")]


class StateCritic(nn.Module):
    """Value [*B, 1] of the true state: obstacles, positions, and what every map knows."""

    size: Tensor

    def __init__(
        self, config: ArenaConfig, hidden: Sequence[int] = (2400, 300), norm_last: bool = False
    ) -> None:
        super().__init__()
        inputs = config.num_cells * (1 + config.num_agents) + 2 * config.num_agents
        self.layers = mlp(inputs, 1, hidden, norm_last)
        size = torch.tensor([config.height, config.width], dtype=torch.float32)
        self.register_buffer("size", size, persistent=False)

    def forward(self, obstacles: Tensor, position: Tensor, grid: Tensor) -> Tensor:
        """Value of bool [*B, H, W], int64 [*B, N, 2] and int8 [*B, N, H, W]."""
        parts = (obstacles.float().flatten(-2), known_mask(grid).flatten(-3))
        place = (position / self.size).flatten(-2)
        return self.layers(torch.cat((*parts, place), -1)).float()

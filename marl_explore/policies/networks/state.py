"""A critic of the true state, which no robot sees: it is used only in training."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey
from torch import Tensor, nn

from marl_explore.config.arena import ArenaConfig
from marl_explore.core.mapping import known_mask
from marl_explore.policies.networks.layers import CRITIC_GAIN, mlp

STATE_KEYS: list[NestedKey] = ["obstacles", ("agents", "position"), ("agents", "map")]
STATE_WIDTHS = (2400, 300)
"""Default hidden layers of a state critic: those of the paper's critic."""


class StateCritic(nn.Module):
    """Value [*B, 1] of the true state: obstacles, positions, and the known cells of all maps."""

    size: Tensor

    def __init__(self, arena: ArenaConfig, hidden: Sequence[int], norm_last: bool) -> None:
        super().__init__()
        inputs = arena.num_cells * (1 + arena.num_agents) + 2 * arena.num_agents
        self.layers = mlp(inputs, 1, hidden, norm_last, CRITIC_GAIN)
        size = torch.tensor([arena.height, arena.width], dtype=torch.float32)
        self.register_buffer("size", size, persistent=False)

    def forward(self, obstacles: Tensor, position: Tensor, grid: Tensor) -> Tensor:
        """Value of bool [*B, H, W], int64 [*B, N, 2] and int8 [*B, N, H, W]."""
        parts = (obstacles.float().flatten(-2), known_mask(grid).flatten(-3))
        place = (position / self.size).flatten(-2)
        return self.layers(torch.cat((*parts, place), -1)).float()

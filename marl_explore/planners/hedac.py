"""Exploration with a potential field: robots climb the gradient of heat that unknown cells emit.

After heat equation driven area coverage (Ivić, Crnković and Mezić 2017), on an occupancy grid.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import conv2d

from marl_explore.config.arena import ArenaConfig
from marl_explore.core.frontier import frontier_mask
from marl_explore.core.grid import (
    NUM_DIRECTIONS,
    OCCUPIED,
    STAY,
    UNKNOWN,
    compass,
    flat_cell,
)
from marl_explore.core.links import linked_others
from marl_explore.planners.base import Planner
from marl_explore.planners.communication import CommunicationRule


class HEDAC(Planner):
    """Every robot climbs the heat of its own map, in which other linked robots are cold spots.

    The heat is the stationary solution on cells not known to be occupied: unknown cells are
    sources, every cell loses a share, and obstacles and the boundary insulate.

    Args:
        communicate: when a robot communicates.
        config: the arena.
        loss: heat that a cell loses, relative to what it passes to one neighbour.
        sweeps: Jacobi iterations; None: twice the sum of the arena's sides.
    """

    def __init__(
        self,
        communicate: CommunicationRule,
        config: ArenaConfig,
        loss: float = 0.05,
        sweeps: int | None = None,
    ) -> None:
        super().__init__(communicate)
        self.loss = loss
        self.sweeps = sweeps or 2 * (config.height + config.width)

    def plan(self, tensordict: TensorDictBase) -> Tensor:
        """The open move to the hottest cell, or STAY if everything is known, int64 [*B, N]."""
        keys = ("map", "position", "linked")
        grid, position, linked = (tensordict.get(("agents", key)) for key in keys)
        heat = self.heat(grid, position, linked).flatten(-2)
        cell = flat_cell(position.unsqueeze(-2) + compass(grid.device), grid.shape[-1])
        around = heat.gather(-1, cell.clamp(0, heat.shape[-1] - 1))  # outside, no move is open
        mask = tensordict.get(("agents", "action_mask"))[..., :NUM_DIRECTIONS]
        move = around.masked_fill(~mask, -torch.inf).argmax(-1)
        left = frontier_mask(grid).flatten(-2).any(-1)
        return torch.where(left & mask.any(-1), move, STAY)

    def heat(self, grid: Tensor, position: Tensor, linked: Tensor) -> Tensor:
        """The heat of every robot's map, float32 [*B, N, H, W]."""
        *batch, robots, height, width = grid.shape
        source = (grid == UNKNOWN).float().view(-1, 1, height, width)
        conducts = (grid != OCCUPIED).float().view(-1, 1, height, width)
        others = linked_others(linked)
        cold = torch.zeros_like(grid).flatten(-2)
        cell = flat_cell(position, width).unsqueeze(-2).expand(*batch, robots, robots)
        cold.scatter_add_(-1, cell, others.to(grid.dtype))
        warm = conducts * (cold == 0).view_as(conducts)
        kernel = conducts.new_ones(1, 1, 3, 3)
        kernel[..., 1, 1] = 0
        ways = conv2d(conducts, kernel, padding=1) + self.loss
        heat = source
        for _ in range(self.sweeps):
            heat = (conv2d(heat, kernel, padding=1) / ways + source) * warm
        return heat.view_as(grid)

"""Exploration with a potential field: robots climb the gradient of heat that unknown cells emit.

After heat equation driven area coverage (Ivić, Crnković and Mezić 2017), on an occupancy grid.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import conv2d, pad

from marl_explore.config.arena import ArenaConfig
from marl_explore.core.frontier import frontier_mask
from marl_explore.core.grid import (
    COMPASS,
    NUM_DIRECTIONS,
    OCCUPIED,
    STAY,
    UNKNOWN,
    compass,
    flat_cell,
)
from marl_explore.core.links import linked_others
from marl_explore.core.mapping import target_cells
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
        super().__init__(communicate, config)
        self.loss = loss
        self.hides = config.line_of_sight
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
        unknown = grid == UNKNOWN
        if self.hides:  # what walls enclose is never seen, and would attract robots forever
            unknown = unknown & target_cells(grid == OCCUPIED, position.unsqueeze(-2))
        source = unknown.float().view(-1, 1, height, width)
        conducts = (grid != OCCUPIED).float().view(-1, 1, height, width)
        others = linked_others(linked)
        cold = torch.zeros_like(grid).flatten(-2)
        cell = flat_cell(position, width).unsqueeze(-2).expand(*batch, robots, robots)
        cold.scatter_add_(-1, cell, others.to(grid.dtype))
        warm = conducts * (cold == 0).view_as(conducts)
        spread = _through_open_diagonals(grid == OCCUPIED) if self.hides else _to_neighbors
        ways = spread(conducts) + self.loss
        heat = source
        for _ in range(self.sweeps):
            heat = (spread(heat) / ways + source) * warm
        return heat.view_as(grid)


def _to_neighbors(values: Tensor) -> Tensor:
    """Sums over the eight neighbours, float32 [M, 1, H, W]."""
    kernel = values.new_ones(1, 1, 3, 3)
    kernel[..., 1, 1] = 0
    return conv2d(values, kernel, padding=1)


def _through_open_diagonals(occupied: Tensor) -> Callable[[Tensor], Tensor]:
    """``_to_neighbors`` less those between which obstacles bool [*B, H, W] close the diagonal.

    Robots that do not see through closed diagonals must not be attracted by what lies behind them.
    """
    height, width = occupied.shape[-2:]
    walls = _shifted(occupied.reshape(-1, 1, height, width))
    is_open = [~(walls[d - 1] & walls[(d + 1) % len(walls)]) for d in range(1, len(walls), 2)]

    def spread(values: Tensor) -> Tensor:
        beside = _shifted(values)
        total = sum(beside[::2], torch.zeros_like(values))
        for value, passes in zip(beside[1::2], is_open, strict=True):
            total = total + value * passes
        return total

    return spread


def _shifted(cells: Tensor) -> list[Tensor]:
    """The neighbours of all cells [M, 1, H, W] in each of the eight directions; 0 outside."""
    height, width = cells.shape[-2:]
    padded = pad(cells, (1, 1, 1, 1))
    return [padded[..., 1 + r : 1 + r + height, 1 + c : 1 + c + width] for r, c in COMPASS]

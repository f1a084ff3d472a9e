"""References: planners with information that no robot has, and a bound that no team can beat."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from marl_explore.config.arena import ArenaConfig
from marl_explore.core.frontier import nearest_frontier
from marl_explore.core.grid import OCCUPIED, STAY, UNKNOWN
from marl_explore.core.mapping import known_mask, target_cells, union_of
from marl_explore.planners.base import Planner
from marl_explore.planners.beam import BeamSearch
from marl_explore.planners.communication import never


class Central(Planner):
    """One planner for all robots on the union of their maps, shared at no cost.

    Its robots never communicate; in evaluation the union counts as the map of each of them.

    Args:
        config: the arena.
        search: the joint plan.
    """

    sees = "the union of all maps, all positions"
    reference = True
    shares_maps = True

    def __init__(self, config: ArenaConfig, search: BeamSearch | None = None) -> None:
        super().__init__(never)
        self.radius = config.fov_radius
        self.search = search or BeamSearch()

    def obstacles(self, tensordict: TensorDictBase, union: Tensor) -> Tensor:
        """Cells that plans must avoid, bool [*B, H, W]."""
        return union == OCCUPIED

    def plan(self, tensordict: TensorDictBase) -> Tensor:
        """Every robot's part of the joint plan, int64 [*B, N]."""
        grid, position = (tensordict.get(("agents", key)) for key in ("map", "position"))
        union = union_of(grid)
        move = torch.full_like(position[..., 0], STAY)
        obstacles = self.obstacles(tensordict, union)
        unknown = (union == UNKNOWN) & target_cells(obstacles, position)
        rows = unknown.flatten(-2).any(-1)
        if rows.any():
            team = torch.ones_like(move, dtype=torch.bool)
            first, fruitful = self.search.first_moves(
                unknown[rows], obstacles[rows], position[rows], team[rows], self.radius
            )
            shared = union[rows].unsqueeze(1).expand(-1, *grid.shape[-3:])
            nearest, length = nearest_frontier(shared, position[rows])
            nearest = torch.where(length > 0, nearest, STAY)
            move[rows] = torch.where(fruitful.unsqueeze(-1), first, nearest)
        return move


class Clairvoyant(Central):
    """The central planner, which knows all obstacles from the start."""

    sees = "all obstacles, the union of all maps, all positions"

    def obstacles(self, tensordict: TensorDictBase, union: Tensor) -> Tensor:
        """The true obstacles, bool [*B, H, W]."""
        return tensordict.get("obstacles")


def counting_bound(config: ArenaConfig, start: TensorDictBase) -> Tensor:
    """Lower bound on the steps to see all target cells: every move sees as many cells as possible.

    Args:
        config: the arena.
        start: the observation of a reset, batch [B].

    Returns:
        int64 [B] (steps).
    """
    target = target_cells(start["obstacles"], start["agents", "position"])
    union = known_mask(union_of(start["agents", "map"]))
    missing = (target.float() * (1 - union)).flatten(-2).sum(-1)
    return (missing / (config.num_agents * config.max_discovery)).ceil().long()

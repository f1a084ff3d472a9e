"""References: planners with information that no robot has, and a bound that no team can beat."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.shapes import one_if_equal
from marl_explore.core.frontier import nearest_frontier
from marl_explore.core.grid import FREE, OCCUPIED, STAY, UNKNOWN, flat_cell
from marl_explore.core.mapping import known_mask, target_cells, union_of
from marl_explore.planners.base import Planner
from marl_explore.planners.beam import BeamSearch
from marl_explore.planners.communication import never


class Central(Planner):
    """One planner for all robots on the union of their maps, shared at no cost.

    Its robots never communicate; in evaluation the union counts as the map of each of them. It
    knows which robots failed and where people are, and plans around both.

    Args:
        config: the arena.
        search: the joint plan.
    """

    sees = "the union of all maps, all positions"
    reference = True
    shares_maps = True

    def __init__(self, config: ArenaConfig, search: BeamSearch | None = None) -> None:
        super().__init__(never)
        self.sight = config.sight
        self.search = search or BeamSearch()

    def obstacles(self, tensordict: TensorDictBase, union: Tensor) -> Tensor:
        """Cells that plans must avoid, bool [*B, H, W]."""
        return union == OCCUPIED

    def plan(self, tensordict: TensorDictBase) -> Tensor:
        """Every robot's part of the joint plan, int64 [*B, N]."""
        grid, position, alive = (
            tensordict.get(("agents", key)) for key in ("map", "position", "alive")
        )
        union = union_of(grid)  # shared at once, so nothing is lost with a robot that fails
        move = torch.full_like(position[..., 0], STAY)
        obstacles = self.obstacles(tensordict, union)
        unknown = (union == UNKNOWN) & target_cells(obstacles, _of_living(position, alive))
        rows = unknown.flatten(-2).any(-1)
        if rows.any():
            blocked = _blocked(tensordict, obstacles)
            first, fruitful = self.search.first_moves(
                unknown[rows],
                (obstacles | blocked)[rows],
                position[rows],
                alive[rows],
                self.sight,
            )
            way = union.masked_fill(blocked & (union == FREE), OCCUPIED)
            shared = way[rows].unsqueeze(1).expand(-1, *grid.shape[-3:])
            nearest, length = nearest_frontier(shared, position[rows])
            nearest = torch.where(length > 0, nearest, STAY)
            move[rows] = torch.where(fruitful.unsqueeze(-1), first, nearest)
        return move


def _of_living(position: Tensor, alive: Tensor) -> Tensor:
    """Positions [*B, N, 2], those of robots that failed replaced by that of a living one."""
    one = alive.byte().argmax(-1)[..., None, None].expand(*alive.shape[:-1], 1, 2)
    return torch.where(alive.unsqueeze(-1), position, position.gather(-2, one))


def _blocked(tensordict: TensorDictBase, obstacles: Tensor) -> Tensor:
    """Cells that hold robots that failed, or people, bool [*B, H, W]."""
    position, alive = (tensordict.get(("agents", key)) for key in ("position", "alive"))
    width = obstacles.shape[-1]
    held = torch.zeros_like(obstacles, dtype=torch.int64).flatten(-2)
    held = held.scatter_add_(-1, flat_cell(position, width), (~alive).long()) > 0
    walkers = tensordict.get("walkers", None)
    if walkers is not None:
        held = held.scatter(-1, flat_cell(walkers, width), True)
    return held.view(obstacles.shape)


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
    most = sum(config.each_robot(config.max_discovery))
    if config.line_of_sight:  # a step past a wall may bring in the whole shape
        most = sum(config.each_robot(one_if_equal(config.sight.sizes)))
    return (missing / most).ceil().long()

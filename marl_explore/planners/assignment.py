"""Frontier assignment among linked robots, by each robot on its own map (Burgard et al. 2005)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from scipy.optimize import linear_sum_assignment
from tensordict import TensorDictBase
from torch import Tensor

from marl_explore.core.frontier import frontier_mask, paths
from marl_explore.core.grid import OCCUPIED, STAY, flat_cell, straight_distances
from marl_explore.planners.base import Planner
from marl_explore.planners.communication import CommunicationRule

DETOUR = 4
"""Moves added to another robot's straight distance where the map has no path for it."""


class Auction(NamedTuple):
    """The views of M robots on who could go where: N robots, C cells."""

    me: Tensor
    """Which of the robots is deciding, int64 [M]."""
    present: Tensor
    """Linked robots, including the deciding one, bool [M, N]."""
    frontier: Tensor
    """Frontiers that the deciding robot can reach, bool [M, C]."""
    distance: Tensor
    """Moves of each robot to each cell, float32 [M, N, C]."""
    width: int
    """Cells per row."""


Assignment = Callable[[Auction], Tensor]
"""From an auction to the deciding robots' frontiers, int64 [M]; any cell where there is none."""


@dataclass(frozen=True)
class UtilityCost:
    """The best pair by utility minus cost goes first; frontiers near the chosen one lose utility.

    Args:
        cost: of a move, in units of a frontier's utility.
        reach: distance up to which a chosen frontier lowers the utility of others (cells).
        by_number: whether robots choose in the order of their numbers instead.
    """

    cost: float = 0.1
    reach: int = 3
    by_number: bool = False

    def __call__(self, auction: Auction) -> Tensor:
        """Frontier of each deciding robot, int64 [M]."""
        robots = auction.present.shape[1]
        utility = torch.where(auction.frontier, 1.0, -torch.inf)
        waiting = auction.present.clone()
        target = torch.zeros_like(auction.me)
        rows = torch.arange(len(target), device=target.device)
        for turn in range(robots):
            value = utility.unsqueeze(1) - self.cost * auction.distance
            value = value.masked_fill(~waiting.unsqueeze(-1), -torch.inf)
            robot = torch.full_like(target, turn) if self.by_number else value.amax(-1).argmax(-1)
            best, cell = value[rows, robot].max(-1)
            chosen = best > -torch.inf
            target = torch.where(chosen & (robot == auction.me), cell, target)
            waiting[rows, robot] = False
            loss = (1 - _apart(cell, auction) / (self.reach + 1)).clamp_min(0)
            utility = utility - loss * chosen.unsqueeze(-1)
        return target


def hungarian(auction: Auction) -> Tensor:
    """Assigns one frontier each with the smallest total distance (Kuhn's Hungarian method)."""
    target = torch.zeros_like(auction.me)
    for row, (me, present, frontier) in enumerate(
        zip(auction.me.tolist(), auction.present, auction.frontier, strict=True)
    ):
        cells, robots = frontier.nonzero().squeeze(-1), present.nonzero().squeeze(-1)
        if len(cells):
            cost = auction.distance[row][robots][:, cells]
            who, where = linear_sum_assignment(cost.numpy())
            mine = where[robots[who].numpy() == me]
            # more robots than frontiers: a robot without one goes to the nearest
            own = auction.distance[row, me, cells].argmin() if not len(mine) else mine[0]
            target[row] = cells[int(own)]
    return target


class FrontierAssignment(Planner):
    """Every robot assigns its map's frontiers to the linked robots and walks to its own.

    Args:
        communicate: when a robot communicates.
        assign: the assignment of frontiers.
    """

    def __init__(self, communicate: CommunicationRule, assign: Assignment) -> None:
        super().__init__(communicate)
        self.assign = assign

    def plan(self, tensordict: TensorDictBase) -> Tensor:
        """First move to the robot's frontier, or STAY where it can reach none, int64 [*B, N]."""
        grid = tensordict.get(("agents", "map"))
        position = tensordict.get(("agents", "position"))
        linked = tensordict.get(("agents", "linked"))
        *batch, robots, height, width = grid.shape
        grid, position = grid.view(-1, robots, height, width), position.view(-1, robots, 2)
        me = torch.arange(robots, device=grid.device).expand(len(grid), -1)

        direction, own = paths(_with_neighbors(grid, position), position)
        views = grid.unsqueeze(2).expand(-1, -1, robots, -1, -1)
        others = position.unsqueeze(1).expand(-1, robots, -1, -1)
        _, distance = paths(views, others)
        distance = distance.flatten(-2).float()
        straight = straight_distances(others, height, width).flatten(-2)
        distance = torch.where((distance > 0) | (straight == 0), distance, straight + DETOUR)
        rows = torch.arange(robots, device=grid.device)
        distance[:, rows, rows] = own.flatten(-2).float()

        reachable = (frontier_mask(grid) & (own > 0)).flatten(-2)
        auction = Auction(
            me=me.flatten(),
            present=linked.reshape(-1, robots),
            frontier=reachable.flatten(0, 1),
            distance=distance.flatten(0, 1),
            width=width,
        )
        target = self.assign(auction).view(-1, robots, 1)
        move = direction.flatten(-2).gather(-1, target).squeeze(-1)
        return torch.where(reachable.any(-1), move, STAY).view(*batch, robots)


def _with_neighbors(grid: Tensor, position: Tensor) -> Tensor:
    """Maps in which other robots next to a robot count as obstacles, int8 [B, N, H, W]."""
    width = grid.shape[-1]
    apart = (position.unsqueeze(1) - position.unsqueeze(2)).abs().amax(-1)
    cell = flat_cell(position, width)
    # farther robots are replaced by the robot itself, whose own cell does not block it
    cell = torch.where(apart <= 1, cell.unsqueeze(1), cell.unsqueeze(2))
    return grid.flatten(-2).scatter(-1, cell, OCCUPIED).view(grid.shape)


def _apart(cell: Tensor, auction: Auction) -> Tensor:
    """Moves on an empty grid from cells int64 [M] to all cells, float32 [M, C]."""
    width = auction.width
    position = torch.stack((cell // width, cell % width), -1)
    return straight_distances(position, auction.frontier.shape[1] // width, width).flatten(-2)

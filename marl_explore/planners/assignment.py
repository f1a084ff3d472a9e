"""Frontier assignment among linked robots, by each robot on its own map (Burgard et al. 2005)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from scipy.optimize import linear_sum_assignment
from tensordict import TensorDictBase
from torch import Tensor

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.constants import DETOUR_CELLS, MOVE_COST, RIVAL_REACH
from marl_explore.core.frontier import frontier_mask, paths_to
from marl_explore.core.grid import OCCUPIED, STAY, flat_cell
from marl_explore.planners.base import Planner
from marl_explore.planners.communication import CommunicationRule


class Auction(NamedTuple):
    """The views of M robots on who could go where: N robots, F frontier cells at most."""

    me: Tensor
    """Which of the robots is deciding, int64 [M]."""
    present: Tensor
    """Linked robots, including the deciding one, bool [M, N]."""
    cell: Tensor
    """Frontier cells of the deciding robot's map, int64 [M, F]; 0 as padding."""
    frontier: Tensor
    """Which of them the deciding robot can reach, bool [M, F]."""
    distance: Tensor
    """Moves of each linked robot to each of them, float32 [M, N, F]."""
    width: int
    """Cells per row of the map."""


Assignment = Callable[[Auction], Tensor]
"""From an auction to the deciding robots' choices among their frontiers, int64 [M]; any where there
is none."""


@dataclass(frozen=True)
class UtilityCost:
    """The best pair by utility minus cost goes first; frontiers near the chosen one lose utility.

    Args:
        cost: of a move, in units of a frontier's utility.
        reach: distance up to which a chosen frontier lowers the utility of others (cells).
        by_number: whether robots choose in the order of their numbers instead.
    """

    cost: float = MOVE_COST
    reach: int = RIVAL_REACH
    by_number: bool = False

    def __call__(self, auction: Auction) -> Tensor:
        """Choice of each deciding robot, int64 [M]."""
        turns = auction.present.shape[1] if self.by_number else int(auction.present.sum(-1).max())
        utility = torch.where(auction.frontier, 1.0, -torch.inf)
        waiting = auction.present.clone()
        target = torch.zeros_like(auction.me)
        rows = torch.arange(len(target), device=target.device)
        for turn in range(turns):
            value = utility.unsqueeze(1) - self.cost * auction.distance
            value = value.masked_fill(~waiting.unsqueeze(-1), -torch.inf)
            robot = torch.full_like(target, turn) if self.by_number else value.amax(-1).argmax(-1)
            best, choice = value[rows, robot].max(-1)
            chosen = best > -torch.inf
            target = torch.where(chosen & (robot == auction.me), choice, target)
            waiting[rows, robot] = False
            loss = (1 - _apart(auction, choice) / (self.reach + 1)).clamp_min(0)
            utility = utility - loss * chosen.unsqueeze(-1)
        return target


def hungarian(auction: Auction) -> Tensor:
    """Assigns one frontier each with the smallest total distance (Kuhn's Hungarian method)."""
    target = torch.zeros_like(auction.me)
    for row, (me, present, frontier) in enumerate(
        zip(auction.me.tolist(), auction.present, auction.frontier, strict=True)
    ):
        places, robots = frontier.nonzero().squeeze(-1), present.nonzero().squeeze(-1)
        if len(places):
            cost = auction.distance[row][robots][:, places]
            who, where = linear_sum_assignment(cost.cpu().numpy())
            mine = where[robots[who].cpu().numpy() == me]
            # more robots than frontiers: a robot without one goes to the nearest
            own = auction.distance[row, me, places].argmin() if not len(mine) else mine[0]
            target[row] = places[int(own)]
    return target


class FrontierAssignment(Planner):
    """Every robot assigns its map's frontiers to the linked robots and walks to its own.

    Args:
        communicate: when a robot communicates.
        assign: the assignment of frontiers.
        config: as for ``Planner``.
    """

    def __init__(
        self,
        communicate: CommunicationRule,
        assign: Assignment,
        config: ArenaConfig | None = None,
    ) -> None:
        super().__init__(communicate, config)
        self.assign = assign

    def plan(self, tensordict: TensorDictBase) -> Tensor:
        """First move to the robot's frontier, or STAY where it can reach none, int64 [*B, N]."""
        grid = tensordict.get(("agents", "map"))
        position = tensordict.get(("agents", "position"))
        linked = tensordict.get(("agents", "linked"))
        *batch, robots, height, width = grid.shape
        grid, position = grid.reshape(-1, robots, height, width), position.reshape(-1, robots, 2)
        linked = linked.reshape(-1, robots, robots)
        auction, move = _auction(grid, position, linked)
        choice = self.assign(auction).unsqueeze(-1)
        move = torch.where(auction.frontier.any(-1), move.gather(-1, choice).squeeze(-1), STAY)
        return move.view(*batch, robots)


def _auction(grid: Tensor, position: Tensor, linked: Tensor) -> tuple[Auction, Tensor]:
    """The auction of all robots of teams [B], and their first moves to their frontiers [M, F]."""
    robots, _, width = grid.shape[1:]
    passable = _with_neighbors(grid, position, linked).flatten(0, 1)
    present = linked.flatten(0, 1)
    grid = grid.flatten(0, 1)
    cell, listed = _listed(frontier_mask(grid).flatten(1))
    own = flat_cell(position, width).flatten()
    rows = torch.arange(len(grid), device=grid.device)
    me = rows % robots
    # a robot's own paths lead around its neighbours, those of the others need not
    others = present.clone()
    others[rows, me] = False
    row, other = others.nonzero().unbind(-1)
    place = own[row - me[row] + other]
    move, length = paths_to(passable, cell, rows, own)
    _, of_others = paths_to(grid, cell, row, place)
    straight = _moves_between(place.unsqueeze(-1), cell[row], width)
    of_others = torch.where((of_others > 0) | (straight == 0), of_others, straight + DETOUR_CELLS)
    distance = torch.zeros(*present.shape, cell.shape[1], dtype=torch.float32, device=grid.device)
    distance[row, other] = of_others.float()
    distance[rows, me] = length.float()
    return Auction(me, present, cell, listed & (length > 0), distance, width), move


def _listed(mask: Tensor) -> tuple[Tensor, Tensor]:
    """The cells of sets bool [M, C] as lists int64 [M, F], and where those are filled, bool."""
    row, cell = mask.nonzero().unbind(-1)
    number = mask.sum(-1)
    most = max(1, int(number.max()))
    place = torch.arange(len(row), device=mask.device) - (number.cumsum(0) - number)[row]
    cells = torch.zeros(len(mask), most, dtype=torch.int64, device=mask.device)
    cells[row, place] = cell
    return cells, torch.arange(most, device=mask.device) < number.unsqueeze(-1)


def _with_neighbors(grid: Tensor, position: Tensor, linked: Tensor) -> Tensor:
    """Maps in which linked robots next to a robot count as obstacles, int8 [B, N, H, W].

    Others give way by chance: two robots that go round each other could do so forever.
    """
    width = grid.shape[-1]
    apart = (position.unsqueeze(1) - position.unsqueeze(2)).abs().amax(-1)
    cell = flat_cell(position, width)
    # other robots are replaced by the robot itself, whose own cell does not block it
    cell = torch.where((apart <= 1) & linked, cell.unsqueeze(1), cell.unsqueeze(2))
    return grid.flatten(-2).scatter(-1, cell, OCCUPIED).view(grid.shape)


def _apart(auction: Auction, choice: Tensor) -> Tensor:
    """Moves on an empty grid from choices int64 [M] to all frontiers, float32 [M, F]."""
    chosen = auction.cell.gather(-1, choice.unsqueeze(-1))
    return _moves_between(chosen, auction.cell, auction.width).float()


def _moves_between(cell: Tensor, others: Tensor, width: int) -> Tensor:
    """Moves between cells on an empty grid with rows of ``width`` cells, int64."""
    rows = (cell // width - others // width).abs()
    return torch.maximum(rows, (cell % width - others % width).abs())

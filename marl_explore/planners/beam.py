"""Joint beam search: what a small team should do next, on a map whose unknown cells count as free.

The robots of a plan move in turns. Every turn extends each of the best plans so far by one robot's
nine ways to go on, values the results and keeps the best. A plan is worth the cells its robots will
see, the sooner the better, less how far the cells that stay unknown are from the nearest robot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from marl_explore.core.grid import (
    COMPASS,
    NUM_DIRECTIONS,
    STAY,
    flat_cell,
    squares,
    straight_distances,
)
from marl_explore.core.hashing import combine
from marl_explore.core.mapping import closed_diagonals
from marl_explore.core.wavefront import all_distances

_MOVES = NUM_DIRECTIONS + 1  # and STAY
_ALL, _FAR = 255, 255
MOST_CELLS_WITH_PATHS = 400
"""On larger grids distances are those of an empty one: paths between all cells cost too much."""
_MOVE_PLACES = [3 * (1 + row) + 1 + column for row, column in (*COMPASS, (0, 0))]
"""Places of the moves in a flattened 3 x 3 square."""
_FAVOUR = 1e-3
"""What a move is worth more than to stay; equal plans differ by less."""


class Board(NamedTuple):
    """What follows from the size of a grid of C = H W cells; off it the own cell stands in."""

    near: Tensor
    """Cells of the eight moves and of staying, int64 [C, 9]."""
    inside: Tensor
    """Whether they are on the grid, bool [C, 9]."""
    seen: Tensor
    """Cells in view, int64 [C, (2k + 1)^2]."""
    around: Tensor
    """Cells in view after some move, int64 [C, (2k + 3)^2]."""
    distance: Tensor
    """Moves between two cells of an empty grid, uint8 [1, C, C], at most _FAR."""
    place: Tensor
    """Numbers whose sums tell apart the middles between two cells, int64 [C]."""


@lru_cache(maxsize=8)
def board(height: int, width: int, radius: int, device: torch.device) -> Board:
    """The tables of a grid and a field of view."""
    row, column = torch.meshgrid(
        torch.arange(height, device=device), torch.arange(width, device=device), indexing="ij"
    )
    cells = torch.stack((row, column), -1).flatten(0, 1)

    def shifted(offsets: Tensor) -> tuple[Tensor, Tensor]:
        place = cells.unsqueeze(1) + offsets
        size = torch.tensor((height, width), device=device)
        inside = ((place >= 0) & (place < size)).all(-1)
        own = torch.arange(len(cells), device=device).unsqueeze(-1)
        return torch.where(inside, flat_cell(place, width), own), inside

    near, inside = shifted(torch.tensor((*COMPASS, (0, 0)), device=device))
    apart = straight_distances(cells, height, width).flatten(-2)
    return Board(
        near=near,
        inside=inside,
        seen=squares(height, width, radius, device),
        around=squares(height, width, radius + 1, device),
        distance=apart.clamp_max(_FAR).to(torch.uint8).unsqueeze(0),
        place=flat_cell(cells, 2 * width),
    )


class Plans(NamedTuple):
    """The K best plans of M problems for N robots."""

    cell: Tensor
    """Where each robot is now, int64 [M, K, N]."""
    before: Tensor
    """Where it was when the step began, int64 [M, K, N]."""
    first: Tensor
    """Its first move, int64 [M, K, N]."""
    unknown: Tensor
    """Cells that are still unknown, uint8 [M, K, C], _ALL or 0."""
    code: Tensor
    """Hash of the unknown cells, int64 [M, K]."""
    seen: Tensor
    """Discounted cells seen so far, float32 [M, K]; -inf where there is no plan."""

    def of(self, parent: Tensor) -> Plans:
        """The plans with the indices int64 [M, K']."""
        return Plans(
            *(
                entry.gather(
                    1,
                    parent.view(*parent.shape, *[1] * (entry.ndim - 2)).expand(
                        *parent.shape, *entry.shape[2:]
                    ),
                )
                for entry in self
            )
        )


class Problem(NamedTuple):
    """What M problems are about."""

    board: Board
    occupied: Tensor
    """Known obstacles, bool [M, C]."""
    present: Tensor
    """Robots that take part, bool [M, N]."""
    distance: Tensor
    """Moves between two cells, uint8 [M or 1, C, C], at most _FAR."""

    def away(self, cell: Tensor) -> Tensor:
        """Moves from cells int64 [M, ...] to all cells, uint8 [M, ..., C]."""
        count, cells, _ = self.distance.shape
        first = cells * torch.arange(count, device=cell.device)
        row = cell + first.view(-1, *[1] * (cell.ndim - 1))
        return self.distance.flatten(0, 1).index_select(0, row.flatten()).view(*cell.shape, -1)


@dataclass(frozen=True)
class BeamSearch:
    """Settings of the search.

    Args:
        width: plans K that are kept.
        horizon: steps that are looked ahead.
        discount: of cells seen a step later.
        distance_weight: price of an unknown cell's distance to the nearest robot (1 / moves).
    """

    width: int = 24
    horizon: int = 10
    discount: float = 0.95
    distance_weight: float = 0.1

    def first_moves(
        self, unknown: Tensor, occupied: Tensor, position: Tensor, present: Tensor, radius: int
    ) -> tuple[Tensor, Tensor]:
        """The first move of every robot in the best plan.

        Args:
            unknown: cells worth seeing, bool [M, H, W].
            occupied: cells known to be obstacles, bool [M, H, W].
            position: int64 [M, N, 2].
            present: robots that take part, bool [M, N].
            radius: half side of the field of view (cells).

        Returns:
            Directions or STAY, int64 [M, N]; and whether the plan sees any cell, bool [M].
        """
        height, width = unknown.shape[-2:]
        tables = board(height, width, radius, unknown.device)
        distance = tables.distance
        if height * width <= MOST_CELLS_WITH_PATHS:
            distance = all_distances(~occupied, longest=_FAR)
        problem = Problem(tables, occupied.flatten(1), present, distance)
        plans = _start(unknown.flatten(1), flat_cell(position, width))
        weight = 1.0
        for step in range(self.horizon):
            plans = plans._replace(before=plans.cell)
            for robot in range(position.shape[-2]):
                plans, move = self._turn(problem, plans, robot, weight)
                if step == 0:
                    plans.first[..., robot] = move
            weight *= self.discount
        return plans.first[:, 0], plans.seen[:, 0] > 0

    def _turn(
        self, problem: Problem, plans: Plans, robot: int, weight: float
    ) -> tuple[Plans, Tensor]:
        """The best plans after one robot's move, and that move, int64 [M, K]."""
        own = plans.cell[..., robot]
        target = problem.board.near[own]
        around = problem.board.around[own]
        unknown = plans.unknown.gather(-1, around).bool()
        new = _per_move(unknown)
        # cells about to be seen are taken to be one move away
        remote = _remoteness(problem, plans, robot, target) - new
        seen = plans.seen.unsqueeze(-1) + weight * new
        value = seen - weight * self.distance_weight * remote
        value[..., STAY] -= _FAVOUR
        value.masked_fill_(~_open_moves(problem, plans, robot, target), -torch.inf)
        code = plans.code.unsqueeze(-1) - _per_move(unknown * _codes(0, problem)[around])

        value = _once(value, code + _places(problem, plans, robot, target))
        best = value.flatten(1).topk(min(self.width, value[0].numel())).indices
        parent, move = best // _MOVES, best % _MOVES
        plans = plans.of(parent)
        cell = target.flatten(1).gather(1, best)
        plans.cell[..., robot] = cell
        plans.unknown.scatter_(-1, problem.board.seen[cell], 0)
        alive = value.flatten(1).gather(1, best) > -torch.inf
        return plans._replace(
            code=code.flatten(1).gather(1, best),
            seen=seen.flatten(1).gather(1, best).masked_fill(~alive, -torch.inf),
        ), move


def _start(unknown: Tensor, cell: Tensor) -> Plans:
    """The one plan that has not begun, of unknown cells bool [M, C] and positions int64 [M, N]."""
    cell = cell.unsqueeze(1)
    return Plans(
        cell=cell,
        before=cell,
        first=torch.full_like(cell, STAY),
        unknown=unknown.unsqueeze(1).to(torch.uint8) * _ALL,
        code=torch.zeros_like(cell[..., 0]),
        seen=torch.zeros_like(cell[..., 0], dtype=torch.float32),
    )


def _per_move(around: Tensor) -> Tensor:
    """Sums over the cells in view after each move, [M, K, 9], of cells [M, K, (2k + 3)^2]."""
    side = math.isqrt(around.shape[-1])
    square = around.unflatten(-1, (side, side))
    sums = square.unfold(-2, side - 2, 1).unfold(-2, side - 2, 1).sum((-1, -2))
    return sums.flatten(-2)[..., _MOVE_PLACES]


def _open_moves(problem: Problem, plans: Plans, robot: int, target: Tensor) -> Tensor:
    """Moves that no obstacle and no other robot's move of the plan makes dangerous, [M, K, 9]."""
    own, place = plans.cell[..., robot], problem.board.place
    occupied = problem.occupied.gather(1, target.flatten(1)).view(target.shape)
    occupied |= ~problem.board.inside[own]
    occupied |= closed_diagonals(occupied)
    others = problem.present.clone()
    others[:, robot] = False
    others = others[:, None, None]
    for cells in (plans.cell, plans.before):
        occupied |= ((target.unsqueeze(-1) == cells.unsqueeze(-2)) & others).any(-1)
    middle = (place[own].unsqueeze(-1) + place[target]).unsqueeze(-1)
    ways = (place[plans.cell] + place[plans.before]).unsqueeze(-2)
    occupied |= ((middle == ways) & others).any(-1)
    occupied |= ~problem.present[:, robot, None, None]
    occupied[..., STAY] = False
    return ~occupied


def _remoteness(problem: Problem, plans: Plans, robot: int, target: Tensor) -> Tensor:
    """Sum over unknown cells of the moves from the nearest robot, after each of one robot's moves.

    Returns int32 [M, K, 9].
    """
    nearest = problem.away(target)
    absent = (~problem.present).to(torch.uint8) * _FAR
    nearest |= absent[:, robot, None, None, None]
    for other in range(problem.present.shape[-1]):
        if other != robot:
            away = problem.away(plans.cell[..., other]).unsqueeze(-2)
            away |= absent[:, other, None, None, None]
            nearest = torch.minimum(nearest, away, out=nearest)
    nearest &= plans.unknown.unsqueeze(-2)
    return nearest.sum(-1, dtype=torch.int32)


def _codes(kind: int, problem: Problem) -> Tensor:
    """A random number for each cell, int64 [C]."""
    return combine(kind, torch.arange(problem.occupied.shape[-1], device=problem.occupied.device))


def _places(problem: Problem, plans: Plans, robot: int, target: Tensor) -> Tensor:
    """Hash of where the robots are after each move and were before the step, int64 [M, K, 9]."""
    robots = plans.cell.shape[-1]
    code = torch.zeros_like(plans.code)
    for other in range(robots):
        code = code + _codes(1 + other, problem)[plans.before[..., other]]
        if other != robot:
            code = code + _codes(1 + robots + other, problem)[plans.cell[..., other]]
    return code.unsqueeze(-1) + _codes(1 + robots + robot, problem)[target]


def _once(value: Tensor, code: Tensor) -> Tensor:
    """Values [M, K, 9] with all but the best of equal hashes at -inf.

    Hashes that differ may meet in a bucket: few, and a plan that is lost so is hardly missed.
    """
    buckets = 16 * value[0].numel()
    value, bucket = value.flatten(1), code.flatten(1) % buckets
    order = torch.arange(value.shape[1], device=value.device) * (_FAVOUR / value.shape[1])
    value = value - order
    best = value.new_full((len(value), buckets), -torch.inf)
    best.scatter_reduce_(1, bucket, value, "amax")
    return value.masked_fill(value < best.gather(1, bucket), -torch.inf).view(code.shape)

"""Joint beam search for a small team, on a map whose unknown cells count as free.

The robots of a plan move in turns. Every turn extends each of the best plans so far by one robot's
nine possible moves, evaluates the results and keeps the best. The value of a plan is the number of
cells that its robots will see, discounted by time, minus the distances of the remaining unknown
cells to the nearest robot.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from marl_explore.config.shapes import Sight
from marl_explore.core.grid import NUM_DIRECTIONS, STAY, flat_cell
from marl_explore.core.mapping import closed_diagonals
from marl_explore.core.native import Backend
from marl_explore.core.native import beam as kernel
from marl_explore.core.native.choice import in_use
from marl_explore.core.wavefront import path_distances
from marl_explore.planners.grid_tables import (
    GridTables,
    all_hashes,
    cell_hashes,
    grid_tables,
    seen_windows,
)

_MOVES = NUM_DIRECTIONS + 1  # and STAY
_HIDDEN = torch.iinfo(torch.int16).max
"""More than any distance."""
MOST_TARGETS = 128
"""Maximum number of unknown cells to which distances are measured; of more, some represent all."""
LONGEST = _HIDDEN // MOST_TARGETS
"""Upper limit of distances, so that their sum fits into int16."""
_FAVOUR = 1e-3
"""Bonus of moving over staying; the bonuses that break ties between plans are smaller."""
_AT_ONCE = 2**21
"""Distances that a turn processes together: as many as fit into a processor's cache."""


class Plans(NamedTuple):
    """The K best plans of M problems for N robots."""

    cell: Tensor
    """Cell of each robot now, int64 [M, K, N]."""
    before: Tensor
    """Cell of each robot at the beginning of the step, int64 [M, K, N]."""
    first: Tensor
    """First move of each robot, int64 [M, K, N]."""
    unknown: Tensor
    """Cells that are still unknown, int16 [M, K, C], _HIDDEN or 0."""
    code: Tensor
    """Hash of the unknown cells, int64 [M, K]."""
    seen: Tensor
    """Discounted number of cells seen so far, float32 [M, K]; -inf where there is no plan."""

    def of(self, parent: Tensor) -> Plans:
        """The plans with the indices int64 [M, K']."""
        problems, plans = self.code.shape
        first = plans * torch.arange(problems, device=parent.device)
        row = (parent + first.unsqueeze(-1)).flatten()
        return Plans(
            *(e.flatten(0, 1).index_select(0, row).view(*parent.shape, *e.shape[2:]) for e in self)
        )


class Problem(NamedTuple):
    """The data of M problems."""

    tables: GridTables
    occupied: Tensor
    """Known obstacles, bool [M, C]."""
    target: Tensor
    """Unknown cells that represent all, then others as padding, int64 [M, U]."""
    share: Tensor
    """How many unknown cells each of them represents, float32 [M]."""
    distance: Tensor
    """Moves from all cells to those, int16 [M, C, U]."""
    visible: Tensor | None
    """``seen_windows`` of each robot, bool [M, N, C, (2k + 1)^2]; None: all of every window."""

    def away(self, cell: Tensor) -> Tensor:
        """Moves from cells int64 [M, ...] to the targets, int16 [M, ..., U]."""
        count, cells, _ = self.distance.shape
        first = cells * torch.arange(count, device=cell.device)
        row = cell + first.view(-1, *[1] * (cell.ndim - 1))
        return self.distance.flatten(0, 1).index_select(0, row.flatten()).view(*cell.shape, -1)

    def seen_from(self, robot: int, cell: Tensor) -> tuple[Tensor, Tensor]:
        """Cells that a robot sees from cells [M, ...], others replaced by those themselves.

        Returns:
            int64 [M, ..., (2k + 1)^2], and which of them it sees, bool.
        """
        cells = self.tables.seen[cell]
        if self.visible is None:
            return cells, self.tables.window[cell]
        rows = torch.arange(len(cell), device=cell.device).view(-1, *[1] * (cell.ndim - 1))
        seen = self.visible[rows, robot, cell]
        return torch.where(seen, cells, cell.unsqueeze(-1)), seen


@dataclass(frozen=True)
class BeamSearch:
    """Settings of the search.

    Args:
        width: number K of plans that are kept.
        horizon: number of steps to look ahead.
        discount: factor per step for cells seen later.
        distance_weight: cost of an unknown cell's distance to the nearest robot (1 / moves).
        backend: "torch", "native" (C, CPU tensors only), or "auto" (native where possible). The
            plans are equal.
    """

    width: int = 24
    horizon: int = 10
    discount: float = 0.95
    distance_weight: float = 0.1
    backend: Backend = "auto"

    def first_moves(
        self, unknown: Tensor, occupied: Tensor, position: Tensor, present: Tensor, sight: Sight
    ) -> tuple[Tensor, Tensor]:
        """The first move of every robot in the best plan.

        Robots expect to see the cells of their own shapes; where obstacles end sight, those that
        they would see if unknown cells were free.

        Args:
            unknown: unknown cells worth seeing, bool [M, H, W].
            occupied: cells known to be obstacles, bool [M, H, W].
            position: int64 [M, N, 2].
            present: participating robots, bool [M, N].
            sight: of the N robots.

        Returns:
            Directions or STAY, int64 [M, N]; and whether the plan sees any unknown cell, bool [M].
        """
        first = torch.full_like(position[..., 0], STAY)
        fruitful = torch.zeros_like(present[:, 0])
        size = present.sum(-1)
        members = torch.argsort(present.long(), dim=-1, descending=True, stable=True)
        left = unknown.flatten(1).sum(-1)
        order = left.argsort()  # group similar problems: the largest of a group determines its cost
        targets = min(MOST_TARGETS, int(left.max()))
        at_once = max(1, _AT_ONCE // (self.width * _MOVES * max(targets, 1)))
        for robots in range(1, present.shape[-1] + 1):
            for rows in order[size[order] == robots].split(at_once):
                if len(rows):
                    team = (rows.unsqueeze(-1), members[rows, :robots])
                    first[team], fruitful[rows] = self._search(
                        unknown[rows], occupied[rows], position[team], sight, team[1]
                    )
        return first, fruitful

    def _search(
        self, unknown: Tensor, occupied: Tensor, position: Tensor, sight: Sight, member: Tensor
    ) -> tuple[Tensor, Tensor]:
        """``first_moves`` of teams in which every robot participates, numbers ``member`` [M, N]."""
        height, width = unknown.shape[-2:]
        tables = grid_tables(height, width, sight.radius, unknown.device)
        target, share = _targets(unknown.flatten(1))
        distance = path_distances(~occupied, target, LONGEST).short().contiguous()
        visible = None
        if not sight.fills_windows:
            visible = seen_windows(tables, occupied.flatten(1), sight)
            rows = torch.arange(len(member), device=member.device).unsqueeze(-1)
            visible = visible[rows, member % visible.shape[1]]
        problem = Problem(tables, occupied.flatten(1), target, share, distance, visible)
        plans = _start(unknown.flatten(1), flat_cell(position, width))
        search = (
            self._in_c if in_use("beam values", self.backend, unknown.device) else self._in_torch
        )
        plans = search(problem, plans)
        return plans.first[:, 0], plans.seen[:, 0] > 0

    def _in_torch(self, problem: Problem, plans: Plans) -> Plans:
        """The best plans, from the initial ones."""
        weight = 1.0
        for step in range(self.horizon):
            plans = plans._replace(before=plans.cell.clone())
            for robot in range(plans.cell.shape[-1]):
                plans = self._turn(problem, plans, robot, weight, step == 0)
            weight *= self.discount
        return plans

    def _in_c(self, problem: Problem, plans: Plans) -> Plans:
        """``_in_torch`` in C, equal in every bit."""
        tables, robots = problem.tables, plans.cell.shape[-1]
        hashes = all_hashes(1 + 2 * robots, plans.unknown.shape[-1], plans.code.device)
        given = (
            *(problem.occupied, problem.target, problem.share, problem.distance, problem.visible),
            *(tables.near, tables.inside, tables.seen, tables.window, tables.place, hashes),
        )
        search = kernel.Search(plans, given, self.width)
        weight = 1.0
        for step in range(self.horizon):
            search.begin_step()
            for robot in range(robots):
                of_distance = weight * self.distance_weight
                search.take_turn(robot, step == 0, weight, of_distance, _FAVOUR)
            weight *= self.discount
        return Plans(*search.plans)

    def _turn(
        self, problem: Problem, plans: Plans, robot: int, weight: float, is_first: bool
    ) -> Plans:
        """The best plans after one robot's move, which is noted if it is the first one."""
        value, seen, code = self._values(problem, plans, robot, weight)
        best_value, best = value.topk(min(self.width, value.shape[1]))
        plans, move = plans.of(best // _MOVES), best % _MOVES
        cell = problem.tables.near[plans.cell[..., robot], move]
        plans.cell[..., robot] = cell
        if is_first:
            plans.first[..., robot] = move
        seen_cells, _ = problem.seen_from(robot, cell)
        plans.unknown.scatter_(-1, seen_cells, 0)
        return plans._replace(
            code=code.gather(1, best),
            seen=seen.gather(1, best).masked_fill(best_value == -torch.inf, -torch.inf),
        )

    def _values(
        self, problem: Problem, plans: Plans, robot: int, weight: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        """What is known of each move of a robot in each plan, [M, K 9] each.

        Returns:
            Its value, float32, -inf for moves that are not open and for all but the best of equal
            plans; the discounted number of seen cells, float32; the hash of the others, int64.
        """
        target = problem.tables.near[plans.cell[..., robot]]
        new, new_code = _new(problem, plans, robot)
        # cells about to be seen count as one move away
        remote = _remoteness(problem, plans, robot, target) - new
        seen = plans.seen.unsqueeze(-1) + weight * new
        value = seen - weight * self.distance_weight * remote
        value[..., STAY] -= _FAVOUR
        value.masked_fill_(~_open_moves(problem, plans, robot, target), -torch.inf)
        code = plans.code.unsqueeze(-1) - new_code
        value = _once(value, code + _places(plans, robot, target))
        return value, seen.flatten(1), code.flatten(1)


def _targets(unknown: Tensor) -> tuple[Tensor, Tensor]:
    """``Problem.target`` and ``Problem.share``, chosen evenly from unknown cells bool [M, C]."""
    number = unknown.sum(-1, keepdim=True)
    targets = int(number.max().clamp(1, MOST_TARGETS))
    most = number.clamp_min(targets)
    place = torch.arange(targets, device=unknown.device) * most // targets
    cells = torch.argsort(unknown.byte(), dim=-1, descending=True, stable=True)
    return cells.gather(1, place), (most / targets).squeeze(-1)


def _start(unknown: Tensor, cell: Tensor) -> Plans:
    """The initial plan, from unknown cells bool [M, C] and positions int64 [M, N]."""
    cell = cell.unsqueeze(1)
    return Plans(
        cell=cell,
        before=cell,
        first=torch.full_like(cell, STAY),
        unknown=unknown.unsqueeze(1).short() * _HIDDEN,
        code=torch.zeros_like(cell[..., 0]),
        seen=torch.zeros_like(cell[..., 0], dtype=torch.float32),
    )


def _new(problem: Problem, plans: Plans, robot: int) -> tuple[Tensor, Tensor]:
    """Number of new cells that each move of a robot sees, float32 [M, K, 9], and their hash."""
    if problem.visible is not None:
        return _new_in_sight(problem, plans, robot)
    around = problem.tables.around[plans.cell[..., robot]]
    unknown = plans.unknown.gather(-1, around).clamp_max_(1).double()
    code = cell_hashes(0, plans.unknown.shape[-1], around.device)[around]
    number, code = torch.stack((unknown, unknown * code)) @ problem.tables.views
    return number.float(), code.long()


def _new_in_sight(problem: Problem, plans: Plans, robot: int) -> tuple[Tensor, Tensor]:
    """``_new`` where robots do not see all of their windows."""
    cells, seen = problem.seen_from(robot, problem.tables.near[plans.cell[..., robot]])
    unknown = plans.unknown.gather(-1, cells.flatten(2)).view(cells.shape) != 0
    new = unknown & seen
    code = cell_hashes(0, plans.unknown.shape[-1], cells.device)[cells]
    return new.sum(-1).float(), (code * new).sum(-1)


def _open_moves(problem: Problem, plans: Plans, robot: int, target: Tensor) -> Tensor:
    """Moves that are not dangerous, given obstacles and the plan's other moves, [M, K, 9]."""
    own, place = plans.cell[..., robot], problem.tables.place
    occupied = problem.occupied.gather(1, target.flatten(1)).view(target.shape)
    occupied |= ~problem.tables.inside[own]
    occupied |= closed_diagonals(occupied)
    middle = place[own].unsqueeze(-1) + place[target]
    for other in range(plans.cell.shape[-1]):
        if other != robot:
            now, before = (c[..., other].unsqueeze(-1) for c in (plans.cell, plans.before))
            occupied |= (
                (target == now) | (target == before) | (middle == place[now] + place[before])
            )
    occupied[..., STAY] = False
    return ~occupied


def _remoteness(problem: Problem, plans: Plans, robot: int, cell: Tensor) -> Tensor:
    """Sum over unknown cells of the moves from the nearest robot, float32 [M, K, 9].

    Args:
        problem: the problems.
        plans: the plans so far.
        robot: the robot that moves.
        cell: cells that it can move to, int64 [M, K, 9].
    """
    target = problem.target.unsqueeze(1).expand(-1, plans.unknown.shape[1], -1)
    nearest = plans.unknown.gather(-1, target)
    for other in range(plans.cell.shape[-1]):
        if other != robot:
            nearest = torch.minimum(nearest, problem.away(plans.cell[..., other]))
    away = problem.away(cell)
    torch.minimum(away, nearest.unsqueeze(-2), out=away)
    return away.sum(-1, dtype=torch.int16) * problem.share[:, None, None]


def _places(plans: Plans, robot: int, target: Tensor) -> Tensor:
    """Hash of the robots' cells after each move and before the step, int64 [M, K, 9]."""
    robots, cells = plans.cell.shape[-1], plans.unknown.shape[-1]
    code = torch.zeros_like(plans.code)
    for other in range(robots):
        code = code + cell_hashes(1 + other, cells, code.device)[plans.before[..., other]]
        if other != robot:
            code += cell_hashes(1 + robots + other, cells, code.device)[plans.cell[..., other]]
    return code.unsqueeze(-1) + cell_hashes(1 + robots + robot, cells, code.device)[target]


def _once(value: Tensor, code: Tensor) -> Tensor:
    """Values [M, K 9], with all but the best of equal hashes set to -inf.

    Different hashes may share a bucket; this is rare, and the loss of such a plan is harmless.
    """
    value = value.flatten(1)
    buckets = 1 << (16 * value.shape[1]).bit_length()
    bucket = code.flatten(1) & (buckets - 1)
    order = torch.arange(value.shape[1], device=value.device) * (_FAVOUR / value.shape[1])
    value = value - order
    best = value.new_full((len(value), buckets), -torch.inf)
    best.scatter_reduce_(1, bucket, value, "amax")
    return value.masked_fill(value < best.gather(1, bucket), -torch.inf)

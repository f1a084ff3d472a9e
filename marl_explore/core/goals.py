"""Candidate goals of each robot: where it could go next, and what is known about each place.

All entries are integers, so that every implementation gives the same ones; scaling them is the
business of those who read them. This module is the reference in torch; ``native.goals`` computes
the same in C. docs/goals.md describes every column.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from marl_explore.config.constants import DETOUR_CELLS, FAR_CELLS, GAIN_SQUARES, LARGE_POCKET
from marl_explore.config.constants import GOAL_COLUMNS as GOAL_COLUMNS
from marl_explore.config.constants import MAX_FRONTIERS as MAX_FRONTIERS
from marl_explore.config.shapes import Sight
from marl_explore.core.frontier import first_moves, frontier_mask
from marl_explore.core.grid import (
    FREE,
    NUM_DIRECTIONS,
    OCCUPIED,
    UNKNOWN,
    beside_any,
    compass,
    flat_cell,
    straight_distances,
)
from marl_explore.core.memory import TeamMemory
from marl_explore.core.native import Backend
from marl_explore.core.sight import expected_discoveries
from marl_explore.core.wavefront import nearest_distance
from marl_explore.core.ways import blocked_beside


class GoalTable(NamedTuple):
    """Candidate goals of every robot, int32."""

    frontiers: Tensor
    """[*B, N, 24, 14], the columns ``GOAL_COLUMNS``; all 0 in rows without a candidate."""
    rivals: Tensor
    """[*B, N, 24, N, 2]: moves of each teammate from where it was last seen, -1 if it never was;
    whether it surely knows the cell."""
    ways: Tensor
    """[*B, N, N, 2]: moves to where each teammate was last seen, and the first; 0, -1 if none."""
    all_covered: Tensor
    """Whether frontiers can be reached, all of them covered by teammates, bool [*B, N]."""


class Situation(NamedTuple):
    """What a robot's candidates depend on."""

    grid: Tensor
    """Maps, int8 [*B, N, H, W]."""
    position: Tensor
    """int64 [*B, N, 2]."""
    taken: Tensor
    """Cells of the eight directions that hold something that is not on the map, bool [*B, N, 8]."""
    allowed: Tensor
    """Allowed moves, bool [*B, N, 8]."""
    memory: TeamMemory

    @property
    def beside(self) -> Tensor:
        """Cells of the eight directions, row * W + column, int64 [*B, N, 8]; inside the map."""
        height, width = self.grid.shape[-2:]
        last = torch.tensor([height - 1, width - 1], device=self.grid.device)
        beside = (self.position.unsqueeze(-2) + compass(self.grid.device)).clamp_min(0)
        return flat_cell(torch.minimum(beside, last), width)


def taken_cells(fov: Tensor, grid: Tensor, position: Tensor, sight: Sight) -> Tensor:
    """Neighbouring cells that a robot sees to be blocked although its map has them free.

    Another robot or a person stands there. A diagonal neighbour between two obstacles, where those
    end sight, is none: it is not seen, and may be free.

    Args:
        fov: fields of view, float [*B, N, 2k + 1, 2k + 1], 1 where blocked or not seen.
        grid: maps, int8 [*B, N, H, W].
        position: int64 [*B, N, 2].
        sight: of the robots.

    Returns:
        bool [*B, N, 8].
    """
    blocked, shut = blocked_beside(fov, grid, position)
    return blocked & ~shut if sight.line_of_sight else blocked


def unseen_in_sight(
    situation: Situation, cell: Tensor, sight: Sight, backend: Backend = "auto"
) -> Tensor:
    """Unseen cells that each robot would see from cells of its map, int64 [*B, N, X].

    Args:
        situation: what each robot knows.
        cell: row * W + column, int64 [*B, N, X].
        sight: of the robots.
        backend: as for ``sight.expected_discoveries``.
    """
    grid, covered = situation.grid, situation.memory.covered
    left = grid.masked_fill(covered & (grid == UNKNOWN), FREE).reshape(-1, *grid.shape[-2:])
    robot = torch.arange(len(left), device=grid.device).repeat_interleave(cell.shape[-1])
    kind = robot % len(sight.ranges_cells)
    return expected_discoveries(left, robot, cell.flatten(), kind, sight, backend).view(cell.shape)


def goal_table(situation: Situation, sight: Sight) -> GoalTable:
    """The candidate goals of every robot of a batch of teams.

    Args:
        situation: what each robot knows.
        sight: of the robots.
    """
    flat = _Robots(situation, sight)
    chosen = flat.thinned()
    batch = situation.position.shape[:-1]
    return GoalTable(
        flat.frontiers(chosen).view(*batch, MAX_FRONTIERS, len(GOAL_COLUMNS)),
        flat.rivals(chosen).view(*batch, MAX_FRONTIERS, batch[-1], 2),
        flat.ways().view(*batch, batch[-1], 2),
        flat.all_covered.view(batch),
    )


class _Chosen(NamedTuple):
    """Candidate frontier cells [M, 24] of M robots."""

    cell: Tensor
    """Index in the flattened map; 0 where there is no candidate."""
    size: Tensor
    """Frontier cells that it stands for; 0 where there is no candidate."""


class _Robots:
    """The robots of a batch in one dimension, with what all columns need."""

    def __init__(self, situation: Situation, sight: Sight) -> None:
        self.situation, self.sight, memory = situation, sight, situation.memory
        *_, team, height, width = situation.grid.shape
        self.height, self.width, self.team = height, width, team
        self.grid = situation.grid.reshape(-1, height, width)
        radius = torch.tensor(sight.radii, device=self.grid.device).expand(team)
        self.radius = radius.repeat(len(self.grid) // team).unsqueeze(1)
        self.position = situation.position.reshape(-1, 2)
        self.allowed = situation.allowed.reshape(-1, NUM_DIRECTIONS)
        self.seen = (memory.seen.step >= 0).reshape(-1, team)
        self.place = memory.seen.cell.reshape(-1, team, 2)
        self.known_by = memory.known_by.reshape(-1, team, height * width)
        self.heading, self.goal = memory.heading.reshape(-1), memory.goal.reshape(-1, 2)
        self.unseen = (self.grid == UNKNOWN) & ~memory.covered.reshape(-1, height, width)
        counts = self.unseen.long().cumsum(-1).cumsum(-2)
        self.counts = torch.nn.functional.pad(counts, (1, 0, 1, 0)).flatten(1)
        self.beside = situation.beside.view(-1, NUM_DIRECTIONS)
        self.gains = self._in_sight(self.beside)
        self.labels, self.moves = first_moves(
            self.grid, self.position, self._closed(situation.taken.reshape(-1, NUM_DIRECTIONS))
        )
        reached = self.moves > 0
        self.open = (self.grid == FREE) & beside_any(self.unseen) & reached
        some = (frontier_mask(self.grid) & reached).flatten(-2).any(-1)
        self.all_covered = some & ~self.open.flatten(-2).any(-1)

    def _closed(self, taken: Tensor) -> Tensor:
        """Neighbouring cells that are taken, bool [M, H, W]."""
        closed = torch.zeros_like(self.grid, dtype=torch.uint8).flatten(1)
        return (
            closed.scatter_reduce(1, self.beside, taken.to(torch.uint8), "amax")
            .view(self.grid.shape)
            .bool()
        )

    def thinned(self) -> _Chosen:
        """Of the open frontier cells, the nearest first, those that are not close to another."""
        moves = self.moves.flatten(1)
        cells = torch.arange(moves.shape[1], device=moves.device)
        row, column = cells // self.width, cells % self.width
        order = torch.where(self.open.flatten(1), moves * len(cells) + cells, _NONE)
        near, middle = 2 * self.radius, 6 * self.radius
        spread = (moves > near).long() * self.radius + (moves > middle).long() * self.radius
        chosen, sizes = [], []
        for _ in range(MAX_FRONTIERS):
            cell = order.argmin(1, keepdim=True)
            left = order < _NONE
            apart = torch.maximum((row - row[cell]).abs(), (column - column[cell]).abs())
            absorbed = (apart <= spread) & (moves.gather(1, cell) > near)
            absorbed = (absorbed | (cells == cell)) & left
            chosen.append(cell)
            sizes.append(absorbed.sum(1, keepdim=True))
            order = order.masked_fill(absorbed, _NONE)
        size = torch.cat(sizes, 1)
        return _Chosen(torch.cat(chosen, 1) * (size > 0), size)

    def frontiers(self, chosen: _Chosen) -> Tensor:
        """``GoalTable.frontiers`` [M, 24, 14]."""
        cell, filled = chosen.cell, chosen.size > 0
        row, column = cell // self.width, cell % self.width
        move, gain, allowed = self._first_move(cell)
        columns = (
            row,
            column,
            self.moves.flatten(1).gather(1, cell),
            move,
            chosen.size,
            self._in_sight(cell),
            *(self._in_square(cell, factor * self.radius) for factor in GAIN_SQUARES[1:]),
            self._pocket(cell),
            self._isolation(row, column, filled),
            gain,
            allowed,
            self._turn(move),
            self._from_last_goal(row, column),
        )
        table = torch.stack(torch.broadcast_tensors(*columns), -1)
        return (table * filled.unsqueeze(-1)).int()

    def _in_sight(self, cell: Tensor) -> Tensor:
        """Unseen cells that each robot would see from cells [M, X]."""
        if self.sight.fills_windows:
            return self._in_square(cell, self.radius)
        cells = cell.view(*self.situation.position.shape[:-1], cell.shape[-1])
        return unseen_in_sight(self.situation, cells, self.sight, "torch").view(cell.shape)

    def _in_square(self, cell: Tensor, radius: Tensor) -> Tensor:
        """Unseen cells in the squares of radii [M, 1] around cells [M, X]."""
        row, column = cell // self.width, cell % self.width
        top, left = (row - radius).clamp_min(0), (column - radius).clamp_min(0)
        bottom = (row + radius + 1).clamp_max(self.height)
        right = (column + radius + 1).clamp_max(self.width)

        def above(row: Tensor, column: Tensor) -> Tensor:
            """Unseen cells above a row and to the left of a column."""
            return self.counts.gather(1, row * (self.width + 1) + column)

        below, higher = (above(edge, right) - above(edge, left) for edge in (bottom, top))
        return below - higher

    def _first_move(self, cell: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The first move to each cell [M, X], its gain, and whether it is allowed.

        Of the first moves of all shortest paths, an allowed one that brings most unseen cells into
        view, and of equal ones the lowest direction; -1 for cells without a path.
        """
        gains = self.gains
        directions = torch.arange(NUM_DIRECTIONS, device=cell.device)
        merit = (gains + self.allowed * 2 * gains.new_tensor(self.height * self.width)) + 1
        merit = merit * NUM_DIRECTIONS - directions
        first = self.labels.flatten(1).gather(1, cell).unsqueeze(-1) >> directions & 1
        best, move = (merit.unsqueeze(1) * first).max(-1)
        return (
            torch.where(best > 0, move, -1),
            gains.gather(1, move),
            self.allowed.long().gather(1, move),
        )

    def _pocket(self, cell: Tensor) -> Tensor:
        """Size of the largest unseen region beside each cell [M, X], at most LARGE_POCKET."""
        size = torch.nn.functional.pad(_region_sizes(self.unseen), (1, 1, 1, 1))
        beside = (size[:, :-2, 1:-1], size[:, 2:, 1:-1], size[:, 1:-1, :-2], size[:, 1:-1, 2:])
        largest = torch.stack(beside).amax(0).clamp_max(LARGE_POCKET)
        return largest.flatten(1).gather(1, cell)

    def _isolation(self, row: Tensor, column: Tensor, filled: Tensor) -> Tensor:
        """Distance to the nearest other candidate farther than k, at most FAR_CELLS."""
        apart = torch.maximum(
            (row.unsqueeze(1) - row.unsqueeze(2)).abs(),
            (column.unsqueeze(1) - column.unsqueeze(2)).abs(),
        )
        counted = filled.unsqueeze(1) & (apart > self.radius.unsqueeze(-1))
        return torch.where(counted, apart, FAR_CELLS).amin(-1)

    def _turn(self, move: Tensor) -> Tensor:
        """Eighths of a circle between a move and the last one, 0 to 4; -1 without a last one."""
        heading = self.heading.unsqueeze(1)
        around = (move - heading) % NUM_DIRECTIONS
        return torch.where(heading < 0, -1, torch.minimum(around, NUM_DIRECTIONS - around))

    def _from_last_goal(self, row: Tensor, column: Tensor) -> Tensor:
        """Straight distance from the last goal; -1 without one."""
        last_row, last_column = self.goal.unsqueeze(1).unbind(-1)
        apart = torch.maximum((row - last_row).abs(), (column - last_column).abs())
        return torch.where(last_row < 0, -1, apart)

    def rivals(self, chosen: _Chosen) -> Tensor:
        """``GoalTable.rivals`` [M, 24, N, 2]."""
        place = flat_cell(self.place, self.width)
        starts = torch.zeros_like(self.known_by).scatter(-1, place.unsqueeze(-1), True)
        grids = self.grid.repeat_interleave(self.team, 0)
        shape = (-1, self.height, self.width)
        length = nearest_distance(starts.view(shape), grids == FREE, grids != OCCUPIED)
        cell = chosen.cell.unsqueeze(1).expand(-1, self.team, -1)
        length = length.reshape(self.known_by.shape).gather(-1, cell).long()
        row, column = (entry.unsqueeze(-1) for entry in self.place.unbind(-1))
        apart = torch.maximum((row - cell // self.width).abs(), (column - cell % self.width).abs())
        length = torch.where(length < self.height * self.width, length, apart + DETOUR_CELLS)
        seen = self.seen.unsqueeze(-1)
        length = torch.where(seen, length, -1)
        known = self.known_by.gather(-1, cell) & seen
        table = torch.stack((length, known.long()), -1).transpose(1, 2)
        return (table * (chosen.size > 0)[..., None, None]).int()

    def ways(self) -> Tensor:
        """``GoalTable.ways`` [M, N, 2]."""
        moves = self.moves.flatten(1)
        own = flat_cell(self.position, self.width).unsqueeze(1)
        reached = (moves > 0).scatter(1, own, True)
        apart = straight_distances(self.place, self.height, self.width).flatten(-2).long()
        cells = moves.shape[1]
        order = (apart * cells + moves.unsqueeze(1)) * cells + torch.arange(
            cells, device=moves.device
        )
        cell = torch.where(reached.unsqueeze(1), order, _NONE).argmin(-1)
        length = moves.gather(1, cell)
        rest = apart.gather(-1, cell.unsqueeze(-1)).squeeze(-1)
        move, _, _ = self._first_move(cell)
        walks = self.seen & (length > 0)
        table = torch.stack(
            (torch.where(walks, length + rest, 0), torch.where(walks, move, -1)), -1
        )
        return table.int()


_NONE = 2**62
"""Order of cells that are no candidates."""


def _region_sizes(cells: Tensor) -> Tensor:
    """For every cell of a set bool [M, H, W], the size of its 4-connected region; 0 outside it."""
    count = cells[0].numel()
    numbers = torch.arange(1, count + 1, device=cells.device).view(cells.shape[1:])
    label = numbers * cells
    while True:
        padded = torch.nn.functional.pad(label, (1, 1, 1, 1))
        beside = (
            padded[:, :-2, 1:-1],
            padded[:, 2:, 1:-1],
            padded[:, 1:-1, :-2],
            padded[:, 1:-1, 2:],
        )
        highest = torch.stack((label, *beside)).amax(0) * cells
        # follow the label's own label, so that long regions take few rounds
        flat = torch.nn.functional.pad(highest.flatten(1), (1, 0))
        highest = torch.maximum(highest, flat.gather(1, highest.flatten(1)).view(cells.shape))
        if torch.equal(highest, label):
            break
        label = highest
    flat = label.flatten(1)
    size = torch.zeros(len(cells), count + 1, dtype=flat.dtype, device=flat.device)
    size.scatter_add_(1, flat, torch.ones_like(flat))
    return size.gather(1, flat).view(cells.shape) * cells

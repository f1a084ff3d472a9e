"""Short-horizon joint planning on the own map, with communication at times known to all."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from marl_explore.config.arena import ArenaConfig
from marl_explore.core.frontier import frontier_mask, nearest_frontier, paths
from marl_explore.core.grid import (
    COMMUNICATE,
    OCCUPIED,
    STAY,
    UNKNOWN,
    flat_cell,
    straight_distances,
)
from marl_explore.core.links import any_linked
from marl_explore.core.mapping import target_cells
from marl_explore.core.memory import (
    PATIENCE_STEPS,
    Sightings,
    last_place,
    no_sightings,
    surely_seen,
    update_sightings,
    where_begun,
)
from marl_explore.core.motion import in_turn
from marl_explore.planners.base import Planner
from marl_explore.planners.beam import BeamSearch
from marl_explore.planners.communication import CommunicationRule

WINDOW = 24
"""Side of the window of a large arena in which a robot plans (cells)."""


class Rendezvous(Planner):
    """Robots that plan jointly for all that they saw recently, and meet when nothing else is left.

    A robot treats cells that linked robots must have seen as known, searches for the best joint
    plan for itself and the robots that it saw recently, and makes its own first move. If the plan
    sees nothing new, it walks to the nearest frontier. When only cells that others have seen are
    left, it communicates, or walks to where it last saw another robot; if that takes too long, it
    explores those cells itself.

    Args:
        config: the arena.
        communicate: when robots exchange maps.
        search: the joint plan.
        memory_steps: how long an unlinked robot is assumed to be where it was last seen.
        patience_steps: how long a robot with only others' cells left looks for the others.
        answer: whether a robot communicates next to one that stands still.
    """

    sees = "own map, positions of robots in range and where it saw them last, a clock"

    def __init__(
        self,
        config: ArenaConfig,
        communicate: CommunicationRule,
        search: BeamSearch | None = None,
        memory_steps: int = 8,
        patience_steps: int = PATIENCE_STEPS,
        answer: bool = True,
    ) -> None:
        super().__init__(communicate, config)
        self.sight, self.period = config.sight, config.move_period
        self.search = search or BeamSearch()
        self.memory_steps = memory_steps
        self.patience_steps = patience_steps
        self.answer = answer
        self._seen: Sightings | None = None
        self._covered, self._idle = torch.zeros(0, dtype=torch.bool), torch.zeros(0)

    def only(self, arenas: Tensor) -> None:
        """As ``Planner.only``."""
        super().only(arenas)
        self._covered, self._idle = self._covered[arenas], self._idle[arenas]
        if self._seen is not None:
            self._seen = Sightings(*(entry[arenas] for entry in self._seen))

    def plan(self, tensordict: TensorDictBase) -> Tensor:
        """Each robot's own part of its joint plan, int64 [*B, N]."""
        batch = tensordict.get("step_count").shape[:-1]
        now, grid, position, since, linked = (
            tensordict.get(key).reshape(-1, *tensordict.get(key).shape[len(batch) :])
            for key in (
                "step_count",
                ("agents", "map"),
                ("agents", "position"),
                ("agents", "steps_since_merge"),
                ("agents", "linked"),
            )
        )
        seen = self._remember(now, grid, position, linked)
        near = any_linked(linked)
        complete = ~frontier_mask(grid).flatten(-2).any(-1)
        unknown = _worth_seeing(grid, position, ~complete) & ~self._covered
        left = unknown.flatten(-2).any(-1)
        self._idle = torch.where(left | (now == 0), 0, self._idle + 1)
        forget = self._idle >= self.patience_steps
        self._idle = self._idle.masked_fill(forget, 0)
        self._covered = self._covered & ~forget[..., None, None]

        move = torch.full_like(position[..., 0], STAY)
        meets = ~left & ~complete & (seen.step.amax(-1) >= 0)
        if meets.any():
            move[meets] = _towards(grid[meets], position[meets], last_place(seen)[meets])
        move = move.masked_fill(~left & near, COMMUNICATE)
        if left.any():
            nearest, length = nearest_frontier(grid[left], position[left])
            move[left] = torch.where(length > 0, nearest, STAY)
        reach = self.search.horizon + self.sight.radius
        within = straight_distances(position, *grid.shape[-2:]) <= reach
        rows = left & (unknown & within).flatten(-2).any(-1)
        if rows.any():
            first, fruitful = self._joint_plan(rows, now, grid, unknown, position, seen)
            move[rows] = torch.where(fruitful, first, move[rows])
        if self.answer:
            waited = seen.waited & (since >= 2)
            turn = in_turn(self.period, None, now - 1)
            if turn is not None:  # who may not move is not waiting
                waited = waited & turn.unsqueeze(-2)
            move = move.masked_fill(waited.any(-1), COMMUNICATE)
        return move.view(*batch, -1)

    def _remember(self, now: Tensor, grid: Tensor, position: Tensor, linked: Tensor) -> Sightings:
        """Add an observation to the memory, which is cleared where an episode begins."""
        blank, before = no_sightings(position), self._seen
        same = self._covered.shape == grid.shape and self._covered.device == grid.device
        if before is None or not same:
            before, self._covered = blank, torch.zeros_like(grid, dtype=torch.bool)
            self._idle = torch.zeros_like(position[..., 0])
        begun = (now == 0).squeeze(-1)
        before = where_begun(begun, blank, before)
        self._seen = seen = update_sightings(before, now, position, linked)
        views = surely_seen(grid, position, linked, self.sight).any(-3)
        self._covered = (self._covered & ~begun[:, None, None, None]) | views
        return seen

    def _joint_plan(
        self,
        rows: Tensor,
        now: Tensor,
        grid: Tensor,
        unknown: Tensor,
        position: Tensor,
        seen: Sightings,
    ) -> tuple[Tensor, Tensor]:
        """First moves of the robots in ``rows`` [B, N], and whether their plans see anything."""
        me = torch.arange(grid.shape[1], device=grid.device).expand(len(grid), -1)[rows]
        mine = torch.arange(len(me), device=grid.device)
        place, present = seen.cell[rows], (now.unsqueeze(-1) - seen.step <= self.memory_steps)[rows]
        place[mine, me], present[mine, me] = position[rows], True
        window = _Window(place[mine, me], grid.shape[-2:])
        place = place - window.corner.unsqueeze(1)
        inside = ((place >= 0) & (place < torch.tensor(window.size, device=grid.device))).all(-1)
        first, fruitful = self.search.first_moves(
            window.cut(unknown[rows]),
            window.cut(grid[rows] == OCCUPIED),
            torch.where(inside.unsqueeze(-1), place, 0),
            present & inside,
            self.sight,
        )
        return first[mine, me], fruitful


def _worth_seeing(grid: Tensor, position: Tensor, rows: Tensor) -> Tensor:
    """Unknown cells of maps [B, N, H, W] that a robot may be able to see, for rows bool [B, N]."""
    unknown = torch.zeros_like(grid, dtype=torch.bool)
    if rows.any():
        target = target_cells(grid[rows] == OCCUPIED, position[rows].unsqueeze(-2))
        unknown[rows] = (grid[rows] == UNKNOWN) & target
    return unknown


def _towards(grid: Tensor, position: Tensor, place: Tensor) -> Tensor:
    """First moves on maps [M, H, W] to the reachable cells nearest to places [M, 2], int64 [M]."""
    direction, length = paths(grid, position)
    apart = straight_distances(place, *grid.shape[-2:])
    # of the reachable cells, the nearest to that place; ties by the nearest to the robot
    order = (apart * length[0].numel() + length).masked_fill(length == 0, torch.inf).flatten(-2)
    cell = order.argmin(-1, keepdim=True)
    own = flat_cell(position, grid.shape[-1]).unsqueeze(-1)
    nearer = apart.flatten(-2).gather(-1, cell) < apart.flatten(-2).gather(-1, own)
    return torch.where(nearer, direction.flatten(-2).gather(-1, cell), STAY).squeeze(-1)


class _Window:
    """The part of a large arena around each robot in which it plans."""

    def __init__(self, center: Tensor, size: torch.Size) -> None:
        full = torch.tensor(size, device=center.device)
        self.size = tuple(min(side, WINDOW) for side in size)
        own = torch.tensor(self.size, device=center.device)
        self.corner = torch.minimum((center - own // 2).clamp_min(0), full - own)

    def cut(self, grids: Tensor) -> Tensor:
        """The windows [M, h, w] of grids [M, H, W]."""
        height, width = self.size
        row = self.corner[:, :1] + torch.arange(height, device=grids.device)
        column = self.corner[:, 1:] + torch.arange(width, device=grids.device)
        batch = torch.arange(len(grids), device=grids.device)[:, None, None]
        return grids[batch, row.unsqueeze(-1), column.unsqueeze(-2)]

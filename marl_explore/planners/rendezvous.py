"""Short-horizon joint planning on the own map, with exchanges at times that all robots know."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from marl_explore.config import ArenaConfig
from marl_explore.core.frontier import frontier_mask, nearest_frontier, paths
from marl_explore.core.grid import COMMUNICATE, OCCUPIED, STAY, UNKNOWN, flat_cell
from marl_explore.core.radio import in_range
from marl_explore.planners.base import Planner
from marl_explore.planners.beam import BeamSearch
from marl_explore.planners.communication import CommunicationRule
from marl_explore.planners.sightings import Sightings


class Rendezvous(Planner):
    """Robots that plan for all whom they believe near, and meet when nothing is left to see alone.

    A robot counts cells that others in range must have seen as known, searches for the best joint
    plan of itself and the robots it saw lately, and makes its own first move. Where the plan sees
    nothing new it walks to the nearest frontier. With only others' cells left it communicates,
    or walks to whom it saw last; if that takes too long it looks at those cells itself.

    Args:
        config: the arena.
        communicate: when robots exchange maps.
        search: the joint plan.
        memory_steps: how long a robot out of range counts as being where it was last.
        patience_steps: how long a robot with only others' cells left looks for them.
        answer: whether a robot beside one that waits communicates.
    """

    sees = "own map, positions of robots in range and where it saw them last, a clock"

    def __init__(
        self,
        config: ArenaConfig,
        communicate: CommunicationRule,
        search: BeamSearch | None = None,
        memory_steps: int = 8,
        patience_steps: int = 8,
        answer: bool = True,
    ) -> None:
        super().__init__(communicate)
        self.range_cells = config.communication_cells
        self.radius = config.fov_radius
        self.search = search or BeamSearch()
        self.memory_steps = memory_steps
        self.patience_steps = patience_steps
        self.answer = answer
        self._sightings: Sightings | None = None
        self._idle = torch.zeros(0)

    def plan(self, tensordict: TensorDictBase) -> Tensor:
        """Own part of the joint plan, int64 [*B, N]."""
        now = tensordict.get("step_count")
        grid, position = (tensordict.get(("agents", key)) for key in ("map", "position"))
        since = tensordict.get(("agents", "steps_since_merge"))
        reach = in_range(position, self.range_cells)
        seen = self._remember(now, grid, position, reach)
        near = reach.sum(-1) > 1
        unknown = (grid == UNKNOWN) & ~seen.covered
        left = unknown.flatten(-2).any(-1)
        self._idle = torch.where(left | (now == 0), 0, self._idle + 1)
        forget = self._idle >= self.patience_steps
        self._idle = self._idle.masked_fill(forget, 0)
        seen.covered = seen.covered & ~forget[..., None, None]

        move = self._meet(grid, position, near, seen)
        rows = left & frontier_mask(grid).flatten(-2).any(-1)
        if rows.any():
            move[rows] = self._explore(rows, now, grid, unknown, position, reach, seen)
        if self.answer:
            move = move.masked_fill((seen.waited & (since >= 2)).any(-1), COMMUNICATE)
        return move

    def _remember(self, now: Tensor, grid: Tensor, position: Tensor, reach: Tensor) -> Sightings:
        seen = self._sightings
        if seen is None or seen.covered.shape != grid.shape or seen.covered.device != grid.device:
            seen = self._sightings = Sightings(grid)
            self._idle = torch.zeros_like(position[..., 0])
        seen.update(now, position, reach, self.radius)
        return seen

    def _explore(
        self,
        rows: Tensor,
        now: Tensor,
        grid: Tensor,
        unknown: Tensor,
        position: Tensor,
        reach: Tensor,
        seen: Sightings,
    ) -> Tensor:
        """First moves of the robots in ``rows``, bool [B, N]."""
        robots = grid.shape[1]
        me = torch.arange(robots, device=grid.device).expand(len(grid), -1)[rows]
        lately = now.unsqueeze(-1) - seen.step <= self.memory_steps
        place = seen.cell[rows]
        mine = torch.arange(len(me), device=grid.device)
        place[mine, me] = position[rows]
        present = lately[rows]
        present[mine, me] = True
        first, fruitful = self.search.first_moves(
            unknown[rows], grid[rows] == OCCUPIED, place, present, self.radius
        )
        nearest, length = nearest_frontier(grid[rows], position[rows])
        nearest = torch.where(length > 0, nearest, STAY)
        return torch.where(fruitful, first[mine, me], nearest)

    def _meet(self, grid: Tensor, position: Tensor, near: Tensor, seen: Sightings) -> Tensor:
        """Communicate in range, else walk to whom was seen last, int64 [B, N]."""
        direction, length = paths(grid, position)
        latest = seen.step.argmax(-1)
        index = latest[..., None, None].expand(*latest.shape, 1, 2)
        target = flat_cell(seen.cell.gather(2, index).squeeze(2), grid.shape[-1]).unsqueeze(-1)
        known = length.flatten(-2).gather(-1, target).squeeze(-1) > 0
        toward = direction.flatten(-2).gather(-1, target).squeeze(-1)
        met = seen.step.amax(-1) >= 0
        complete = ~frontier_mask(grid).flatten(-2).any(-1)
        move = torch.where(known & met & ~complete, toward, STAY)
        return move.masked_fill(near, COMMUNICATE)

"""What a robot can choose from: candidate goals, teammates, and its own state, in numpy."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_explore.config.constants import (
    COMMUNICATE,
    COMPASS,
    LONG_AGO,
    MATE_COLUMNS,
    NUM_DIRECTIONS,
    UNKNOWN,
)
from marl_explore.config.shapes import Sight
from marl_explore.robot.goals import goal_finder
from marl_explore.robot.memory import TeamMemory
from marl_explore.robot.observation import Observation
from marl_explore.robot.situation import GoalTable, Situation
from marl_explore.robot.ways import blocked_beside

_ROWS, _COLUMNS = np.array(COMPASS).T
_SEEN, _LINKED, _AGE, _MOVES, _MOVE, _UNSHARED, _SINCE, _SQUARE, _WAITED = range(len(MATE_COLUMNS))


class Context(NamedTuple):
    """What is known about the robot itself: ``CONTEXT_COLUMNS``."""

    step: int
    known_cells: int
    cells: int
    robots: int
    all_covered: bool
    refused: bool
    may_communicate: bool
    radius: int
    shape_cells: int


class Candidates(NamedTuple):
    """``transforms.goals.Candidates`` of one robot of a team of N."""

    frontiers: NDArray[np.int32]
    """[24, 14], the columns ``GOAL_COLUMNS``."""
    rivals: NDArray[np.int32]
    """[24, N, 2]."""
    mates: NDArray[np.int64]
    """[N, 9], the columns ``MATE_COLUMNS``."""
    context: Context


class CandidateFinder:
    """One robot's memory and candidates in one episode.

    Args:
        robot: its number.
        robots: size of the team, N.
        shape: of the maps, (H, W).
        sight: of the robots.
    """

    def __init__(self, robot: int, robots: int, shape: tuple[int, int], sight: Sight) -> None:
        self.memory = memory = TeamMemory(robot, robots, *shape, sight)
        self.shape, self.last_step, self._sight = shape, -1, sight.of(robot)
        self._situation = Situation(
            grid=np.empty(shape, np.int8),
            position=memory.position,
            taken=np.empty(NUM_DIRECTIONS, np.bool_),
            allowed=np.empty(NUM_DIRECTIONS, np.bool_),
            seen_step=memory.seen_step,
            seen_cell=memory.seen_cell,
            known_by=memory.known_by,
            covered=memory.covered,
            heading=memory.heading,
            goal=memory.goal,
        )
        self._find = goal_finder(self._situation, self._sight)
        self._mates = np.empty((len(MATE_COLUMNS), robots), np.int64)

    def follows(self, observed: Observation) -> bool:
        """Whether an observation continues this episode: a later step of the same team and map."""
        same = observed.map.shape == self.shape and len(observed.net) == len(self.memory.seen_step)
        return same and observed.step > 0 and observed.step >= self.last_step

    def find(self, observed: Observation) -> Candidates:
        """Remember an observation, and find the candidates; the next call overwrites its arrays.

        Raises:
            ValueError: for a cell outside the map.
        """
        self.memory.remember(observed)
        self.last_step = observed.step
        self._situation.grid[:] = observed.map
        self._situation.allowed[:] = observed.action_mask[:NUM_DIRECTIONS]
        self._situation.taken[:] = taken_cells(observed, self._sight)
        table = self._find()
        self.memory.all_covered = table.all_covered
        return Candidates(
            table.frontiers,
            table.rivals,
            self._about(observed, table),
            _context(observed, table, self._sight),
        )

    def _about(self, observed: Observation, table: GoalTable) -> NDArray[np.int64]:
        """``Candidates.mates``."""
        rows, memory = self._mates, self.memory
        seen = memory.seen_step >= 0
        rows[_SEEN] = seen
        rows[_LINKED] = rows[_SQUARE] = 0
        own_row, own_column = observed.position
        for mate, (row, column) in observed.mates.items():
            rows[_LINKED, mate] = 1
            rows[_SQUARE, mate] = (row - own_row) ** 2 + (column - own_column) ** 2
        rows[_AGE] = (observed.step - memory.seen_step) * seen
        rows[_MOVES : _MOVE + 1] = table.ways.T
        rows[_UNSHARED] = observed.unshared
        np.minimum(observed.steps_since_merge, LONG_AGO, out=rows[_SINCE])
        rows[_UNSHARED : _SINCE + 1, memory.robot] = 0
        rows[_WAITED] = memory.waited
        return rows.T


def taken_cells(observed: Observation, sight: Sight) -> NDArray[np.bool_]:
    """``core.goals.taken_cells`` of one robot [8]."""
    blocked, shut = blocked_beside(observed)
    return blocked & ~shut if sight.line_of_sight else blocked


def _context(observed: Observation, table: GoalTable, sight: Sight) -> Context:
    """``Candidates.context``."""
    grid, (shape_cells,) = observed.map, sight.sizes
    return Context(
        step=observed.step,
        known_cells=int(np.count_nonzero(grid != UNKNOWN)),
        cells=grid.size,
        robots=len(observed.net),
        all_covered=table.all_covered,
        refused=observed.refused,
        may_communicate=bool(observed.action_mask[COMMUNICATE]),
        radius=sight.radius,
        shape_cells=shape_cells,
    )

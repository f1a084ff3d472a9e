"""What one robot remembers of its team: ``core.memory`` of one robot, in numpy."""

from __future__ import annotations

import numpy as np

from marl_explore.config.constants import COMPASS, NOT_SEEN, PATIENCE_STEPS, UNKNOWN
from marl_explore.config.shapes import Sight
from marl_explore.robot.observation import Observation
from marl_explore.robot.visibility import surely_seen

_DIRECTIONS = {step: direction for direction, step in enumerate(COMPASS)}


class TeamMemory:
    """A robot's memory of its team (docs/goals.md), blank at first; it changes in place.

    Args:
        robot: its number.
        robots: size of the team, N.
        height: of the arena (cells).
        width: of the arena (cells).
        sight: of the robots.
    """

    def __init__(self, robot: int, robots: int, height: int, width: int, sight: Sight) -> None:
        self.robot = robot
        self._sights = [sight.of(other) for other in range(robots)]
        self.seen_step = np.full(robots, NOT_SEEN, np.int64)
        """Step at which it was last linked to each robot [N]; NOT_SEEN before, and for itself."""
        self.seen_cell = np.zeros((robots, 2), np.int64)
        """Where each was then [N, 2]."""
        self.waited = np.zeros(robots, np.bool_)
        """Whether each is linked and was in the same cell one step earlier [N]."""
        self.known_by = np.zeros((robots, height, width), np.bool_)
        """Cells that it is sure each robot knows [N, H, W]."""
        self.covered = np.zeros((height, width), np.bool_)
        """Cells that it leaves to teammates who have seen them [H, W]."""
        self.stuck = 0
        """Steps in a row in which all frontiers that it could reach were covered."""
        self.known = 0
        """Number of cells that its map knows."""
        self.stalled = 0
        """Steps since its map last grew."""
        self.position = np.full(2, -1, np.int64)
        """Its own cell [2]; (-1, -1) before the first observation."""
        self.heading = np.array(-1, np.int64)
        """Direction of its last move []; -1 before the first."""
        self.goal = np.full(2, -1, np.int64)
        """The cell that it last chose to go to [2]; (-1, -1) for none."""
        self.all_covered = False
        """Whether it could reach frontiers at the last observation, all of them covered."""

    def remember(self, observed: Observation) -> None:
        """Take one more observation into account; ``all_covered`` and ``goal`` stay as they are."""
        self.stuck = (self.stuck + 1) * self.all_covered
        if self.stuck >= PATIENCE_STEPS:
            self.covered[:] = False
            self.stuck = 0
        known = int(np.count_nonzero(observed.map != UNKNOWN))
        self.stalled = 0 if known > self.known else self.stalled + 1
        self.known = known
        self._sight(observed)
        self._note_merges(observed)
        row, column = observed.position
        moved = row - int(self.position[0]), column - int(self.position[1])
        if self.position[0] >= 0 and moved in _DIRECTIONS:
            self.heading[()] = _DIRECTIONS[moved]
        self.position[:] = observed.position

    def _sight(self, observed: Observation) -> None:
        """Note where linked teammates are, and what they surely see."""
        self.waited[:] = False
        for mate, (row, column) in observed.mates.items():
            same_cell = self.seen_cell[mate, 0] == row and self.seen_cell[mate, 1] == column
            self.waited[mate] = same_cell and self.seen_step[mate] == observed.step - 1
            self.seen_step[mate] = observed.step
            self.seen_cell[mate] = row, column
            part, seen = surely_seen(observed.map, (row, column), self._sights[mate])
            self.covered[part] |= seen
            self.known_by[mate][part] |= seen

    def _note_merges(self, observed: Observation) -> None:
        """Note what teammates know with whom it has just merged maps."""
        merged = observed.steps_since_merge == 0
        merged[self.robot] = False
        if merged.any():
            self.known_by[merged] |= observed.map != UNKNOWN

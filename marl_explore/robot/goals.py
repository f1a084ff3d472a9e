"""Candidate goals of one robot, with the native kernel; docs/goals.md describes every entry."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_explore.config.constants import GOAL_COLUMNS, MAX_FRONTIERS, NUM_DIRECTIONS
from marl_explore.core import native


class Situation(NamedTuple):
    """What a robot of a team of N knows; ``core.goals.Situation`` of one robot."""

    grid: NDArray[np.int8]
    """Its map [H, W]."""
    position: NDArray[np.int64]
    """Its cell [2]."""
    taken: NDArray[np.bool_]
    """Cells of the eight directions that hold something that is not on the map [8]."""
    allowed: NDArray[np.bool_]
    """Allowed moves [8]."""
    seen_step: NDArray[np.int64]
    """Step at which it was last linked to each robot [N], negative if never, and for itself."""
    seen_cell: NDArray[np.int64]
    """Where each was then [N, 2]."""
    known_by: NDArray[np.bool_]
    """Cells that it is sure each robot knows [N, H, W]."""
    covered: NDArray[np.bool_]
    """Cells that it leaves to others [H, W]."""
    heading: int | NDArray[np.int64]
    """Direction of its last move; -1 before the first."""
    goal: NDArray[np.int64]
    """The cell that it last chose to go to [2]; (-1, -1) for none."""


class GoalTable(NamedTuple):
    """``core.goals.GoalTable`` of one robot."""

    frontiers: NDArray[np.int32]
    """Candidates [24, 14]."""
    rivals: NDArray[np.int32]
    """Candidates as each teammate would find them [24, N, 2]."""
    ways: NDArray[np.int32]
    """Ways to where each teammate was last seen [N, 2]."""
    all_covered: bool
    """Whether frontiers can be reached, all of them covered by teammates."""


def goal_table(situation: Situation, radius: int) -> GoalTable:
    """``core.goals.goal_table`` of one robot, equal in every entry.

    Args:
        situation: what the robot knows.
        radius: half side of the field of view (cells), at least 1.

    Raises:
        ValueError: for a radius below 1, an array of another shape, or a cell outside the map.
        RuntimeError: when the native kernel cannot be used.
    """
    return GoalFinder(situation, radius).find()


class GoalFinder:
    """``goal_table`` of a situation whose arrays change in place.

    Arrays are checked and their addresses taken only once, so a call costs little more than the
    kernel. Arrays of another dtype or not contiguous are copied, and do not change any more.

    Args:
        situation: as for ``goal_table``.
        radius: as for ``goal_table``.

    Raises:
        ValueError: for a radius below 1, or an array of another shape.
        RuntimeError: when the native kernel cannot be used.
    """

    def __init__(self, situation: Situation, radius: int) -> None:
        if radius < 1:
            raise ValueError(f"radius={radius} is not at least 1")
        height, width = self._size = situation.grid.shape
        team, cells = len(situation.seen_step), (height, width)
        inputs = {
            "grid": (np.int8, cells),
            "position": (np.int64, (2,)),
            "taken": (np.bool_, (NUM_DIRECTIONS,)),
            "allowed": (np.bool_, (NUM_DIRECTIONS,)),
            "seen_step": (np.int64, (team,)),
            "seen_cell": (np.int64, (team, 2)),
            "known_by": (np.bool_, (team, *cells)),
            "covered": (np.bool_, cells),
            "heading": (np.int64, ()),
            "goal": (np.int64, (2,)),
        }
        self._inputs = [
            _array(name, getattr(situation, name), dtype, shape)
            for name, (dtype, shape) in inputs.items()
        ]
        self._frontiers = np.empty((MAX_FRONTIERS, len(GOAL_COLUMNS)), np.int32)
        self._rivals = np.empty((MAX_FRONTIERS, team, 2), np.int32)
        self._ways, self._all_covered = np.empty((team, 2), np.int32), np.empty((), np.bool_)
        arrays = (*self._inputs, self._frontiers, self._rivals, self._ways, self._all_covered)
        addresses = [array.ctypes.data for array in arrays]
        self._batch = native.GoalBatch(*addresses, team, height, width, radius)
        self._kernel = native.kernel("goals")

    def find(self) -> GoalTable:
        """The table now; the next call overwrites its arrays.

        Raises:
            ValueError: for a cell outside the map.
        """
        native.check(self._kernel(self._batch, 0, 1), *self._size)
        return GoalTable(self._frontiers, self._rivals, self._ways, bool(self._all_covered))


def _array(
    name: str,
    value: NDArray[np.generic] | int,
    dtype: type[np.generic],
    shape: tuple[int, ...],
) -> NDArray[np.generic]:
    """What the kernel reads."""
    array = np.asarray(value, dtype, order="C")
    if array.shape != shape:
        raise ValueError(f"{name} must have the shape {shape}, got {array.shape}")
    return array

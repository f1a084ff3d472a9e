"""Candidate goals of one robot, with the native kernel; docs/goals.md describes every entry."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_explore.config.constants import (
    COMPASS,
    FREE,
    GOAL_COLUMNS,
    MAX_FRONTIERS,
    NUM_DIRECTIONS,
    UNKNOWN,
)
from marl_explore.config.shapes import Sight
from marl_explore.core import native
from marl_explore.robot.visibility import shape_mask

_COMPASS = np.array(COMPASS)
_MERGED, _NEAR = GOAL_COLUMNS.index("merged_cells"), GOAL_COLUMNS.index("near_gain")


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


def goal_table(situation: Situation, sight: Sight) -> GoalTable:
    """``core.goals.goal_table`` of one robot, equal in every entry.

    Args:
        situation: what the robot knows.
        sight: of the robot alone; its k is at least 1.

    Raises:
        ValueError: for a k below 1, an array of another shape, or a cell outside the map.
        RuntimeError: when a native kernel cannot be used.
    """
    return GoalFinder(situation, sight).find()


class GoalFinder:
    """``goal_table`` of a situation whose arrays change in place.

    Arrays are checked and their addresses taken only once, so a call costs little more than the
    kernel. Arrays of another dtype or not contiguous are copied, and do not change any more.

    Args:
        situation: as for ``goal_table``.
        sight: as for ``goal_table``.

    Raises:
        ValueError: for a k below 1, or an array of another shape.
        RuntimeError: when a native kernel cannot be used.
    """

    def __init__(self, situation: Situation, sight: Sight) -> None:
        if sight.radius < 1:
            raise ValueError(f"radius={sight.radius} is not at least 1")
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
        self._inputs = {
            name: _array(name, getattr(situation, name), dtype, shape)
            for name, (dtype, shape) in inputs.items()
        }
        self._radius = np.array(sight.radius, np.int64)
        self._sight = None if sight.fills_windows else _Discoveries(self._inputs, sight)
        self._frontiers = np.empty((MAX_FRONTIERS, len(GOAL_COLUMNS)), np.int32)
        self._rivals = np.empty((MAX_FRONTIERS, team, 2), np.int32)
        self._ways, self._all_covered = np.empty((team, 2), np.int32), np.empty((), np.bool_)
        gains = None if self._sight is None else self._sight.of_moves
        arrays = (
            *(*self._inputs.values(), self._radius, gains),
            *(self._frontiers, self._rivals, self._ways, self._all_covered),
        )
        addresses = [None if array is None else array.ctypes.data for array in arrays]
        self._batch = native.GoalBatch(*addresses, team, height, width, self._radius.size)
        self._kernel = native.kernel("goals")

    def find(self) -> GoalTable:
        """The table now; the next call overwrites its arrays.

        Raises:
            ValueError: for a cell outside the map.
        """
        if self._sight is not None:
            self._sight.find_moves()
        native.check(self._kernel(self._batch, 0, 1), *self._size)
        if self._sight is not None:
            self._sight.find_near(self._frontiers)
        return GoalTable(self._frontiers, self._rivals, self._ways, bool(self._all_covered))


class _Discoveries:
    """Unseen cells that the robot would see: ``core.goals.unseen_in_sight``.

    Args:
        known: the arrays of a situation, which change in place.
        sight: of the robot alone.

    Raises:
        RuntimeError: when the native kernel cannot be used.
    """

    def __init__(self, known: dict[str, NDArray[Any]], sight: Sight) -> None:
        self._known, self._mask = known, shape_mask(sight)
        self._left = np.empty_like(known["grid"])
        self._cell, self._found, self._first = np.zeros((3, MAX_FRONTIERS), np.int64)
        self.of_moves = np.zeros(NUM_DIRECTIONS, np.int64)
        """After each of the eight moves."""
        arrays = (self._left, self._first, self._cell, self._first, self._mask, self._found)
        addresses = [array.ctypes.data for array in arrays]
        sizes = (1, *self._left.shape, 1, sight.side, sight.line_of_sight)
        self._queries = native.SightQueries(*addresses, *sizes)
        self._kernel = native.kernel("discoveries")

    def find_moves(self) -> None:
        """Find those after each move, on the map as it is now."""
        grid, covered, shape = self._known["grid"], self._known["covered"], self._left.shape
        np.copyto(self._left, grid)
        self._left[covered & (grid == UNKNOWN)] = FREE
        target = np.clip(self._known["position"] + _COMPASS, 0, np.array(shape) - 1)
        self.of_moves[:] = self._from(target)

    def find_near(self, frontiers: NDArray[np.int32]) -> None:
        """Write those at each candidate into its row."""
        number = int(np.count_nonzero(frontiers[:, _MERGED]))
        frontiers[:number, _NEAR] = self._from(frontiers[:number, :2])

    def _from(self, places: NDArray[np.integer]) -> NDArray[np.int64]:
        """Those from cells [X, 2], [X]."""
        number, (height, width) = len(places), self._left.shape
        self._cell[:number] = places[:, 0] * width + places[:, 1]
        native.check(self._kernel(self._queries, 0, number), height, width)
        return self._found[:number]


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

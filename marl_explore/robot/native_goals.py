"""Candidate goals of one robot, with the native kernels."""

from __future__ import annotations

from typing import Any

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
from marl_explore.robot.situation import GoalTable, Situation, arrays_of
from marl_explore.robot.visibility import shape_mask

_COMPASS = np.array(COMPASS)
_MERGED, _NEAR = GOAL_COLUMNS.index("merged_cells"), GOAL_COLUMNS.index("near_gain")


class GoalFinder:
    """``goal_table`` of a situation whose arrays change in place, with the native kernel.

    Arrays are checked and their addresses taken only once, so a call costs little more than the
    kernel. Arrays of another dtype or not contiguous are copied, and do not change any more.

    Args:
        situation: as for ``goal_table``.
        sight: as for ``goal_table``.

    Raises:
        ValueError: for an array of another shape.
        RuntimeError: when a native kernel cannot be used.
    """

    def __init__(self, situation: Situation, sight: Sight) -> None:
        self._size = height, width = situation.grid.shape
        self._inputs, team = arrays_of(situation), len(situation.seen_step)
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

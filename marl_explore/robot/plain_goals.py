"""Candidate goals of one robot, with numpy alone: what ``core.goals`` computes of a batch."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_explore.config.constants import (
    COMPASS,
    DETOUR_CELLS,
    FAR_CELLS,
    FREE,
    GAIN_SQUARES,
    GOAL_COLUMNS,
    LARGE_POCKET,
    MAX_FRONTIERS,
    NUM_DIRECTIONS,
    OCCUPIED,
    UNKNOWN,
)
from marl_explore.config.shapes import Sight
from marl_explore.robot.geometry import GridCell
from marl_explore.robot.situation import GoalTable, Situation
from marl_explore.robot.visibility import line_of_sight, shape_mask
from marl_explore.robot.wavefront import Mask, beside_any, first_moves, lengths_from

Integers = NDArray[np.int64]
_COMPASS = np.array(COMPASS)
_ALL_DIRECTIONS = np.arange(NUM_DIRECTIONS)


class _Chosen(NamedTuple):
    """Candidate frontier cells."""

    place: Integers
    """Cells [V, 2]."""
    size: list[int]
    """Frontier cells that each stands for."""


def plain_goal_table(situation: Situation, sight: Sight) -> GoalTable:
    """``goals.goal_table`` from numpy.

    Args:
        situation: what the robot knows.
        sight: of the robot alone; its k is at least 1.

    Raises:
        ValueError: for a cell outside the map.
    """
    return _Robot(situation, sight).table()


class _Robot:
    """The situation of a robot, with what all columns need."""

    def __init__(self, situation: Situation, sight: Sight) -> None:
        self.known, self.sight, self.radius = situation, sight, sight.radius
        grid, self.seen = situation.grid, situation.seen_step >= 0
        self.height, self.width = grid.shape
        _check_inside("a position is outside its", situation.position, grid.shape)
        _check_inside("a teammate was seen outside the", situation.seen_cell[self.seen], grid.shape)
        self.unseen = (grid == UNKNOWN) & ~situation.covered
        self.counts = np.pad(self.unseen.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
        last = np.array(grid.shape) - 1
        beside = np.clip(situation.position + _COMPASS, 0, last)
        closed = np.zeros(grid.shape, bool)
        closed[tuple(beside[situation.taken].T)] = True
        self.gains = self._in_sight(beside)
        self.labels, self.moves = first_moves(grid, tuple(situation.position.tolist()), closed)
        reached = (self.moves > 0) & (grid == FREE)
        self.open = reached & beside_any(self.unseen)
        some = (reached & beside_any(grid == UNKNOWN)).any()
        self.all_covered = bool(some and not self.open.any())

    def table(self) -> GoalTable:
        """The candidates and their columns."""
        chosen = self._thinned()
        number = len(chosen.size)
        frontiers = np.zeros((MAX_FRONTIERS, len(GOAL_COLUMNS)), np.int32)
        rivals = np.zeros((MAX_FRONTIERS, len(self.seen), 2), np.int32)
        if number:
            frontiers[:number] = self._columns(chosen).T
            rivals[:number] = self._rivals(chosen.place)
        return GoalTable(frontiers, rivals, self._ways(), self.all_covered)

    def _thinned(self) -> _Chosen:
        """Of the open frontier cells, the nearest first, those that are not close to another."""
        place = np.argwhere(self.open)
        moves = self.moves[self.open]
        order = np.argsort(moves, kind="stable")
        place, moves = place[order], moves[order]
        near, middle = 2 * self.radius, 6 * self.radius
        spread = self.radius * ((moves > near).astype(np.int64) + (moves > middle))
        chosen: list[Integers] = []
        size: list[int] = []
        while len(place) and len(chosen) < MAX_FRONTIERS:
            absorbed = (np.abs(place - place[0]).max(1) <= spread) & (moves[0] > near)
            absorbed[0] = True
            chosen.append(place[0])
            size.append(int(absorbed.sum()))
            place, moves, spread = place[~absorbed], moves[~absorbed], spread[~absorbed]
        return _Chosen(np.array(chosen, np.int64).reshape(-1, 2), size)

    def _columns(self, chosen: _Chosen) -> Integers:
        """``GoalTable.frontiers`` of the candidates, [14, V]."""
        place = chosen.place
        move = self._first_moves(place)
        return np.stack(
            (
                *place.T,
                self.moves[tuple(place.T)],
                move,
                np.array(chosen.size),
                self._in_sight(place),
                *(self._in_square(place, factor * self.radius) for factor in GAIN_SQUARES[1:]),
                self._pocket(place),
                self._isolation(place),
                self.gains[move],
                self.known.allowed[move],
                self._turn(move),
                self._from_last_goal(place),
            )
        )

    def _in_sight(self, place: Integers) -> Integers:
        """Unseen cells that the robot would see from cells [X, 2]."""
        if self.sight.fills_windows:
            return self._in_square(place, self.radius)
        return np.array([self._discovered(row, column) for row, column in place.tolist()], np.int64)

    def _discovered(self, row: int, column: int) -> int:
        """Unseen cells that the robot would see from a cell if unknown cells were free."""
        window = np.s_[row : row + self.sight.side, column : column + self.sight.side]
        seen = shape_mask(self.sight) & np.pad(self.unseen, self.radius)[window]
        if self.sight.line_of_sight:
            seen &= line_of_sight(np.pad(self.known.grid == OCCUPIED, self.radius)[window].copy())
        return int(seen.sum())

    def _in_square(self, place: Integers, radius: int) -> Integers:
        """Unseen cells in the squares of a radius around cells [X, 2]."""
        top, left = np.maximum(place - radius, 0).T
        bottom, right = np.minimum(place + radius + 1, self.known.grid.shape).T
        below = self.counts[bottom, right] - self.counts[bottom, left]
        above = self.counts[top, right] - self.counts[top, left]
        return np.asarray(below - above, np.int64)

    def _first_moves(self, place: Integers) -> Integers:
        """The first moves to cells [X, 2]; -1 for cells without a path.

        Of the first moves of all shortest paths, an allowed one that brings most unseen cells into
        view, and of equal ones the lowest direction.
        """
        merit = self.gains + self.known.allowed * 2 * self.known.grid.size + 1
        merit = merit * NUM_DIRECTIONS - _ALL_DIRECTIONS
        first = self.labels[tuple(place.T)][:, None] >> _ALL_DIRECTIONS & 1
        value = merit * first
        return np.where(value.max(1) > 0, value.argmax(1), -1)

    def _pocket(self, place: Integers) -> Integers:
        """Size of the largest unseen region beside each cell [X, 2], at most LARGE_POCKET."""
        size = np.pad(_region_sizes(self.unseen), 1)
        row, column = place.T + 1
        beside = (size[row - 1, column], size[row + 1, column])
        largest = np.maximum.reduce((*beside, size[row, column - 1], size[row, column + 1]))
        return np.asarray(np.minimum(largest, LARGE_POCKET), np.int64)

    def _isolation(self, place: Integers) -> Integers:
        """Distance to the nearest other candidate farther than k, at most FAR_CELLS."""
        apart = np.abs(place[:, None] - place).max(-1)
        nearest = np.where(apart > self.radius, apart, FAR_CELLS).min(1)
        return np.asarray(np.minimum(nearest, FAR_CELLS), np.int64)

    def _turn(self, move: Integers) -> Integers:
        """Eighths of a circle between a move and the last one, 0 to 4; -1 without a last one."""
        if self.known.heading < 0:
            return np.full_like(move, -1)
        around = (move - self.known.heading) % NUM_DIRECTIONS
        return np.minimum(around, NUM_DIRECTIONS - around)

    def _from_last_goal(self, place: Integers) -> Integers:
        """Straight distance from the last goal; -1 without one."""
        if self.known.goal[0] < 0:
            return np.full(len(place), -1, np.int64)
        return np.asarray(np.abs(place - self.known.goal).max(1), np.int64)

    def _rivals(self, place: Integers) -> NDArray[np.int32]:
        """``GoalTable.rivals`` of the candidates, [V, N, 2]."""
        known, seen = self.known, self.seen
        table = np.zeros((len(place), len(seen), 2), np.int32)
        table[..., 0] = -1
        if seen.any():
            row, column = place.T
            length = lengths_from(known.grid, known.seen_cell[seen])[:, row, column]
            apart = np.abs(known.seen_cell[seen][:, None] - place).max(-1)
            way = np.where(length < known.grid.size, length, apart + DETOUR_CELLS)
            table[:, seen, 0] = way.T
            table[:, seen, 1] = known.known_by[seen][:, row, column].T
        return table

    def _ways(self) -> NDArray[np.int32]:
        """``GoalTable.ways``."""
        ways = np.zeros((len(self.seen), 2), np.int32)
        ways[:, 1] = -1
        reached = self.moves > 0
        reached[tuple(self.known.position)] = True
        cells, moves = np.argwhere(reached), self.moves[reached]
        for mate in self.seen.nonzero()[0].tolist():
            apart = np.abs(cells - self.known.seen_cell[mate]).max(1)
            best = int(np.lexsort((moves, apart))[0])
            if moves[best]:
                ways[mate] = moves[best] + apart[best], self._first_moves(cells[best][None])[0]
        return ways


def _check_inside(what: str, cells: NDArray[np.integer], shape: GridCell) -> None:
    if ((cells < 0) | (cells >= shape)).any():
        raise ValueError(f"{what} map of {shape[0]} x {shape[1]} cells")


def _region_sizes(cells: Mask) -> Integers:
    """For every cell of a set [H, W], the size of its 4-connected region; 0 outside it."""
    label = np.arange(1, cells.size + 1).reshape(cells.shape) * cells
    while True:
        padded = np.pad(label, 1)
        beside = (padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:])
        highest = np.maximum.reduce((label, *beside)) * cells
        # follow the label's own label, so that long regions take few rounds
        follow = np.concatenate(([0], highest.ravel()))
        highest = np.maximum(highest, follow[highest])
        if (highest == label).all():
            break
        label = highest
    return np.asarray(np.bincount(label.ravel())[label] * cells, np.int64)

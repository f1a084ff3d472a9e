"""Goals that are left out for now or for good: not reached, or reached in vain."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_explore.robot.explorer.grids import CoarseGrid, Mask, part_of
from marl_explore.robot.explorer.places import Place, Point

TRIES = 2
"""A goal is tried so many times."""
CHANGED = 0.15
"""A goal counts as new when so many square metres around it have changed ..."""
MOST_CHANGES = 3
"""... but no more often, since maps can flicker."""


@dataclass
class Skip:
    """A frontier that is left out, with all others around it."""

    place: Place
    radius: float
    """Metres."""
    around: NDArray[np.int8]
    """The map around it when it was skipped."""
    reason: str = ""
    """Of the last try."""
    in_vain: bool = False
    """Whether the goal was reached, and the frontier stayed."""
    tries: int = 0
    changes: int = 0


class Counts(NamedTuple):
    """Skipped goals whose frontiers are still there."""

    skipped: int
    """Tried once."""
    given_up: int
    """Not reached in any try."""
    exhausted: int
    """Reached in the last try."""


class SkipList:
    """All skipped goals."""

    def __init__(self) -> None:
        self.entries: list[Skip] = []

    def add(self, point: Point, radius: float, reason: str, grid: CoarseGrid) -> None:
        """Note that a frontier was not reached.

        Args:
            point: the unknown point that the goal faced.
            radius: frontiers this near to it are skipped, too (metres).
            reason: why it was not reached.
            grid: the map.
        """
        self._note(self._at(point, radius, grid), reason, grid)

    def add_in_vain(self, points: Iterable[Point], radius: float, grid: CoarseGrid) -> None:
        """Note that a robot was at frontiers, and that they stayed; as ``add``."""
        entries = {id(entry): entry for entry in (self._at(p, radius, grid) for p in points)}
        for entry in entries.values():
            self._note(entry, "nothing new was seen", grid)
            entry.in_vain = True

    def _note(self, entry: Skip, reason: str, grid: CoarseGrid) -> None:
        entry.tries += 1
        entry.reason, entry.in_vain = reason, False
        entry.around = _around(entry.place, entry.radius, grid)

    def renew(self, grid: CoarseGrid) -> None:
        """Forget the tries at goals around which the map has changed."""
        for entry in self.entries:
            around = _around(entry.place, entry.radius, grid)
            changed = float((around != entry.around).sum()) * grid.side**2
            if changed >= CHANGED and entry.changes < MOST_CHANGES:
                entry.around, entry.tries = around, 0
                entry.changes += 1

    def covered(self, grid: CoarseGrid, fewest: int) -> Mask:
        """Cells around goals that were tried at least so many times, bool [H, W]."""
        covered = np.zeros(grid.codes.shape, bool)
        for entry in self.entries:
            if entry.tries >= fewest:
                covered |= grid.distances(entry.place) <= entry.radius
        return covered

    def count(self, grid: CoarseGrid, border: Mask) -> Counts:
        """Count the goals that still have a frontier."""
        live = [e for e in self.entries if border[grid.distances(e.place) <= e.radius].any()]
        tried = [entry for entry in live if entry.tries >= TRIES]
        in_vain = sum(entry.in_vain for entry in tried)
        skipped = sum(0 < entry.tries < TRIES for entry in live)
        return Counts(skipped, len(tried) - in_vain, in_vain)

    def points(self) -> list[Point]:
        """Where goals are left out."""
        return [(entry.place.x, entry.place.y) for entry in self.entries if entry.tries]

    def given_up(self) -> list[str]:
        """Goals that were not reached in any try, and why."""
        tried = [entry for entry in self.entries if entry.tries >= TRIES and not entry.in_vain]
        return [f"({e.place.x:.1f}, {e.place.y:.1f}) {e.reason}" for e in tried]

    def _at(self, point: Point, radius: float, grid: CoarseGrid) -> Skip:
        """The entry for a point: one that covers it, or a new one."""
        near = [e for e in self.entries if e.place.distance(point) <= min(e.radius, radius)]
        if near:
            return min(near, key=lambda entry: entry.place.distance(point))
        place = Place(*point)
        entry = Skip(place, max(radius, grid.side), _around(place, radius, grid))
        self.entries.append(entry)
        return entry


def _around(place: Place, radius: float, grid: CoarseGrid) -> NDArray[np.int8]:
    """The square of cells around a place."""
    cells, (row, column) = round(radius / grid.side), grid.cell(place)
    first = row - cells + grid.first[0], column - cells + grid.first[1]
    return part_of(grid, first, (2 * cells + 1, 2 * cells + 1))

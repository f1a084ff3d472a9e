"""Whether a teammate's map fits the own one, before it is merged."""

from __future__ import annotations

import math
from typing import NamedTuple

from marl_explore.config.constants import FREE, OCCUPIED, UNKNOWN
from marl_explore.robot.explorer.grids import CoarseGrid, nearer, part_of

FEWEST_CONFLICTS = 0.8
"""Square metres; smaller contradictions are a door or a table that was moved, not a wrong frame."""
FEWEST_COMMON = 2.0
"""Square metres; a map that has less in common with the own one is not merged yet."""
TOLERANCE = 0.2
"""Walls may be off by less than this (metres)."""


class Fit(NamedTuple):
    """How two maps agree where both are known, in square metres of coarse cells."""

    common: float
    """What both know."""
    walls: float
    """Where one of the maps says that something is occupied."""
    conflicts: float
    """Where the other one is free, and also around that."""

    @property
    def is_little(self) -> bool:
        """Whether too little is in both maps to tell."""
        return self.common < FEWEST_COMMON

    def contradicts(self, most: float) -> bool:
        """Whether more than a share of the walls contradict, and enough of them to tell."""
        return self.conflicts >= FEWEST_CONFLICTS and self.conflicts > most * self.walls


def fit(one: CoarseGrid, other: CoarseGrid) -> Fit:
    """Compare two maps on the same lattice, where the first one is and a little around it."""
    rim = math.ceil(TOLERANCE / one.side)
    first = one.first[0] - rim, one.first[1] - rim
    shape = one.codes.shape[0] + 2 * rim, one.codes.shape[1] + 2 * rim
    a, b = part_of(one, first, shape), part_of(other, first, shape)
    both = (a != UNKNOWN) & (b != UNKNOWN)
    walls = both & ((a == OCCUPIED) | (b == OCCUPIED))
    reach = TOLERANCE / one.side
    conflicts = ((a == OCCUPIED) & ~nearer(b != FREE, reach)) | (
        (b == OCCUPIED) & ~nearer(a != FREE, reach)
    )
    cell = one.side**2
    return Fit(*(float(cells.sum()) * cell for cells in (both, walls, conflicts)))

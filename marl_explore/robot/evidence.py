"""What speaks for each cell of a map: looks that agree, how many, and how recent they are.

A robot's looks change its evidence (``looked``), and evidence of two robots is joined cell by cell
(``joined``): whichever has the higher rank counts. Joining is commutative, associative and
idempotent, and a look only raises the rank. So robots that pass on what they know, in any order and
any number of times, end with equal maps, and nothing old undoes what a robot has seen since.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from marl_explore.config.checks import require_integer
from marl_explore.config.constants import FREE, OCCUPIED, UNKNOWN
from marl_explore.config.fields import check_types
from marl_explore.robot.geometry import GridCell

Map = NDArray[np.int8]
MOST_LOOKS = 7
"""Largest limit of evidence."""
MOST_TICKS_PER_LOOK = 32
NEVER_SEEN = -1
"""Rank of an unknown cell."""
MOST_RANK = 2**62
"""Largest rank, so that sums of ranks fit into 64 bits."""


@dataclass(frozen=True)
class EvidenceModel:
    """How many looks change a cell, and how looks of several robots are weighed."""

    limit: int = 3
    """Looks that count at most: so many contrary ones in a row change any cell."""
    ticks_per_look: int = 8
    """A look more outweighs looks that are so many ticks younger."""

    def __post_init__(self) -> None:
        """Check the numbers."""
        check_types(self)
        require_integer("limit", self.limit, 1, MOST_LOOKS)
        require_integer("ticks_per_look", self.ticks_per_look, 0, MOST_TICKS_PER_LOOK)


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence for every cell; it never changes, looks and merges give a new one."""

    looks: NDArray[np.int8]
    """Looks that found the cell occupied less those that found it free, bounded (log odds); 0 is
    unknown [H, W]."""
    rank: NDArray[np.int64]
    """Tick of the last look plus what its evidence is worth (ticks), more than the rank of whatever
    that look added to or changed; -1 is unknown [H, W]."""

    @classmethod
    def none(cls, height: int, width: int) -> Evidence:
        """That of a map without a known cell."""
        shape = height, width
        return cls(np.zeros(shape, np.int8), np.full(shape, NEVER_SEEN, np.int64))

    @property
    def map(self) -> Map:
        """Unknown, free and occupied cells, int8 [H, W]."""
        codes = np.where(self.looks > 0, np.int8(OCCUPIED), np.int8(FREE))
        return np.where(self.looks == 0, np.int8(UNKNOWN), codes)

    def check(self) -> None:
        """Raise an error for what cannot be the evidence for a map.

        Raises:
            ValueError: saying why.
        """
        looks, rank = self.looks, self.rank
        for name, array, kind in (("looks", looks, np.int8), ("rank", rank, np.int64)):
            if getattr(array, "dtype", None) != kind or array.ndim != 2:
                raise ValueError(f"{name} of evidence are not allowed: not {kind.__name__} [H, W]")
        if rank.shape != looks.shape:
            raise ValueError(f"evidence of {looks.shape} looks and {rank.shape} ranks")
        if (np.abs(looks.astype(np.int64)) > MOST_LOOKS).any():
            raise ValueError(f"evidence of more than {MOST_LOOKS} looks")
        if (rank < NEVER_SEEN).any():
            raise ValueError("evidence of looks before the first tick")
        if (rank > MOST_RANK).any() or (rank[looks == 0] != NEVER_SEEN).any():
            raise ValueError(f"evidence of a rank that there cannot be: at most {MOST_RANK}")

    def looked(self, found: Map, tick: int, model: EvidenceModel, stood: GridCell) -> Evidence:
        """The evidence after one more look.

        Args:
            found: what the look found in each cell, int8 [H, W]; unknown says nothing.
            tick: when it was made.
            model: how looks count.
            stood: the cell in which the robot stands: it is free, however many looks say otherwise.
        """
        step = np.where(found == OCCUPIED, np.int8(1), np.int8(-1))
        looks = np.clip(self.looks + step, -model.limit, model.limit)
        looks = np.where(looks == 0, step, looks)  # 0 is unknown: a change of mind leaves it out
        looks[stood] = -model.limit
        worth = tick + model.ticks_per_look * np.abs(looks).astype(np.int64)
        says = found != UNKNOWN
        says[stood] = True
        return Evidence(
            np.where(says, looks, self.looks),
            np.where(says, np.maximum(self.rank + 1, worth), self.rank),
        )

    def without(self, cells: Iterable[GridCell], model: EvidenceModel) -> tuple[Evidence, int]:
        """The evidence without obstacles in some cells, and how many there were.

        For the cells in which a robot has been that others took for an obstacle.
        """
        looks, rank = self.looks.copy(), self.rank.copy()
        wrong = [cell for cell in cells if looks[cell] > 0]
        for cell in wrong:
            looks[cell] = -model.limit
            rank[cell] += 1
        return Evidence(looks, rank), len(wrong)

    def joined(self, other: Evidence) -> Evidence:
        """In every cell the evidence with the higher rank; at the same rank more looks count, then
        an obstacle."""
        mine, theirs = self._order(), other._order()
        wins = np.zeros(self.looks.shape, bool)
        for own, its in zip(reversed(mine), reversed(theirs), strict=True):
            wins = (its > own) | ((its == own) & wins)
        return Evidence(
            np.where(wins, other.looks, self.looks), np.where(wins, other.rank, self.rank)
        )

    def _order(self) -> tuple[NDArray[np.int64], NDArray[np.int8], NDArray[np.int8]]:
        """What is compared, the most important first."""
        return self.rank, np.abs(self.looks), self.looks

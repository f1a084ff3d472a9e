"""Whether another robot's map fits the own one; if not, whether its frame is moved or turned."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from marl_explore.config.checks import require_integer, require_share
from marl_explore.config.constants import UNKNOWN
from marl_explore.config.fields import check_types
from marl_explore.robot.evidence import Map

FEWEST_CONTRADICTIONS = 3
"""Of maps that mostly contradict each other: fewer may be robots that stood there."""
_FAR_BETTER = 4
"""A moved map fits far better if it contradicts at most one cell in so many of before."""


@dataclass(frozen=True)
class MergeLimits:
    """Which maps of other robots are refused.

    Those that exceed the first two limits, and those of which more than half contradict.
    """

    contradictions: int = 5
    """Cells known in both maps that contradict each other."""
    share: float = 0.1
    """Share of those in the cells known in both."""
    search_cells: int = 3
    """How far a frame may be moved to be recognised (cells)."""

    def __post_init__(self) -> None:
        """Check the limits."""
        check_types(self)
        require_integer("contradictions", self.contradictions, 0)
        require_share("share", self.share)
        require_integer("search_cells", self.search_cells, 0, 16)

    def exceeded(self, fit: Fit) -> bool:
        """Whether two maps contradict each other too much to be merged."""
        few = self.contradictions, self.share * fit.common
        mostly = fit.contradictions >= FEWEST_CONTRADICTIONS and 2 * fit.contradictions > fit.common
        return fit.contradictions > max(few) or mostly


class Fit(NamedTuple):
    """How well two maps agree."""

    contradictions: int
    """Cells known in both that contradict each other."""
    common: int
    """Cells known in both."""


class Moved(NamedTuple):
    """How the frame of another robot differs: turned about the arena's middle, then moved."""

    quarters: int
    """Quarter turns, counter-clockwise."""
    east: int
    """Cells."""
    north: int
    """Cells."""

    def __str__(self) -> str:
        steps = ((self.east, "east", "west"), (self.north, "north", "south"))
        moves = [
            f"{abs(by)} cell{'s' * (abs(by) > 1)} {plus if by > 0 else minus}"
            for by, plus, minus in steps
            if by
        ]
        parts = [f"turned by {90 * self.quarters} degrees"] * (self.quarters > 0)
        parts += [f"moved by {' and '.join(moves)}"] * bool(moves)
        return " and ".join(parts)


class Refusal(NamedTuple):
    """A map that was not merged."""

    robot: int
    """Whose map it is."""
    tick: int
    fit: Fit
    cause: Moved | None
    """How that robot's frame seems to differ from the own one; None: no such cause fits."""

    def __str__(self) -> str:
        wrong, common = self.fit
        cause = f": its frame seems to be {self.cause}" if self.cause else ""
        return (
            f"the map of robot {self.robot} at tick {self.tick} was not merged, since it "
            f"contradicts {wrong} of {common} common cells{cause}"
        )


def fit(own: Map, other: Map) -> Fit:
    """How well two maps of the same arena agree."""
    common = (own != UNKNOWN) & (other != UNKNOWN)
    return Fit(int((common & (own != other)).sum()), int(common.sum()))


def likely_cause(own: Map, other: Map, limits: MergeLimits) -> Moved | None:
    """How the frame of another robot's map differs, if one move makes the maps agree far better.

    Args:
        own: a map, int8 [H, W].
        other: a map that contradicts it.
        limits: how far a frame may be moved, and how much maps may contradict each other.

    Returns:
        By what the other map's frame is turned and moved in comparison with the own one. Of several
        that fit, the one with the smallest share of contradictions, then with the most cells.
    """
    before = fit(own, other)
    best, cause = (_share(before) / _FAR_BETTER, 0), None
    most = min(limits.search_cells, *(side - 1 for side in own.shape))
    moves = range(-most, most + 1)
    turns = [_turned(other, quarters, own.shape) for quarters in range(4)]
    for (quarters, turned), east, north in product(enumerate(turns), moves, moves):
        after = fit(*_overlap(own, turned, east, north))
        score = _share(after), -after.common
        enough = 2 * after.common >= before.common and not limits.exceeded(after)
        if enough and score < best:
            best, cause = score, Moved(quarters, east, north)
    return cause


def _share(fit: Fit) -> float:
    return fit.contradictions / max(fit.common, 1)


def _turned(grid: Map, quarters: int, shape: tuple[int, ...]) -> Map:
    """A map turned counter-clockwise about its middle, on another map's cells.

    Nothing is known if their cells do not lie on each other: a quarter turn of 3 x 4 cells.
    """
    turned = np.rot90(grid, quarters)
    (rows, columns), (height, width) = turned.shape, shape
    placed = np.full(shape, UNKNOWN, np.int8)
    if (height - rows) % 2 or (width - columns) % 2:
        return placed
    down, right = (height - rows) // 2, (width - columns) // 2
    target = placed[max(down, 0) : height - max(down, 0), max(right, 0) : width - max(right, 0)]
    target[:] = turned[
        max(-down, 0) : rows - max(-down, 0), max(-right, 0) : columns - max(-right, 0)
    ]
    return placed


def _overlap(own: Map, other: Map, east: int, north: int) -> tuple[Map, Map]:
    """The cells of two maps that lie on each other once the other one is moved."""
    height, width = own.shape
    here = np.s_[max(-north, 0) : height - max(north, 0), max(east, 0) : width - max(-east, 0)]
    there = np.s_[max(north, 0) : height - max(-north, 0), max(-east, 0) : width - max(east, 0)]
    return own[here], other[there]

"""Shapes of sensors: which cells around a robot its sensor covers."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple, TypeVar

from marl_explore.config.constants import TOLERANCE

Entry = TypeVar("Entry")
MAX_SENSING_CELLS = 1000
"""Largest sensing radius in cells: a field of view beyond it holds millions of cells per robot."""

HalfWidths = Callable[[float], Sequence[int]]
"""A shape: from the range in cells to how many cells it reaches to either side, in the row of the
robot and in each row above (and below)."""


def square(range_cells: float) -> list[int]:
    """The largest square that lies inside the sensing disc, as in the paper."""
    radius = math.floor(range_cells / math.sqrt(2) - 0.5 + TOLERANCE)
    return [radius] * (radius + 1)


def disc(range_cells: float) -> list[int]:
    """Every cell whose centre is in range."""
    radius = math.floor(range_cells + TOLERANCE)
    limit = math.floor((range_cells + TOLERANCE) ** 2)
    return [math.isqrt(limit - row * row) for row in range(radius + 1)]


SHAPES: dict[str, HalfWidths] = {"square": square, "disc": disc}
"""A new sensor is a function and a row here; it must grow with the range."""


def half_widths(shape: str, range_cells: float) -> tuple[int, ...]:
    """How many cells the shape reaches to either side in the rows 0 to k from its centre."""
    return _half_widths(SHAPES[shape], range_cells)


@lru_cache
def _half_widths(shape: HalfWidths, range_cells: float) -> tuple[int, ...]:
    return tuple(shape(range_cells))


def shape_radius(shape: str, range_cells: float) -> int:
    """k of the smallest (2k+1) x (2k+1) window that holds the shape, for a range in cells."""
    widths = half_widths(shape, range_cells)
    return max(len(widths) - 1, *widths, 0)


def holds_neighbours(shape: str, range_cells: float) -> bool:
    """Whether the shape holds the 3 x 3 cells around a robot."""
    widths = half_widths(shape, range_cells)
    return len(widths) > 1 and min(widths[:2]) >= 1


def smallest_range(shape: str) -> float:
    """Smallest range with which a shape holds 3 x 3 cells (cells), to a millionth.

    Raises:
        ValueError: naming the shape, if it never does.
    """
    return _smallest_range(SHAPES[shape], shape)


@lru_cache
def _smallest_range(half_widths: HalfWidths, shape: str) -> float:
    low, high = 0.0, 1.0
    while not holds_neighbours(shape, high):
        high *= 2
        never = f"sensing_shape={shape!r} is not allowed: it never holds 3 x 3 cells"
        if high > MAX_SENSING_CELLS:
            raise ValueError(never)
    while high - low > 1e-6:
        middle = (low + high) / 2
        low, high = (low, middle) if holds_neighbours(shape, middle) else (middle, high)
    return high


def cells_in_shape(shape: str, range_cells: float) -> int:
    """Number of cells of the shape, its centre among them; of a square (2k + 1)^2."""
    middle, *others = (2 * width + 1 for width in half_widths(shape, range_cells))
    return middle + 2 * sum(others)


def most_discovered(shape: str, range_cells: float) -> int:
    """The most cells of the shape that one move brings in; of a square 4k + 1."""
    widths = half_widths(shape, range_cells)
    rows = (*reversed(widths), *widths[1:])
    straight = len(rows)  # one cell per row
    # a diagonal move shifts a row to the next one, and one cell sideways
    diagonal = sum(
        2 * new + 1 - _shared(new, old) for new, old in zip(rows, (*rows[1:], -1), strict=True)
    )
    return max(straight, diagonal)


def _shared(new: int, old: int) -> int:
    """Cells that a row of half width ``new``, moved by one, shares with one of ``old``."""
    return max(0, min(new + 1, old) - max(1 - new, -old) + 1)


def one_if_equal(values: Iterable[Entry]) -> Entry | tuple[Entry, ...]:
    """Settings of each robot as a tuple, or the setting itself if all are equal."""
    entries = tuple(values)
    return entries[0] if len(set(entries)) == 1 else entries


@dataclass(frozen=True)
class Sight:
    """What the robots of a team can see: the shapes of their sensors, and whether walls end sight.

    Windows, fields of view and expected gains all follow from it.
    """

    shape: str
    """Of every sensor, a name of ``SHAPES``."""
    ranges_cells: tuple[float, ...]
    """Of each robot, or one for all."""
    line_of_sight: bool = False
    """Whether obstacles hide what lies behind them."""

    @classmethod
    def square(cls, radius: int) -> Sight:
        """Sight of the (2k+1) x (2k+1) cells around a robot, as in the paper."""
        return cls("square", ((radius + 0.5) * math.sqrt(2),))

    @cached_property
    def radii(self) -> tuple[int, ...]:
        """k of each robot, or one for all."""
        return tuple(shape_radius(self.shape, reach) for reach in self.ranges_cells)

    @cached_property
    def radius(self) -> int:
        """k of the window that holds all shapes."""
        return max(self.radii)

    @cached_property
    def side(self) -> int:
        """Side of that window, 2k + 1 (cells)."""
        return 2 * self.radius + 1

    @cached_property
    def sizes(self) -> tuple[int, ...]:
        """Cells in the shape of each robot, or one number for all."""
        return tuple(cells_in_shape(self.shape, reach) for reach in self.ranges_cells)

    @cached_property
    def fills_windows(self) -> bool:
        """Whether every robot sees its whole window, as far as it lies in the arena."""
        return self.shape == "square" and len(set(self.radii)) == 1 and not self.line_of_sight

    def of(self, robot: int) -> Sight:
        """The sight of one robot."""
        reach = self.ranges_cells[robot if len(self.ranges_cells) > 1 else 0]
        return Sight(self.shape, (reach,), self.line_of_sight)


class Ring(NamedTuple):
    """The cells at one distance m from the centre of a window, as indices of it when flattened."""

    cell: list[int]
    """Its 8 m cells."""
    parent: list[list[int]]
    """The two cells through which each is seen; twice the same if there is one."""
    side: list[list[list[int]]]
    """The two cells beside a diagonal step from each parent; of a straight step the parent itself,
    which is no obstacle if the cell is seen through it."""


def rings(radius: int) -> list[Ring]:
    """The rings of a window of side 2k + 1, from the inside out, for line of sight."""
    return [_ring(m, radius) for m in range(1, radius + 1)]


def _ring(m: int, radius: int) -> Ring:
    side = 2 * radius + 1
    offsets = [
        (r, c) for r in range(-m, m + 1) for c in range(-m, m + 1) if max(abs(r), abs(c)) == m
    ]

    def index(r: int, c: int) -> int:
        return (r + radius) * side + c + radius

    ring = Ring([index(*offset) for offset in offsets], [], [])
    for r, c in offsets:
        # only the shorter coordinate can lie halfway between two cells
        rows, columns = (_nearest(part * (m - 1), m) for part in (r, c))
        pair = [(row, column) for row in rows for column in columns]
        pair = [pair[0], pair[-1]]
        ring.parent.append([index(*parent) for parent in pair])
        ring.side.append([[index(row, c), index(r, column)] for row, column in pair])
    return ring


def _nearest(numerator: int, denominator: int) -> tuple[int, ...]:
    """The integer nearest to a fraction, or both if it lies halfway between two."""
    below, rest = divmod(numerator, denominator)
    if 2 * rest == denominator:
        return below, below + 1
    return (below + (2 * rest > denominator),)

"""Occupancy grids in metres, and the coarse grid on which an explorer plans.

The coarse grid is a lattice of the map's frame, not of a map: a cell keeps its place while maps
grow and change their origin, and the maps of a team lie on the same cells. A coarse cell is

- free, if the robot fits into it: one of its fine cells is free and at least the robot's radius
  away from every occupied fine cell (measured between the middles of cells);
- else unknown, if one of its fine cells is unknown and as far away from what is occupied, or if the
  map does not cover it;
- else occupied.

No passage into which the robot fits is closed: a way over fine cells is one over coarse cells and
their eight neighbours. And no wall leaks, however it lies: places on both sides of it into which
the robot fits are at least 2 (radius - resolution / sqrt(2)) apart, and places in neighbouring
coarse cells at most sqrt(8) sides. That is less with a ``SIDE`` of half the radius and fine cells
of at most two thirds of that; larger ones are split.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_explore.config.checks import require, require_positive
from marl_explore.config.constants import FREE, OCCUPIED, UNKNOWN
from marl_explore.robot.explorer.places import Place, Point, require_place
from marl_explore.robot.geometry import GridCell

Mask = NDArray[np.bool_]
Floats = NDArray[np.floating]
SIDE = 0.5
"""Of a coarse cell, in radii of the robot."""
FINEST = 0.001
"""Smallest cells of maps (metres)."""
MOST_AREA = 100_000.0
"""Largest map, unknown cells included (square metres)."""
FINE_CELLS_IN_SIDE = 1.5
"""Fine cells in a side of a coarse one, at least: then some middle lies in every coarse cell."""
MOST_CELLS = 8_000_000
"""Most fine cells once they are split, and most cells of the coarse grid around the map: a look at
them takes seconds."""
MOST_TOGETHER = 2 * MOST_CELLS
"""Most cells of the coarse grid around the maps of a team."""
MOST_REACH = 200
"""Most fine cells in a robot's radius: each costs time in every other one."""
OCCUPIED_FROM = 50
"""Percent from which a cell is occupied; below it is free, and negative is unknown."""


@dataclass(frozen=True)
class OccupancyMap:
    """A map as ROS's OccupancyGrid has it."""

    percent: NDArray[np.int8]
    """Probability of an obstacle [H, W]; -1 is unknown. Rows go along y, columns along x."""
    resolution: float
    """Side of a cell (metres)."""
    origin: Place
    """Outer corner of the first cell; its yaw turns the whole map."""

    def check(self) -> None:
        """Raise an error for a map without cells or too large, and numbers that are none.

        Raises:
            ValueError: naming the field and its value.
        """
        kind = getattr(self.percent, "dtype", type(self.percent))
        require(kind == np.int8, "percent", kind, "it must be an array of int8")
        shape = self.percent.shape
        require(len(shape) == 2 and min(shape) > 0, "shape", shape, "a map needs cells")
        require_positive("resolution", self.resolution, "metres")
        finest = f"it must be at least {FINEST} m"
        require(self.resolution >= FINEST, "resolution", self.resolution, finest)
        area = self.percent.size * self.resolution**2
        require(area <= MOST_AREA, "area", area, f"it must be at most {MOST_AREA:g} m2")
        low, high = int(self.percent.min()), int(self.percent.max())
        allowed = "it must be -1, or from 0 to 100"
        require(low >= -1, "percent", low, allowed)
        require(high <= 100, "percent", high, allowed)
        require_place("origin", self.origin)

    def check_size(self, radius: float) -> None:
        """Raise an error for a map that has too many cells for a robot of some radius (metres).

        Raises:
            ValueError: naming the resolution, the radius and what is allowed.
        """
        what = f"for robots of radius={radius:g} m"
        finest = f"{what} it must be at least {radius / MOST_REACH:g} m"
        require(radius <= MOST_REACH * self.resolution, "resolution", self.resolution, finest)
        (height, width), coarse = self.percent.shape, self.coarse_cells(radius)
        fine = height * width * self._parts(radius) ** 2
        allowed = (
            f"{what} the {height} x {width} cells of this map become {fine} fine and {coarse:.0f} "
            f"coarse ones, and at most {MOST_CELLS} are allowed"
        )
        require(max(fine, coarse) <= MOST_CELLS, "resolution", self.resolution, allowed)

    def coarse_cells(self, radius: float) -> float:
        """About how many coarse cells are around it for a robot of some radius (metres)."""
        height, width = (cells * self.resolution / (SIDE * radius) for cells in self.percent.shape)
        cos, sin = abs(math.cos(self.origin.yaw)), abs(math.sin(self.origin.yaw))
        return (cos * width + sin * height + 1) * (sin * width + cos * height + 1)

    def _parts(self, radius: float) -> int:
        """Into how many parts a side of a cell is split for a robot of some radius (metres)."""
        largest = SIDE * radius / FINE_CELLS_IN_SIDE
        return max(math.ceil(self.resolution / largest - 1e-9), 1)

    def moved(self, frame: Place) -> OccupancyMap:
        """The map in the frame in which its own frame is given."""
        return replace(self, origin=frame.then(self.origin))

    def refined(self, radius: float) -> OccupancyMap:
        """The same map, its cells split until they suit a robot of some radius (metres)."""
        parts = self._parts(radius)
        if parts == 1:
            return self
        split = self.percent.repeat(parts, 0).repeat(parts, 1)
        return replace(self, percent=split, resolution=self.resolution / parts)

    def middles(self, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> tuple[Floats, Floats]:
        """Middles of cells, x and y (metres); the indices are broadcast."""
        cos, sin = math.cos(self.origin.yaw), math.sin(self.origin.yaw)
        u, v = (columns + 0.5) * self.resolution, (rows + 0.5) * self.resolution
        return self.origin.x + cos * u - sin * v, self.origin.y + sin * u + cos * v

    def around(self, point: Point, reach: float) -> tuple[tuple[slice, slice], Floats]:
        """The window of cells within a reach of a point, and their distances to it (metres)."""
        u, v = (entry / self.resolution for entry in self.origin.within(point))
        cells, (height, width) = reach / self.resolution + 1, self.percent.shape
        top, left = max(math.floor(v - cells), 0), max(math.floor(u - cells), 0)
        rows = np.arange(top, min(max(math.ceil(v + cells), top), height))
        columns = np.arange(left, min(max(math.ceil(u + cells), left), width))
        distance = np.hypot(rows[:, None] + 0.5 - v, columns + 0.5 - u) * self.resolution
        window = np.s_[top : top + len(rows), left : left + len(columns)]
        return window, distance


class CoarseGrid(NamedTuple):
    """A part of the lattice; row 0 is that with the smallest y."""

    codes: NDArray[np.int8]
    """Unknown, free or occupied [H, W]."""
    first: GridCell
    """Row and column of the first cell in the lattice, whose cell (0, 0) begins at the origin."""
    side: float
    """Of a cell (metres)."""

    def cell(self, point: Point | Place) -> GridCell:
        """The cell that contains a point; it may be outside."""
        row, column = math.floor(point[1] / self.side), math.floor(point[0] / self.side)
        return row - self.first[0], column - self.first[1]

    def middle(self, cell: GridCell) -> Point:
        """Middle of a cell (metres)."""
        row, column = cell[0] + self.first[0], cell[1] + self.first[1]
        return (column + 0.5) * self.side, (row + 0.5) * self.side

    def code(self, cell: GridCell) -> int:
        """Value of a cell; unknown outside."""
        height, width = self.codes.shape
        inside = 0 <= cell[0] < height and 0 <= cell[1] < width
        return int(self.codes[cell]) if inside else UNKNOWN

    def mask(self, cells: Iterable[GridCell]) -> Mask:
        """Some cells of the lattice as a mask, bool [H, W]; those outside are left out."""
        mask, (height, width) = np.zeros(self.codes.shape, bool), self.codes.shape
        rows, columns = np.array(list(cells), int).reshape(-1, 2).T
        rows, columns = rows - self.first[0], columns - self.first[1]
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        mask[rows[inside], columns[inside]] = True
        return mask

    def is_in(self, point: Point | Place, cells: Mask) -> bool:
        """Whether a point lies in some of the cells, bool [H, W]."""
        row, column = self.cell(point)
        height, width = cells.shape
        return 0 <= row < height and 0 <= column < width and bool(cells[row, column])

    def distances(self, point: Point | Place) -> Floats:
        """Distances of the middles of all cells from a point [H, W] (metres)."""
        height, width = self.codes.shape
        x = (np.arange(width) + self.first[1] + 0.5) * self.side - point[0]
        y = (np.arange(height) + self.first[0] + 0.5) * self.side - point[1]
        return np.hypot(y[:, None], x)


class CoarseMap:
    """The coarse grid of one map, which still knows where in its cells the robot fits.

    Args:
        given: the map, in the frame of the lattice.
        radius: of the robot (metres).
        bodies: where robots are or have been; they are no obstacles.
        body_radius: how near to those obstacles are robots (metres).
    """

    def __init__(
        self,
        given: OccupancyMap,
        radius: float,
        bodies: Iterable[Point] = (),
        body_radius: float = 0,
    ) -> None:
        side = SIDE * radius
        self.fine = fine = given.refined(radius)
        occupied = fine.percent >= OCCUPIED_FROM
        erased = np.zeros_like(occupied)
        for body in bodies:
            window, distance = fine.around(body, body_radius)
            erased[window] |= occupied[window] & (distance < body_radius)
        occupied &= ~erased
        unknown, fits = fine.percent < 0, ~nearer(occupied, radius / fine.resolution)
        self._fits = fits & ~unknown & ~occupied
        rows, columns = self._lattice_cells(side)
        top, left = int(rows.min()), int(columns.min())
        shape = int(rows.max()) - top + 1, int(columns.max()) - left + 1
        self._cell = (rows - top) * shape[1] + (columns - left)
        codes = np.full(shape, UNKNOWN, np.int8)
        flat = codes.ravel()
        flat[self._cell.ravel()] = OCCUPIED
        flat[self._cell[unknown & fits]] = UNKNOWN
        flat[self._cell[self._fits]] = FREE
        self.grid = CoarseGrid(codes, (top, left), side)
        self._bodies, self._reach = erased, radius / fine.resolution

    @cached_property
    def clear(self) -> Mask:
        """Cells that are free although robots are obstacles in the map, bool [H, W]."""
        fits, clear = self._fits, np.zeros(self.grid.codes.shape, bool)
        if self._bodies.any():
            fits = fits & ~nearer(self._bodies, self._reach)
        clear.ravel()[self._cell[fits]] = True
        return clear

    def _lattice_cells(self, side: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows and columns of all fine cells in the lattice [H, W]."""
        height, width = self.fine.percent.shape
        x, y = self.fine.middles(np.arange(height)[:, None], np.arange(width)[None])
        return np.floor(y / side).astype(np.int64), np.floor(x / side).astype(np.int64)

    def standing(self, place: Point | Place, reach: float) -> GridCell | None:
        """The cell of the place nearest to a robot's into which it fits, within a reach (metres).

        A robot can be nearer to a wall than its map thinks possible.
        """
        window, distance = self.fine.around((place[0], place[1]), reach)
        fits = self._fits[window]
        if not fits.any():
            return None
        nearest = np.where(fits, distance, np.inf).argmin()
        if distance.flat[nearest] > reach:
            return None
        return divmod(int(self._cell[window].ravel()[nearest]), self.grid.codes.shape[1])

    def spot(self, cell: GridCell) -> Point:
        """The place of a free cell, of those into which the robot fits, nearest to their mean."""
        inside = (self._cell == cell[0] * self.grid.codes.shape[1] + cell[1]) & self._fits
        x, y = self.fine.middles(*inside.nonzero())
        nearest = np.hypot(x - x.mean(), y - y.mean()).argmin()
        return float(x[nearest]), float(y[nearest])


def nearer(cells: Mask, reach: float) -> Mask:
    """Cells nearer than ``reach`` cells to one of some cells, bool [H, W]."""
    (height, width), most = cells.shape, math.ceil(reach) - 1
    counts = np.zeros((height, width + 2 * most + 1), np.int32)
    np.cumsum(cells, 1, out=counts[:, most + 1 : most + 1 + width])
    counts[:, most + 1 + width :] = counts[:, most + width, None]
    near = np.zeros_like(cells)
    for up in range(min(most + 1, height)):  # a map may be lower than the reach
        half = math.ceil(math.sqrt(reach * reach - up * up)) - 1
        right, left = most + half + 1, most - half
        wide = counts[:, right : right + width] != counts[:, left : left + width]
        near[up:] |= wide[: height - up]
        near[: height - up] |= wide[up:]
    return near


def span(grids: Sequence[CoarseGrid]) -> tuple[GridCell, tuple[int, int]]:
    """First cell and shape of the part of the lattice with all grids, and a border of a cell."""
    top, left = (min(grid.first[axis] for grid in grids) - 1 for axis in (0, 1))
    height, width = (
        max(grid.first[axis] + grid.codes.shape[axis] for grid in grids) + 1 - start
        for axis, start in ((0, top), (1, left))
    )
    return (top, left), (height, width)


def union(grids: Iterable[CoarseGrid]) -> CoarseGrid:
    """All grids in one, with a border of unknown cells; where they contradict, the first counts."""
    grids = list(grids)
    (top, left), shape = span(grids)
    codes = np.full(shape, UNKNOWN, np.int8)
    for grid in grids:
        part = codes[_window(grid, top, left)]
        np.copyto(part, grid.codes, where=part == UNKNOWN)
    return CoarseGrid(codes, (top, left), grids[0].side)


def part_of(grid: CoarseGrid, first: GridCell, shape: tuple[int, int]) -> NDArray[np.int8]:
    """The codes of a part of the lattice [H, W], unknown where the grid does not cover it.

    Args:
        grid: of the same lattice.
        first: row and column of the first cell.
        shape: of the part.
    """
    codes = np.full(shape, UNKNOWN, np.int8)
    (top, left), (height, width) = grid.first, grid.codes.shape
    up, side = max(top, first[0]), max(left, first[1])
    bottom, right = min(top + height, first[0] + shape[0]), min(left + width, first[1] + shape[1])
    if bottom > up and right > side:
        inner = grid.codes[up - top : bottom - top, side - left : right - left]
        codes[up - first[0] : bottom - first[0], side - first[1] : right - first[1]] = inner
    return codes


def spread(cells: Mask, grid: CoarseGrid, over: CoarseGrid) -> Mask:
    """A mask of a grid's cells as one of a grid that contains it, bool [H, W]."""
    mask = np.zeros(over.codes.shape, bool)
    mask[_window(grid, *over.first)] = cells
    return mask


def _window(grid: CoarseGrid, top: int, left: int) -> tuple[slice, slice]:
    row, column = grid.first[0] - top, grid.first[1] - left
    return np.s_[row : row + grid.codes.shape[0], column : column + grid.codes.shape[1]]

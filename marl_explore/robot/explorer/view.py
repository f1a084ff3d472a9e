"""What an explorer sees when it looks at all maps: one coarse grid, ways, frontiers, rivals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from marl_explore.config.constants import FREE, OCCUPIED
from marl_explore.robot.explorer.choice import Rival
from marl_explore.robot.explorer.frontiers import Cluster, border, cells_of, long_clusters
from marl_explore.robot.explorer.grids import (
    MOST_TOGETHER,
    CoarseGrid,
    CoarseMap,
    Mask,
    OccupancyMap,
    span,
    spread,
    union,
)
from marl_explore.robot.explorer.merging import fit
from marl_explore.robot.explorer.places import Place, Point
from marl_explore.robot.explorer.settings import ExplorerSettings
from marl_explore.robot.explorer.team import Mate, Team
from marl_explore.robot.explorer.wavefront import NO_WAY, Lengths, path, ways
from marl_explore.robot.geometry import GridCell

STANDING = 3.0
"""A robot is at the nearest place into which it fits, at most so many radii away."""


class Reach(NamedTuple):
    """What a robot reaches over free cells, and what is unknown beside it."""

    lengths: Lengths
    """Of ways from the robot."""
    frontiers: tuple[Cluster, ...]
    """Unknown cells beside cells that it reaches, in clusters that are long enough."""
    border: Mask
    """The cells of these clusters."""
    small: int
    """Clusters that are too short."""
    unreachable: int
    """Clusters that are long enough, but beside cells that it does not reach."""

    @staticmethod
    def over(grid: CoarseGrid, start: GridCell, least: float) -> Reach:
        """Find ways and frontiers.

        Args:
            grid: with a border of unknown cells.
            start: where the robot is.
            least: shortest cluster that is a frontier (metres).
        """
        free = grid.codes == FREE
        lengths = ways(free, start)
        reached = border(grid.codes, lengths != NO_WAY)
        frontiers, small = long_clusters(reached, grid.side, least)
        beyond = border(grid.codes, free & (lengths == NO_WAY)) & ~reached
        return Reach(
            lengths=lengths,
            frontiers=tuple(frontiers),
            border=cells_of(frontiers, free.shape),
            small=small,
            unreachable=len(long_clusters(beyond, grid.side, least)[0]),
        )


@dataclass(frozen=True)
class View:
    """All maps at one moment."""

    grid: CoarseGrid
    """Their union; the own map counts where they contradict."""
    layers: tuple[CoarseMap, ...]
    """The own map, then the teammates' whose maps fit, the last heard first."""
    reach: Reach
    near: float
    """How far from a place the cell may be in which something stands (metres)."""
    start: GridCell
    """Where the robot is."""
    union: CoarseGrid
    """The grid as the maps have it."""
    visited: tuple[set[GridCell], ...]
    """Cells in which each robot has been whose map is one of the layers."""
    least: float
    """Shortest cluster of a frontier (metres)."""
    rivals: tuple[Rival, ...]
    """Teammates that are heard."""

    @property
    def free(self) -> Mask:
        """Cells into which the robot fits."""
        return self.grid.codes == FREE

    def length(self, cell: GridCell) -> float:
        """Length of the way to a reached cell (metres)."""
        return float(self.reach.lengths[cell]) * self.grid.side / 2

    def nearest_reached(self, point: Point | Place) -> GridCell | None:
        """The reached cell nearest to a point, if it is near."""
        return _nearest(self.grid, self.reach.lengths != NO_WAY, point, self.near)

    def is_linked(self, place: Place, point: Point | Place, most: float) -> bool:
        """Whether a way from one place to another is at most so long (metres)."""
        start, end = (_nearest(self.grid, self.free, where, self.near) for where in (place, point))
        if start is None or end is None:
            return False
        return bool(ways(self.free, start, round(2 * most / self.grid.side))[end] != NO_WAY)

    def farthest(self, rivals: Sequence[Rival], most: float) -> GridCell | None:
        """Of the cells that Nav2 reaches within a way (metres), the farthest from teammates."""
        lengths = self.reach.lengths
        near = self.clear & (lengths != NO_WAY) & (lengths <= round(2 * most / self.grid.side))
        if not near.any():
            return None
        theirs = [np.where(r.lengths == NO_WAY, np.inf, r.lengths) for r in rivals]
        away = np.where(near, np.minimum.reduce(theirs), -np.inf)
        nearest = np.where(away == away.max(), lengths, np.iinfo(lengths.dtype).max)
        return divmod(int(nearest.argmin()), lengths.shape[1])

    def path(self, cell: GridCell) -> list[GridCell]:
        """The cells of the way to a reached cell."""
        return path(self.reach.lengths, cell)

    def spot(self, cell: GridCell) -> Point:
        """Where in a free cell the robot fits best."""
        for layer in self.layers:
            inside = self._cell_of(layer.grid, cell)
            if layer.grid.code(inside) == FREE:
                return layer.spot(inside)
        return self.grid.middle(cell)

    @cached_property
    def clear(self) -> Mask:
        """Cells that are free in the own map as Nav2 has it, with robots as obstacles [H, W]."""
        own = self.layers[0]
        return spread(own.clear, own.grid, self.grid)

    @cached_property
    def reopened(self) -> View:
        """The same with a way wherever a robot of the team has been.

        What is in the way there may be a robot that has left, and that the own map has not seen
        leave; or it has been put there since, which only a look can tell.
        """
        visited = self.grid.mask(set().union(*self.visited))
        codes = self.grid.codes.copy()
        codes[visited & (codes == OCCUPIED)] = FREE
        grid = self.grid._replace(codes=codes)
        return replace(self, grid=grid, reach=Reach.over(grid, self.start, self.least))

    def _cell_of(self, other: CoarseGrid, cell: GridCell) -> GridCell:
        """A cell of the union in another part of the lattice."""
        up, side = (self.grid.first[axis] - other.first[axis] for axis in (0, 1))
        return cell[0] + up, cell[1] + side


def look(
    own: OccupancyMap, place: Place, team: Team, time: float, settings: ExplorerSettings
) -> View | None:
    """Put all maps together, and note at every teammate how its map fits.

    Returns:
        None when the robot is not near any place of its own map into which it fits.
    """
    size, body = settings.radius, settings.body_radius
    mine = CoarseMap(own, size, team.bodies(team.own, time, settings), body)
    start = mine.standing(place, STANDING * size)
    if start is None:
        return None
    layers = [mine]
    visited = [team.trail.cells]
    mates = sorted(team.mates.values(), key=lambda mate: -(mate.heard or 0.0))
    for mate in mates:
        if mate.map is None:
            continue
        layer = CoarseMap(mate.map, size, team.bodies(mate.name, time, settings), body)
        mate.fit = fit(mine.grid, layer.grid)
        mate.is_too_large = False
        mate.refused = mate.fit.contradicts(settings.most_conflicts)
        if mate.refused or mate.fit.is_little:
            continue
        _, shape = span([entry.grid for entry in (*layers, layer)])
        mate.is_too_large = mate.refused = math.prod(shape) > MOST_TOGETHER
        if not mate.refused:
            layers.append(layer)
            visited.append(mate.trail.cells)
    grid = union(layer.grid for layer in layers)
    first = grid.cell(mine.grid.middle(start))
    return View(
        grid=grid,
        layers=tuple(layers),
        reach=Reach.over(grid, first, settings.min_frontier),
        near=STANDING * size,
        start=first,
        union=grid,
        visited=tuple(visited),
        least=settings.min_frontier,
        rivals=tuple(_rivals(mates, grid, grid.codes == FREE, time, settings)),
    )


def _rivals(
    mates: Sequence[Mate], grid: CoarseGrid, free: Mask, time: float, settings: ExplorerSettings
) -> list[Rival]:
    """Teammates that are heard and stand on the map."""
    rivals = []
    for mate in mates:
        if mate.place is None or not mate.counts(time, settings):
            continue
        cell = _nearest(grid, free, mate.place, STANDING * settings.radius)
        if cell is not None:
            rivals.append(Rival(mate.name, mate.place, ways(free, cell), mate.goal))
    return rivals


def _nearest(grid: CoarseGrid, cells: Mask, point: Point | Place, reach: float) -> GridCell | None:
    """The nearest of some cells, if it is within a reach (metres)."""
    distances = np.where(cells, grid.distances(point), np.inf)
    nearest = divmod(int(distances.argmin()), cells.shape[1])
    return nearest if distances[nearest] <= reach else None

"""What an explorer has heard of its teammates."""

from __future__ import annotations

from dataclasses import dataclass

from marl_explore.robot.explorer.grids import MOST_TOGETHER, OccupancyMap
from marl_explore.robot.explorer.merging import Fit
from marl_explore.robot.explorer.places import Place, Point, Trail
from marl_explore.robot.explorer.settings import ExplorerSettings


@dataclass
class Mate:
    """A teammate; places and maps are in the own map's frame."""

    name: str
    frame: Place
    """Its map's frame in the own one."""
    trail: Trail
    map: OccupancyMap | None = None
    place: Place | None = None
    goal: Place | None = None
    heard: float | None = None
    """Lived time of its last word (seconds)."""
    fit: Fit | None = None
    """How its map fits the own one."""
    refused: bool = False
    """Whether its map contradicts the own one, or is too large."""
    is_too_large: bool = False
    """Whether it has too many cells together with those that were merged before."""

    def is_heard(self, time: float, settings: ExplorerSettings) -> bool:
        """Whether it is not lost."""
        return self.heard is not None and time - self.heard <= settings.lost_after

    def counts(self, time: float, settings: ExplorerSettings) -> bool:
        """Whether its place and goal mean something."""
        return self.is_heard(time, settings) and not self.refused

    def describe(self, time: float, settings: ExplorerSettings) -> str:
        """A sentence for people."""
        if self.heard is None:
            return f"{self.name}: not heard yet"
        said = []
        if not self.is_heard(time, settings):
            said.append(f"lost, last heard {time - self.heard:.0f} s ago")
        said.append(self._describe_map())
        return f"{self.name}: {'; '.join(said)}"

    def _describe_map(self) -> str:
        if self.fit is None:
            return "no map yet"
        common = f"{self.fit.common:.1f} m2 are in both maps"
        if self.fit.is_little:
            return f"map not merged yet, only {common}"
        if self.is_too_large:
            return f"map refused, its places do not count: over {MOST_TOGETHER} cells together"
        done = "map refused, its places do not count" if self.refused else "map merged"
        walls = f"{self.fit.conflicts:.1f} of {self.fit.walls:.1f} m2 of walls contradict"
        return f"{done}: {walls}, {common}"


@dataclass
class Team:
    """All teammates by name, and where the own robot has been."""

    own: str
    trail: Trail
    mates: dict[str, Mate]

    def bodies(self, of: str, time: float, settings: ExplorerSettings) -> list[Point]:
        """Where robots are or have been lately that can be obstacles in one robot's map."""
        points = [] if of == self.own else self.trail.points(time)
        for mate in self.mates.values():
            if mate.name == of or mate.refused:
                continue
            points += mate.trail.points(time)
            if mate.place is not None and mate.is_heard(time, settings):
                points.append((mate.place.x, mate.place.y))
        return points

"""A robot's knowledge: its map, and its discoveries since its last merge with each other robot."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Collection, Mapping

import numpy as np

from marl_explore.config.checks import require
from marl_explore.config.constants import NEVER, UNKNOWN
from marl_explore.robot.evidence import Evidence, EvidenceModel, Map
from marl_explore.robot.geometry import Frame, GridCell
from marl_explore.robot.mapper import square
from marl_explore.robot.merging import Fit, MergeLimits, Refusal, fit, likely_cause
from marl_explore.robot.packing import MOST_CELLS

_KEPT = 32


class Knowledge:
    """One robot's map and counts, as in docs/environment.md, Entries.

    Args:
        robot: number of the robot.
        robots: size of the team, N.
        frame: the arena's grid.
        model: how looks change cells.
        limits: which maps of others are refused.

    Raises:
        ValueError: for an arena of more cells than robots can share.
    """

    def __init__(
        self,
        robot: int,
        robots: int,
        frame: Frame,
        model: EvidenceModel | None = None,
        limits: MergeLimits | None = None,
    ) -> None:
        cells, allowed = frame.height * frame.width, f"robots share maps of at most {MOST_CELLS}"
        require(cells <= MOST_CELLS, "cells", cells, allowed)
        self.robot = robot
        self.frame = frame
        self.model, self.limits = model or EvidenceModel(), limits or MergeLimits()
        self.evidence = Evidence.none(frame.height, frame.width)
        self.map: Map = self.evidence.map
        """int8 [H, W]."""
        self.changes = 0
        """How often a cell of the map became known or changed."""
        self._others = np.arange(robots) != robot
        self.unshared = np.zeros(robots, np.int64)
        self.steps_since_merge = np.full(robots, NEVER, np.int64)
        self.steps_since_merge[robot] = 0
        self.refusals: deque[Refusal] = deque(maxlen=_KEPT)
        """The last maps that were refused."""
        self.refused: Counter[int] = Counter()
        """How many maps of each robot were refused."""
        self._stood: list[set[GridCell]] = [set() for _ in range(robots)]
        """Cells in which it has been, if only on its way, since its last merge with each robot."""
        self._began = False

    def sense(self, cell: GridCell, seen: Map, tick: int, passed: Collection[GridCell] = ()) -> int:
        """Add what a robot sees around its cell to the evidence; that cell itself is free.

        Args:
            cell: middle of the square, inside the arena.
            seen: ``mapper.sight``, int8 [2k + 1, 2k + 1].
            tick: when it was seen.
            passed: cells through which the robot has come since it sensed last.

        Returns:
            Number of cells that became known or changed.
        """
        found = self._placed(cell, seen)
        for stood in self._stood:
            stood.update((cell, *passed))
        changed = self._become(self.evidence.looked(found, tick, self.model, cell))
        self.unshared += changed
        self.unshared[self.robot] = 0
        self.pass_time()
        return changed

    def fit(self, cell: GridCell, seen: Map) -> Fit:
        """How well what a robot sees around its cell agrees with the map; as ``sense``."""
        return fit(self.map, self._placed(cell, seen))

    def _placed(self, cell: GridCell, seen: Map) -> Map:
        """What is seen around a cell as a map, int8 [H, W]."""
        found = np.full_like(self.map, UNKNOWN)
        for place, code in zip(square(cell, len(seen) // 2), seen.flat, strict=True):
            if self.frame.inside(place):
                found[place] = code
        return found

    def pass_time(self) -> None:
        """Count a step in which nothing was seen, or that has been seen."""
        if self._began:
            self.steps_since_merge = np.minimum(self.steps_since_merge + self._others, NEVER)
        self._began = True

    def merge(self, maps: Mapping[int, Evidence], tick: int = 0) -> int:
        """Merge the maps of the other members of a network into the own map.

        One that contradicts the own map, or those merged before it, is refused and reported. Where
        this robot has been since the last merge with another, that one's obstacle was this robot:
        the cell stays free.

        Args:
            maps: evidence by robot, merged in the order of their numbers.
            tick: when they are merged.

        Returns:
            Number of cells that became known or changed.
        """
        changed = 0
        for robot, evidence in sorted(maps.items()):
            corrected, wrong = evidence.without(self._stood[robot], self.model)
            other = corrected.map
            agreement = fit(self.map, other)
            if self.limits.exceeded(agreement):
                cause = likely_cause(self.map, other, self.limits)
                self.refusals.append(Refusal(robot, tick, agreement, cause))
                self.refused[robot] += 1
                continue
            changed += self._become(self.evidence.joined(corrected))
            self.unshared[robot], self.steps_since_merge[robot] = wrong, 0
            self._stood[robot].clear()
        return changed

    def _become(self, evidence: Evidence) -> int:
        """Take evidence over; the number of cells that became known or changed."""
        before, self.map = self.map, evidence.map
        self.evidence = evidence
        changed = int((before != self.map).sum())
        self.changes += changed
        return changed

    @property
    def known(self) -> int:
        """Number of known cells."""
        return int((self.map != UNKNOWN).sum())

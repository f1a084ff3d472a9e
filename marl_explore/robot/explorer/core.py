"""An explorer without a transport: takes maps and places, returns goals and a status."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from marl_explore.config.checks import require, require_time
from marl_explore.config.constants import UNKNOWN
from marl_explore.robot.explorer.grids import SIDE, OccupancyMap
from marl_explore.robot.explorer.mission import Mission
from marl_explore.robot.explorer.places import LivedTime, Place, Point, Trail, require_place
from marl_explore.robot.explorer.settings import ExplorerSettings
from marl_explore.robot.explorer.status import State, Status
from marl_explore.robot.explorer.team import Mate, Team
from marl_explore.robot.explorer.view import View, look

LOOK_EVERY = 1.0
"""Shortest time between two looks at the maps while the robot is on its way (seconds)."""


class Output(NamedTuple):
    """What an explorer wants now."""

    goal: Place | None
    """Where to send the robot; None: as before."""
    status: Status
    frontiers: list[list[Point]]
    """Unknown points beside what the robot reaches, in clusters that are long enough."""
    skipped: list[Point]
    """Frontiers that are left out."""
    plan: list[Point]
    """The way to the goal when it was chosen."""


class ExplorerCore:
    """Explores from goal to goal; something else, such as Nav2, drives the robot there.

    Pass maps and places to ``take_*`` and call ``advance`` about twice a second. It has no threads
    and reads no clock. What it takes counts from then on, whatever its stamp: the clocks of a team
    may differ.

    Args:
        settings: sizes and patience.
        name: of the robot in its team.
        mates: the teammates' names, and where the frames of their maps are in the own map's frame.

    Raises:
        ValueError: when the robot is its own teammate, or a frame is not finite.
    """

    def __init__(
        self,
        settings: ExplorerSettings | None = None,
        name: str = "",
        mates: Mapping[str, Place] | None = None,
    ) -> None:
        self.settings = settings or ExplorerSettings()
        mates = mates or {}
        require(name not in mates, "name", name, "a robot is none of its teammates")
        self.map: OccupancyMap | None = None
        self.place: Place | None = None
        self.view: View | None = None
        """All maps when they were last looked at."""
        self.mission: Mission | None = None
        """None until it has a map and a place."""
        self.team = Team(name, self._trail(), {})
        for mate, frame in mates.items():
            require_place("frame", frame)
            self.team.mates[mate] = Mate(mate, frame, self._trail())
        self._clock, self._time, self._maps = LivedTime(), 0.0, 0
        self._news, self._is_placed, self._counting = True, False, frozenset[str]()
        self._looked_at, self._looked_from = -math.inf, Place(0.0, 0.0)

    def _trail(self) -> Trail:
        return Trail(SIDE * self.settings.radius, self.settings.body_time)

    def take_map(self, given: OccupancyMap, mate: str | None = None) -> None:
        """Take the own map, or a teammate's in its own frame, instead of the one before.

        Raises:
            ValueError: for a map without cells or with too many, numbers that are none, or an
                unknown mate.
        """
        given.check()
        if mate is None:
            given.check_size(self.settings.radius)
            self.map, self._maps = given, self._maps + 1
        else:
            moved = given.moved(self._mate(mate).frame)
            moved.check_size(self.settings.radius)
            self._hear(mate).map = moved
        self._news = True

    def take_place(self, place: Place, mate: str | None = None) -> None:
        """Take the own place in the own map's frame, or a teammate's in that of its map.

        Raises:
            ValueError: for numbers that are none, or an unknown mate.
        """
        require_place("place", place)
        if mate is None:
            self.place = place
            self.team.trail.add(place, self._time)
        else:
            other = self._hear(mate)
            other.place = other.frame.then(place)
            other.trail.add(other.place, self._time)

    def take_goal(self, goal: Place, mate: str) -> None:
        """Take the goal that a teammate has chosen, in the frame of its map.

        Raises:
            ValueError: for numbers that are none, or an unknown mate.
        """
        require_place("goal", goal)
        other = self._hear(mate)
        other.goal, self._news = other.frame.then(goal), True

    def _mate(self, name: str) -> Mate:
        require(name in self.team.mates, "mate", name, f"there are {sorted(self.team.mates)}")
        return self.team.mates[name]

    def _hear(self, name: str) -> Mate:
        mate = self._mate(name)
        mate.heard = self._time
        return mate

    def advance(self, now: float) -> Output:
        """Decide; ``now`` is the node's clock (seconds), which may be set and may jump.

        Raises:
            ValueError: for a time that is none.
        """
        require_time("now", now)
        time = self._time = self._clock.pass_to(now)
        if self.map is None:
            return self._wait("waiting for a map")
        if self.place is None:
            return self._wait("waiting for the robot's place in its map")
        if self.mission is None:
            self.mission = Mission(self.team.own, self.settings, self.place)
        mission, goal = self.mission, None
        if self.view is not None:
            goal = mission.follow(self.view, self.place, self._maps, time)
        if not mission.is_waiting(self._maps, time):
            looks = self._is_due(mission, self.place)
            if looks:
                self._look(self.map, self.place)
            if mission.attempt is None and not self._is_placed:
                x, y = self.place.x, self.place.y
                return self._wait(
                    f"the robot at ({x:.2f}, {y:.2f}) is near no free place of its map"
                )
            if self.view is not None and (looks or mission.attempt is None):
                goal = mission.decide(self.view, self.place, time) or goal
        return self._output(goal, mission.state, mission.sentence)

    def _is_due(self, mission: Mission, place: Place) -> bool:
        """Whether to look at the maps again."""
        mates = self.team.mates.values()
        counting = frozenset(m.name for m in mates if m.counts(self._time, self.settings))
        self._news |= counting != self._counting
        self._counting = counting
        if self.view is None:
            return True
        if mission.attempt is None:
            return self._news or place.distance(self._looked_from) > self.settings.radius
        return self._news and self._time - self._looked_at >= LOOK_EVERY

    def _look(self, own: OccupancyMap, place: Place) -> None:
        view = look(own, place, self.team, self._time, self.settings)
        self._looked_at, self._looked_from, self._news = self._time, place, False
        self._is_placed = view is not None
        self.view = view or self.view

    # ------------------------------------------------------------ what it says

    def _wait(self, sentence: str) -> Output:
        return self._output(None, "waiting", sentence)

    def _output(self, goal: Place | None, state: State, sentence: str) -> Output:
        team = tuple(m.describe(self._time, self.settings) for m in self.team.mates.values())
        mission = self.mission
        view = self.view if mission is None else mission.view or self.view
        if view is None or mission is None:
            return Output(goal, Status(state, sentence, team=team), [], [], [])
        counts = mission.skips.count(view.union, view.reach.border)
        status = Status(
            state,
            sentence,
            known=float((view.grid.codes != UNKNOWN).sum()) * view.grid.side**2,
            frontiers=len(view.reach.frontiers),
            small=view.reach.small,
            unreachable=view.reach.unreachable,
            reached=mission.reached,
            skipped=counts.skipped,
            given_up=counts.given_up,
            exhausted=counts.exhausted,
            team=team,
        )
        return Output(
            goal,
            status,
            [[view.grid.middle(cell) for cell in cluster] for cluster in view.reach.frontiers],
            mission.skips.points(),
            mission.plan if mission.attempt is not None else [],
        )

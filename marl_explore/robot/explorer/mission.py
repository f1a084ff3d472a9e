"""From goal to goal, past those that cannot be reached, and back to the start."""

from __future__ import annotations

import math

from marl_explore.robot.explorer.choice import Rival, price
from marl_explore.robot.explorer.frontiers import Candidate, candidates, long_clusters
from marl_explore.robot.explorer.places import Place, Point
from marl_explore.robot.explorer.progress import NEAR, Attempt, Verdict
from marl_explore.robot.explorer.settings import ExplorerSettings
from marl_explore.robot.explorer.skips import TRIES, Counts, SkipList
from marl_explore.robot.explorer.status import State
from marl_explore.robot.explorer.view import View
from marl_explore.robot.geometry import GridCell

ASK_NAV2 = "is Nav2 active, and does it hear the goals?"
MOVED = 0.3
"""A robot that has come so far from its start can move (metres)."""
CROWDED = 5.0
"""A teammate so many radii from a robot that does not come to its goal may be in the way."""
ASIDE = 10.0
"""Longest way to a place where a robot is out of the way (radii)."""
MOST_BLOCKED = 4
"""Goals that are not reached beside a teammate, and do not count as tries, between two that are."""
MOST_CHOICES = 6
"""Times that a frontier is chosen; one that comes and goes in a map that flickers is left alone."""


class Mission:
    """What a robot does with what it sees; times are lived ones, in seconds.

    Args:
        name: of the robot in its team.
        settings: distances and patience.
        start: where it returns to.
    """

    def __init__(self, name: str, settings: ExplorerSettings, start: Place) -> None:
        self.name, self.settings, self.start = name, settings, start
        self.skips = SkipList()
        self.attempt: Attempt | None = None
        """The goal to which the robot is sent."""
        self.plan: list[Point] = []
        """The way to it when it was chosen."""
        self.reached = 0
        """Goals that were reached."""
        self.view: View | None = None
        """What the last choice was made from."""
        self.state: State = "exploring"
        self.sentence = ""
        self._chosen: list[Point] = []
        self._visited: Point | None = None
        self._next_map, self._waits_until = 0.0, -math.inf
        self._blocked, self._steps_aside = 0, False
        self._empty_since: float | None = None
        self._is_home = self._can_move = self._failed = self._is_open = False
        self._returns = self._sent_home = 0
        self._place, self._time = start, 0.0

    # ------------------------------------------------------------ on the way

    def follow(self, view: View, place: Place, maps: int, time: float) -> Place | None:
        """Judge how it goes, after ``maps`` own maps; the goal, if it should be sent again."""
        self._can_move |= place.distance(self.start) > MOVED
        if self.attempt is None:
            return None
        near = NEAR * self.settings.arrival
        left = place.distance(self.attempt.goal)
        if left <= near and not view.is_linked(place, self.attempt.goal, 2 * near):
            left = math.inf  # behind a wall
        verdict = self.attempt.judge(place, left, time)
        if verdict == "going":
            return self.attempt.goal if self.attempt.send_again(time) else None
        attempt, self.attempt = self.attempt, None
        if self._steps_aside:
            self._steps_aside = False
            self._next_map, self._waits_until = math.inf, time + self.settings.refusal
            return None
        if verdict != "arrived":
            return self._fail(attempt, verdict, view, place, time)
        if not attempt.final:
            return None
        self._blocked = 0
        if attempt.faces is None:
            self._is_home, self._returns = True, self._returns + 1
        else:
            self.reached += 1
            self._visited = attempt.faces
            self._next_map, self._waits_until = maps + 1, time + self.settings.map_patience
            self.sentence = "at a frontier, waiting for the next map"
        return None

    def _fail(
        self, attempt: Attempt, verdict: Verdict, view: View, place: Place, time: float
    ) -> Place | None:
        """Note that a goal was not reached; the place to step aside to, if a teammate is near."""
        self._failed = True
        reach = CROWDED * self.settings.radius
        near = [r for r in view.rivals if view.is_linked(place, r.place, reach)]
        if near and self._can_move and self._blocked < MOST_BLOCKED:
            self._blocked += 1
            is_first = all(self.name < rival.name for rival in near)
            is_asked = is_first == (self._blocked % 2 == 0)  # in turns, the first one last
            return self._step_aside(near, view, place, time) if is_asked else None
        if attempt.faces is None:
            self._returns += 1
        else:
            self.skips.add(attempt.faces, self.settings.goal_radius, verdict, view.union)
        return None

    def _step_aside(self, near: list[Rival], view: View, place: Place, time: float) -> Place | None:
        """Go away from teammates that want to pass, and wait there."""
        cell = view.farthest(near, ASIDE * self.settings.radius)
        if cell is None:
            return None
        self._place, self._time, self._steps_aside = place, time, True
        names = ", ".join(rival.name for rival in near)
        self.sentence = f"standing aside for {names}"
        return self._send(Place(*view.spot(cell), place.yaw), None, False, view.path(cell), view)

    def is_waiting(self, maps: int, time: float) -> bool:
        """Whether to wait for the first map after an arrival before anything is decided."""
        return maps < self._next_map and time < self._waits_until

    # ------------------------------------------------------------ where to go next

    def decide(self, view: View, place: Place, time: float) -> Place | None:
        """Choose what to do; the goal, if it is a new one."""
        self._place, self._time = place, time
        self.skips.renew(view.union)
        self._leave_visited(view)
        self._note_way_home(view)
        if self._steps_aside:
            return None
        self.view = view
        options = self._options(view, 1) or self._options(view, TRIES)
        if not options:
            self.view = view = view.reopened
            options = self._options(view, 1) or self._options(view, TRIES)
        if not options:
            return self._finish(view)
        self._empty_since, self._is_home = None, False
        self._returns = self._sent_home = 0
        return self._go(min(options, key=lambda option: self._price(option, view)), view)

    def _note_way_home(self, view: View) -> None:
        """Begin anew with returning when the way to the start opens."""
        was_open, self._is_open = self._is_open, view.nearest_reached(self.start) is not None
        if self._is_open and not was_open:
            self._returns = self._sent_home = 0

    def _options(self, view: View, tries: int) -> list[Candidate]:
        """Goals that were tried less often than that; 0: all."""
        settings, found = self.settings, view.reach.frontiers
        if tries:
            cells = view.reach.border & ~self.skips.covered(view.union, tries)
            found = tuple(long_clusters(cells, view.grid.side, settings.min_frontier)[0])
        return candidates(view.grid, view.reach.lengths, found, settings.goal_radius, settings.view)

    def _leave_visited(self, view: View) -> None:
        """Skip frontiers that have stayed although the robot has been there."""
        if self._visited is None:
            return
        if self.view is not None and self.view.grid is not self.view.union:
            view = view.reopened
        points = [
            view.grid.middle(option.faces)
            for option in self._options(view, 0)
            if option.way <= self.settings.arrival
        ]
        if view.grid.is_in(self._visited, view.reach.border):
            points.append(self._visited)
        self.skips.add_in_vain(points, self.settings.arrival, view.union)
        self._visited = None

    def _price(self, option: Candidate, view: View) -> float:
        total = price(option, view.grid, view.rivals, self.name, self.settings)
        return total - self.settings.keep * self._is_chosen(option, view)

    def _is_chosen(self, option: Candidate, view: View) -> bool:
        """Whether the robot is on its way there."""
        if self.attempt is None or self.attempt.faces is None:
            return False
        faces = Place(*view.grid.middle(option.faces))
        return faces.distance(self.attempt.faces) <= self.settings.goal_radius

    def _go(self, best: Candidate, view: View) -> Place | None:
        """Send the robot to a frontier, or on the way there to the last place that its map knows.

        Nav2 refuses goals outside its map, which is the own one.
        """
        cells = view.path(best.cell)
        stage = self._stage(cells, view)
        final, faces = stage is None, view.grid.middle(best.faces)
        x, y = view.spot(best.cell)
        goal = stage or Place(x, y, math.atan2(faces[1] - y, faces[0] - x))
        if self._failed and not self._can_move:
            self.state, self.sentence = "stuck", f"the robot has not moved yet: {ASK_NAV2}"
        else:
            self.state, self.sentence = "exploring", f"to a frontier at ({x:.2f}, {y:.2f})"
        if self.attempt is not None and self._is_chosen(best, view):
            longer = goal.distance(self.attempt.goal) > self.settings.arrival
            if self.attempt.final or not longer:
                return None
        elif self._is_chosen_too_often(faces):
            self.skips.add_in_vain([faces], self.settings.arrival, view.union)
            self.attempt = None
            return None
        return self._send(goal, faces, final, cells, view)

    def _stage(self, cells: list[GridCell], view: View) -> Place | None:
        """The last place on a way that Nav2 can plan to; None: the end, or it is not worth it."""
        clear = [bool(view.clear[cell]) for cell in cells]
        begin = clear.index(True) if any(clear) else 0  # it may stand beside a teammate
        known = clear.index(False, begin) if not all(clear[begin:]) else len(cells)
        last = cells[max(known - 1, 0)]
        near = self._place.distance(view.grid.middle(last)) <= NEAR * self.settings.arrival
        if near or last == cells[-1]:
            return None
        x, y = view.spot(last)
        ahead = view.grid.middle(cells[known])
        return Place(x, y, math.atan2(ahead[1] - y, ahead[0] - x))

    def _is_chosen_too_often(self, faces: Point) -> bool:
        self._chosen.append(faces)
        near = (Place(*faces).distance(point) <= self.settings.arrival for point in self._chosen)
        return sum(near) > MOST_CHOICES

    def _send(
        self, goal: Place, faces: Point | None, final: bool, cells: list[GridCell], view: View
    ) -> Place:
        way = view.length(cells[-1])
        self.attempt = Attempt(goal, faces, final, way, self._place, self._time, self.settings)
        self.plan = [view.grid.middle(cell) for cell in cells]
        return goal

    # ------------------------------------------------------------ when no frontier is left

    def _finish(self, view: View) -> Place | None:
        """Wait for a while, return to the start, and say what is left."""
        if self.attempt is not None and self.attempt.faces is not None:
            self.attempt = None
        left = self.skips.count(view.union, view.reach.border)
        if left.given_up and not self._can_move:  # the goals may be fine: begin anew
            self.skips.entries.clear()
            return None
        if self._empty_since is None:
            self._empty_since = self._time
        lasted, settle = self._time - self._empty_since, self.settings.settle
        if lasted < settle:
            self.state = "exploring"
            self.sentence = f"no frontier is left for {lasted:.0f} of {settle:g} s"
            return None
        self.state = "stuck" if left.given_up else "complete"
        self.sentence = self._what_is_left(left)
        return self._return(view) if self.settings.return_to_start else None

    def _what_is_left(self, left: Counts) -> str:
        if left.given_up:
            tried = "; ".join(self.skips.given_up())
            return f"{left.given_up} frontiers could not be reached in {TRIES} tries: {tried}"
        return "no frontier is left" + (
            f", but {left.exhausted} that stayed when the robot was there" * (left.exhausted > 0)
        )

    def _return(self, view: View) -> Place | None:
        """Return to the start, if that is possible."""
        if self._is_home or self._place.distance(self.start) <= self.settings.arrival:
            self._is_home = True
            return None
        cell = view.nearest_reached(self.start)
        if cell is None or self._returns >= TRIES or self._sent_home >= MOST_CHOICES:
            self.sentence += "; the robot cannot return to its start"
            return None
        self.state, self.sentence = "returning", f"{self.sentence}; returning to the start"
        if self.attempt is not None:
            return None
        self._sent_home += 1
        cells = view.path(cell)
        stage = self._stage(cells, view)
        return self._send(stage or self.start, None, stage is None, cells, view)

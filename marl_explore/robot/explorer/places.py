"""Places in the frame of a map, where robots have been, and time that does not jump."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

from marl_explore.config.checks import require, require_finite
from marl_explore.robot.geometry import wrapped

Point = tuple[float, float]
"""(x, y) in metres."""
FARTHEST = 100_000.0
"""Places farther from the origin of a map are none of a robot's (metres)."""


class Place(NamedTuple):
    """Where something is in the frame of a map, and where it looks."""

    x: float
    """Metres."""
    y: float
    """Metres."""
    yaw: float = 0.0
    """Counter-clockwise from the x axis (radians)."""

    def check(self) -> None:
        """Raise an error for numbers that are none or not finite, and for places very far away.

        Raises:
            ValueError: naming the field and its value.
        """
        for name, value in self._asdict().items():
            require_finite(name, value, most=FARTHEST)

    def distance(self, point: Point | Place) -> float:
        """Distance to a point (metres)."""
        return math.hypot(point[0] - self.x, point[1] - self.y)

    def then(self, inner: Place) -> Place:
        """A place that is given in this one's frame, in the frame in which this one is given."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        x, y = self.x + cos * inner.x - sin * inner.y, self.y + sin * inner.x + cos * inner.y
        return Place(x, y, wrapped(self.yaw + inner.yaw))

    def relative(self, other: Place) -> Place:
        """The reverse of ``then``: another place of the same frame, in this one's frame."""
        return Place(*self.within((other.x, other.y)), wrapped(other.yaw - self.yaw))

    def within(self, point: Point) -> Point:
        """The reverse of ``then`` for a point: where it is in this one's frame."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        x, y = point[0] - self.x, point[1] - self.y
        return cos * x + sin * y, cos * y - sin * x


def require_place(name: str, place: Place) -> None:
    """Require a place that can be a robot's or a frame's in a map."""
    require(isinstance(place, Place), name, place, "it must be a Place")
    place.check()


LONGEST_STEP = 0.75
"""Poses farther apart are not joined by a line (metres): the robot may have been put elsewhere."""


class Trail:
    """Where a robot has been: points of the last seconds, and cells of the whole time.

    Args:
        spacing: distance between points, and side of the cells: of the coarse grid (metres).
        kept: how long a point is kept (seconds).
    """

    def __init__(self, spacing: float, kept: float) -> None:
        self.spacing, self.kept = spacing, kept
        self.cells: set[tuple[int, int]] = set()
        """(row, column) of squares of the plane; (0, 0) begins at the origin."""
        self._points: deque[tuple[float, Place]] = deque()
        self._last: Place | None = None

    def add(self, place: Place, time: float) -> None:
        """Note where the robot is at a time (seconds)."""
        if not self._points or place.distance(self._points[-1][1]) >= self.spacing:
            self._points.append((time, place))
        self._points[-1] = (time, self._points[-1][1])
        before = self._last or place
        steps = math.ceil(place.distance(before) / (self.spacing / 2)) + 1
        if place.distance(before) > LONGEST_STEP:
            before, steps = place, 1
        for share in (step / steps for step in range(1, steps + 1)):
            x = before.x + share * (place.x - before.x)
            y = before.y + share * (place.y - before.y)
            self.cells.add((math.floor(y / self.spacing), math.floor(x / self.spacing)))
        self._last = place

    def points(self, time: float) -> list[Point]:
        """The points that are not too old at a time (seconds)."""
        while self._points and time - self._points[0][0] > self.kept:
            self._points.popleft()
        return [(place.x, place.y) for _, place in self._points]


class LivedTime:
    """Seconds that a robot has lived through: clocks may be set, and simulations may pause or jump.

    Args:
        longest: a longer step of the clock counts as this long (seconds).
    """

    def __init__(self, longest: float = 2.0) -> None:
        self.longest, self.seconds = longest, 0.0
        self._now: float | None = None

    def pass_to(self, now: float) -> float:
        """Lived time when the clock shows ``now`` (seconds)."""
        if self._now is not None:
            self.seconds += min(max(now - self._now, 0.0), self.longest)
        self._now = now
        return self.seconds

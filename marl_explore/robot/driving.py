"""Differential drive from cell to cell: turn to the next cell's centre, go straight, stop there."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from marl_explore.config.checks import require_not_negative, require_positive
from marl_explore.config.fields import check_types
from marl_explore.robot.geometry import wrapped
from marl_explore.robot.messages import Pose


class Velocity(NamedTuple):
    """The command to a differential drive."""

    forward: float
    """Metres per second."""
    turn: float
    """Radians per second, counter-clockwise."""


ZERO = Velocity(0.0, 0.0)
LARGEST = 5.0
"""Of a robot, and of the distances that it keeps (metres)."""
_POSITIVE = {
    "max_forward": ("metres per second", 10.0),
    "max_turn": ("radians per second", 100.0),
    "arrival": ("metres", LARGEST),
    "heading_tolerance": ("radians", math.pi),
    "forward_gain": ("1/s", 1000.0),
    "turn_gain": ("1/s", 1000.0),
    "radius": ("metres", LARGEST),
}
"""Units of settings that must be positive, and most of each."""


@dataclass(frozen=True)
class Drive:
    """Limits and gains; the defaults suit a TurtleBot3."""

    max_forward: float = 0.2
    """Metres per second."""
    max_turn: float = 2.0
    """Radians per second."""
    arrival: float = 0.03
    """Distance from a cell's centre at which a robot has arrived (metres)."""
    heading_tolerance: float = 0.35
    """Largest heading error at which it drives forward (radians)."""
    forward_gain: float = 1.5
    """Per second."""
    turn_gain: float = 3.0
    """Per second."""
    clearance: float = 0.33
    """The robot waits while another robot ahead is nearer than this (metres)."""
    radius: float = 0.105
    """Of the robot itself (metres): what must fit through. ``BeamModel.robot_radius`` is how far
    from a robot's pose its returns may be: its body and the errors of poses and ranges."""
    margin: float = 0.03
    """The robot stops before what its scan shows nearer than this to its body's way (metres)."""

    def __post_init__(self) -> None:
        """Check limits and gains."""
        check_types(self)
        for name, (unit, most) in _POSITIVE.items():
            require_positive(name, getattr(self, name), unit, most)
        for name in ("clearance", "margin"):
            require_not_negative(name, getattr(self, name), "metres", LARGEST)

    def arrived(self, pose: Pose, goal: tuple[float, float]) -> bool:
        """Whether a robot is at its goal, (x, y) in metres."""
        return math.hypot(goal[0] - pose.x, goal[1] - pose.y) < self.arrival

    def velocity(
        self, pose: Pose, goal: tuple[float, float], others: Iterable[Pose], blocked: bool = False
    ) -> Velocity:
        """Velocity towards a goal.

        Args:
            pose: of the robot.
            goal: (x, y) in metres.
            others: poses of the other robots; it does not drive towards one that is near.
            blocked: whether something else is in the way: it turns, but does not drive.
        """
        if self.arrived(pose, goal):
            return ZERO
        east, north = goal[0] - pose.x, goal[1] - pose.y
        error = wrapped(math.atan2(north, east) - pose.yaw)
        turn = max(-self.max_turn, min(self.max_turn, self.turn_gain * error))
        if blocked or abs(error) > self.heading_tolerance or self.ahead(pose, others):
            return Velocity(0.0, turn)
        distance = math.hypot(east, north)
        forward = min(self.forward_gain * distance, self.max_forward)
        return Velocity(forward * math.cos(error), turn)

    def ahead(self, pose: Pose, others: Iterable[Pose]) -> set[int]:
        """The robots ahead of a pose that are so near that it waits for them."""
        return {other.robot for other in others if self._is_ahead(pose, other)}

    def _is_ahead(self, pose: Pose, other: Pose) -> bool:
        east, north = other.x - pose.x, other.y - pose.y
        ahead = east * math.cos(pose.yaw) + north * math.sin(pose.yaw)
        return ahead > 0 and math.hypot(east, north) < self.clearance

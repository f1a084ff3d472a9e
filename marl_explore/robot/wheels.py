"""Whether a robot that drives gets anywhere; if not, whether something is in its way."""

from __future__ import annotations

import math

from marl_explore.robot.driving import ZERO, Velocity
from marl_explore.robot.geometry import wrapped
from marl_explore.robot.messages import Pose
from marl_explore.robot.status import Reason, Status

_STILL = 0.02
"""A pose that has changed by less has not moved (metres)."""
_TURNED = 0.1
"""The same of a heading (radians)."""
_LONGEST = 0.5
"""Time between two looks that counts at most: clocks can be set (seconds)."""


class Wheels:
    """Watches a robot while it drives.

    Args:
        patience: how long it may try without moving (seconds).
    """

    def __init__(self, patience: float) -> None:
        self.patience = patience
        self.blocked = False
        """Whether its scan shows something in its way."""
        self.stalls = 0
        """How often its wheels did not turn."""
        self.obstacles = 0
        """How often something was in its way until it gave up."""
        self._fault: Status | None = None
        self._tries = False
        self._tried, self._looked = 0.0, math.inf
        self._from: Pose | None = None

    def start(self, now: float) -> None:
        """Begin a way."""
        self._tried, self._looked, self._from, self._tries = 0.0, now, None, False

    def command(self, velocity: Velocity, blocked: bool) -> None:
        """Note the command to the wheels, and whether something is in the way."""
        self.blocked, self._tries = blocked, velocity != ZERO

    def give_up(self, pose: Pose, now: float) -> bool:
        """Whether the robot has been trying for too long without moving.

        Args:
            pose: the robot's latest.
            now: the time (seconds).
        """
        last = self._from
        moved = last is None or math.hypot(pose.x - last.x, pose.y - last.y) >= _STILL
        turned = last is None or abs(wrapped(pose.yaw - last.yaw)) >= _TURNED
        waits = not self._tries and not self.blocked  # for another robot, or for a new pose
        if moved or turned or waits:
            if last is not None and moved:
                self._fault = None
            self._tried, self._looked, self._from = 0.0, now, pose
            return False
        self._tried += min(max(now - self._looked, 0.0), _LONGEST)
        self._looked = now
        if self._tried <= self.patience:
            return False
        self._note(pose)
        self.start(now)
        return True

    def _note(self, pose: Pose) -> None:
        place = f"at ({pose.x:.2f}, {pose.y:.2f}) m"
        if self.blocked:
            self.obstacles += 1
            self._fault = Status(Reason.OBSTACLE, f"something stands in its way {place}")
        else:
            self.stalls += 1
            self._fault = Status(Reason.WHEELS, f"its wheels do not turn {place}")

    def status(self) -> Status | None:
        """The last fault, until the robot has moved again."""
        return self._fault

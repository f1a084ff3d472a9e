"""Whether a robot that drives gets anywhere; if not, whether something is in its way."""

from __future__ import annotations

import math

import numpy as np

from marl_explore.robot.driving import ZERO, Velocity
from marl_explore.robot.geometry import GridCell
from marl_explore.robot.mapper import Floats
from marl_explore.robot.messages import Pose
from marl_explore.robot.status import Reason, Status

_MOVED = 0.05
"""A robot that is farther from where it was has moved: poses are noisy (metres)."""
_TURNED = 0.2
"""The same of its heading (radians)."""
_SMOOTHING = 1.0
"""Over how long poses are averaged (seconds)."""
_LONGEST = 0.5
"""Time between two poses that counts at most: poses can be lost and clocks set (seconds)."""


class Wheels:
    """Watches a robot while it drives.

    Args:
        patience: how long it may try without moving (seconds).
    """

    def __init__(self, patience: float) -> None:
        self.patience = patience
        self.blocked = False
        """Whether its scan shows something in its way."""
        self.ahead: set[int] = set()
        """Robots ahead that it waits for."""
        self.stalls = 0
        """How often its wheels did not turn."""
        self.obstacles = 0
        """How often something was in its way until it gave up."""
        self.fault: Status | None = None
        """Why it last gave up a move, until it moves again or has nowhere to go."""
        self.rest()
        self.start()

    def start(self, is_return: bool = False) -> None:
        """Begin a way, or the way back after a move that was given up."""
        self._is_return = is_return
        self._tried = {True: 0.0, False: 0.0}
        """How long it has tried with something in the way, and with nothing (seconds)."""
        self._last: Pose | None = None
        self._place: Floats = np.zeros(4)
        self._from: Floats = self._place

    def rest(self) -> None:
        """Note that the robot stands still, for want of a new pose or scan or at its goal."""
        self.command(ZERO, False, set())

    def command(self, velocity: Velocity, blocked: bool, ahead: set[int]) -> None:
        """Note the command to the wheels, and what is in the way.

        Args:
            velocity: the command.
            blocked: whether the scan shows something in the way.
            ahead: robots ahead that it waits for.
        """
        self.blocked, self.ahead = blocked, ahead
        self._tries = blocked or (velocity != ZERO and not ahead)

    def forget(self) -> None:
        """End the fault: the robot has nowhere to go, or the way may be free again."""
        self.fault = None

    def give_up(self, pose: Pose, cell: GridCell) -> bool:
        """Whether the robot has been trying for too long without moving.

        Args:
            pose: the robot's latest.
            cell: to which it drives.
        """
        last = self._last
        if last is not None and pose.stamp == last.stamp:
            return False
        self._last = pose
        seconds = min(max(pose.stamp - last.stamp, 0.0), _LONGEST) if last else math.inf
        self._place = _averaged(self._place, pose, seconds)
        moved = self._has_moved()
        if moved and last and not self._is_return:
            self.fault = None
        if moved or last is None or not self._tries:
            self._tried, self._from = {True: 0.0, False: 0.0}, self._place
            return False
        self._tried[self.blocked] += seconds
        if self._tried[self.blocked] <= self.patience:
            return False
        self._note(pose, cell)
        self.start()
        return True

    def _has_moved(self) -> bool:
        east, north, *heading = self._place - self._from
        return math.hypot(east, north) >= _MOVED or math.hypot(*heading) >= _TURNED

    def _note(self, pose: Pose, cell: GridCell) -> None:
        if self.blocked:
            self.obstacles += 1
            self.fault = Status(Reason.OBSTACLE, f"something stands in its way to cell {cell}")
        else:
            self.stalls += 1
            place = f"at ({pose.x:.2f}, {pose.y:.2f}) m, on its way to cell {cell}"
            self.fault = Status(Reason.WHEELS, f"its wheels do not turn {place}")


def _averaged(place: Floats, pose: Pose, seconds: float) -> Floats:
    """Position and heading (x, y, cos, sin), averaged, after a pose so much later."""
    now = np.array([pose.x, pose.y, math.cos(pose.yaw), math.sin(pose.yaw)])
    return place + (now - place) * -math.expm1(-seconds / _SMOOTHING)

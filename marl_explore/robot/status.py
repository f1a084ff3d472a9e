"""Why a robot does what it does now, for people."""

from __future__ import annotations

from collections.abc import Iterable
from enum import Enum
from typing import NamedTuple


class Reason(str, Enum):
    """Kinds of a robot's status."""

    EXPLORING = "exploring"
    COMPLETE = "complete"
    WAITING = "waiting"
    """For other robots, or for the next scan."""
    NO_POSE = "no pose"
    NO_SCAN = "no scan"
    OUTSIDE = "outside the arena"
    OTHER_CLOCK = "stamps of another clock"
    OBSTACLE = "obstacle in the way"
    WHEELS = "wheels do not turn"
    JUMP = "pose jumped"


class Status(NamedTuple):
    """What a robot does, or why it stands still."""

    reason: Reason
    text: str
    """A sentence with numbers and names."""

    @property
    def is_fault(self) -> bool:
        """Whether somebody should look after the robot."""
        return self.reason not in (Reason.EXPLORING, Reason.COMPLETE, Reason.WAITING)


def named(robots: Iterable[int]) -> str:
    """Robots in a sentence: "robot 2", "robots 1 and 3"."""
    numbers = [str(robot) for robot in sorted(robots)]
    if len(numbers) == 1:
        return f"robot {numbers[0]}"
    return f"robots {', '.join(numbers[:-1])} and {numbers[-1]}"

"""What a robot's own scan shows in its way, whatever its map says."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from marl_explore.robot.driving import Drive
from marl_explore.robot.geometry import Disc
from marl_explore.robot.mapper import BeamModel, Floats, returns
from marl_explore.robot.messages import Pose, Scan

_FEWEST = 2
"""A single return may be noise."""


class Guard:
    """Remembers where the last scan had returns, less those of other robots.

    Args:
        drive: the robot's size.
        beams: which returns are robots.
    """

    def __init__(self, drive: Drive, beams: BeamModel) -> None:
        self.drive, self.beams = drive, beams
        self.scan: Scan | None = None
        """The last one that was taken."""
        self._points: Floats = np.empty((0, 2))

    def look(self, scan: Scan, pose: Pose, robots: Iterable[Disc]) -> None:
        """Take a scan.

        Args:
            scan: one turn of the lidar.
            pose: of the robot, when the scan was taken.
            robots: where the others were whose poses are known.
        """
        self.scan, self._points = scan, returns(scan, pose, robots, self.beams)

    def is_blocked(self, pose: Pose, goal: tuple[float, float]) -> bool:
        """Whether something is in the way from a robot's pose to its goal, (x, y) in metres."""
        way = np.subtract(goal, (pose.x, pose.y))
        length = float(np.hypot(*way))
        if not length:
            return False
        ahead = way / length
        apart = self._points - (pose.x, pose.y)
        along, across = apart @ ahead, apart @ (-ahead[1], ahead[0])
        wide = self.drive.radius + self.drive.margin
        near = (along > 0) & (along < length + wide) & (np.abs(across) < wide)
        return int(near.sum()) >= _FEWEST

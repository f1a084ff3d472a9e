"""The latest scan and the latest poses of all robots, with their ages."""

from __future__ import annotations

from collections import deque

from marl_explore.robot.geometry import Disc
from marl_explore.robot.messages import Pose, Scan

_KEPT = 512
"""Poses of a robot: scans may be a second late, and poses come up to 400 times a second."""


class FutureStampError(ValueError):
    """Data are stamped in the future: by another clock."""


class Sensors:
    """A robot's sensor data.

    Args:
        robot: number of the robot.
        max_pose_age: older poses, and data stamped further in the future, are invalid (seconds).
        max_scan_age: older scans are invalid (seconds).
    """

    def __init__(self, robot: int, max_pose_age: float, max_scan_age: float) -> None:
        self.robot = robot
        self.max_pose_age, self.max_scan_age = max_pose_age, max_scan_age
        self.scan: Scan | None = None
        self.arrived: dict[str, float] = {}
        """When the last own "pose" and "scan" came (seconds), however old they were."""
        self._poses: dict[int, deque[Pose]] = {}

    def add_scan(self, scan: Scan, now: float) -> None:
        """Add a scan; it is dropped if there is a later one.

        Raises:
            ValueError: for a stamp in the future (``now`` is in seconds), or non-finite numbers.
        """
        self._check(scan, now)
        self.arrived["scan"] = now
        if self.scan is None or scan.stamp >= self.scan.stamp or self._future(self.scan.stamp, now):
            self.scan = scan

    def add_pose(self, pose: Pose, now: float) -> None:
        """Add a robot's pose; it is dropped if there is a later one.

        Raises:
            ValueError: for a stamp in the future (``now`` is in seconds), or non-finite numbers.
        """
        self._check(pose, now)
        if pose.robot == self.robot:
            self.arrived["pose"] = now
        poses = self._poses.setdefault(pose.robot, deque(maxlen=_KEPT))
        while poses and self._future(poses[-1].stamp, now):  # the clock was set back
            poses.pop()
        if not poses or pose.stamp >= poses[-1].stamp:
            poses.append(pose)

    def _future(self, stamp: float, now: float) -> bool:
        return stamp > now + self.max_pose_age

    def _check(self, event: Scan | Pose, now: float) -> None:
        event.check()
        if self._future(event.stamp, now):
            raise FutureStampError(
                f"stamp={event.stamp!r} is not allowed: it is {now:.6g} s, and clocks may "
                f"differ by {self.max_pose_age:g} s"
            )

    @property
    def pose(self) -> Pose | None:
        """The robot's own latest pose."""
        return self.last(self.robot)

    def last(self, robot: int) -> Pose | None:
        """A robot's latest pose, however old."""
        poses = self._poses.get(robot)
        return poses[-1] if poses else None

    def fresh(self, now: float) -> bool:
        """Whether the robot's pose and scan are recent enough to drive."""
        pose, scan = self.pose, self.scan
        return (
            pose is not None
            and scan is not None
            and abs(now - pose.stamp) <= self.max_pose_age
            and abs(now - scan.stamp) <= self.max_scan_age
        )

    def at(self, stamp: float) -> dict[int, Pose]:
        """The poses nearest to a time; robots without a pose that is near enough are left out."""
        return {
            pose.robot: pose
            for pose in self._nearest(stamp)
            if abs(pose.stamp - stamp) <= self.max_pose_age
        }

    def astray(self, stamp: float, speed: float, patience: float, reach: float) -> list[Disc]:
        """Where the other robots may be at a time at which their poses are not known.

        Args:
            stamp: the time (seconds).
            speed: of a robot, at most (metres per second).
            patience: robots that have not been heard for longer are left out (seconds).
            reach: how far a robot can have driven at most (metres).
        """
        ages = {pose: abs(pose.stamp - stamp) for pose in self._nearest(stamp)}
        return [
            Disc(pose.x, pose.y, min(speed * age, reach))
            for pose, age in ages.items()
            if pose.robot != self.robot and 0 < age <= patience
        ]

    def _nearest(self, stamp: float) -> list[Pose]:
        """The pose of every robot that is nearest to a time."""
        return [
            min(poses, key=lambda pose: abs(pose.stamp - stamp)) for poses in self._poses.values()
        ]

    def others(self) -> list[Pose]:
        """The latest poses of the other robots, however old."""
        return [poses[-1] for robot, poses in self._poses.items() if robot != self.robot]

    def heard(self, now: float, patience: float) -> list[Pose]:
        """The latest poses of the other robots that are at most so old.

        Args:
            now: the time (seconds).
            patience: the largest age (seconds).
        """
        return [pose for pose in self.others() if abs(now - pose.stamp) <= patience]

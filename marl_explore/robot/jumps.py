"""Poses that jump: whether what the robot sees afterwards still fits its map."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

from marl_explore.config.checks import require_integer, require_positive, require_share
from marl_explore.config.fields import check_types
from marl_explore.robot.driving import Drive
from marl_explore.robot.geometry import wrapped
from marl_explore.robot.merging import Fit
from marl_explore.robot.messages import Pose

_KEPT = 32
_MOST = 1000.0
"""Larger limits would notice no jump (metres, radians)."""


@dataclass(frozen=True)
class JumpLimits:
    """Which poses jump, and which scans are written into the map afterwards."""

    distance: float = 0.25
    """How much farther than its wheels can take it a robot's pose may move (metres)."""
    turn: float = 0.5
    """How much farther than its wheels can turn it a robot's pose may turn (radians)."""
    share: float = 0.2
    """Of the known cells in sight: if more contradict the map, the scan is not written."""
    patience: int = 20
    """Ticks after which the map counts as outdated, and scans are written again."""

    def __post_init__(self) -> None:
        """Check the limits."""
        check_types(self)
        require_positive("distance", self.distance, "metres", _MOST)
        require_positive("turn", self.turn, "radians", _MOST)
        require_share("share", self.share)
        require_integer("patience", self.patience, 0)


class Jump(NamedTuple):
    """Two poses in a row that wheels cannot explain."""

    stamp: float
    """Of the later one (seconds)."""
    distance: float
    """Between them (metres)."""
    turn: float
    """Between them (radians)."""


class JumpReport(NamedTuple):
    """A scan after a jump, in comparison with the map."""

    tick: int
    jump: Jump
    fit: Fit
    written: bool
    """Whether it was written into the map."""

    def __str__(self) -> str:
        (_, distance, turn), (wrong, common) = self.jump, self.fit
        return (
            f"the pose jumped by {distance:.2f} m and {math.degrees(turn):.0f} degrees; at tick "
            f"{self.tick} the scan contradicts {wrong} of {common} known cells and is "
            f"{'' if self.written else 'not '}written into the map"
        )


class JumpGuard:
    """Keeps scans out of the map while they contradict it after a jump of the robot's pose.

    Args:
        limits: of jumps, and of contradictions.
        drive: what the wheels can do.
    """

    def __init__(self, limits: JumpLimits, drive: Drive) -> None:
        self.limits, self.drive = limits, drive
        self.jumps = 0
        """How often the pose jumped."""
        self.reports: deque[JumpReport] = deque(maxlen=_KEPT)
        """The first scan after a jump, and the one that is written again if that was not."""
        self._last: Pose | None = None
        self._jump: Jump | None = None
        self._since: int | None = None

    @property
    def is_checking(self) -> bool:
        """Whether a scan contradicted the map after a jump, and none has been written since."""
        return self._jump is not None and self._since is not None

    def add(self, pose: Pose) -> None:
        """Take the robot's latest pose."""
        last, self._last = self._last, pose
        if last is None:
            return
        if self._jump is not None:  # clocks can be set back
            self._jump = self._jump._replace(stamp=min(self._jump.stamp, pose.stamp))
        seconds = max(pose.stamp - last.stamp, 0.0)
        distance = math.hypot(pose.x - last.x, pose.y - last.y)
        turn = abs(wrapped(pose.yaw - last.yaw))
        too_far = distance > self.limits.distance + self.drive.max_forward * seconds
        if too_far or turn > self.limits.turn + self.drive.max_turn * seconds:
            self.jumps += 1
            self._jump, self._since = Jump(pose.stamp, distance, turn), None

    def admits(self, pose: Pose, fit: Fit, tick: int) -> bool:
        """Whether to write a scan into the map.

        Args:
            pose: with which the scan is read; before the jump it is as good as ever.
            fit: of the scan and the map.
            tick: of the scan.
        """
        jump = self._jump
        if jump is None or pose.stamp < jump.stamp:
            return True
        first = self._since is None
        since = self._since = tick if self._since is None else self._since
        outdated = tick - since >= self.limits.patience
        written = fit.contradictions <= self.limits.share * fit.common or outdated
        if first or written:
            self.reports.append(JumpReport(tick, jump, fit, written))
        if written:
            self._jump = None
        return written

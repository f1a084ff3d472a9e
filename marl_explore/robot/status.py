"""Why a robot does what it does now, for people."""

from __future__ import annotations

from collections.abc import Iterable
from enum import Enum
from typing import TYPE_CHECKING, Literal, NamedTuple

from marl_explore.robot.sensors import FutureStampError

if TYPE_CHECKING:
    from marl_explore.robot.runtime import RobotCore


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


def status_of(core: RobotCore, now: float) -> Status:
    """What a robot does at a time (seconds), or why it stands still."""
    fault = _of_pose(core, now) or _of_scan(core, now)
    if fault:
        return fault
    if core.jumps.is_checking:
        return Status(Reason.JUMP, str(core.jumps.reports[-1]))
    if core.obstructed:
        return Status(Reason.OBSTACLE, f"something stands in its way to cell {core.obstructed}")
    if core.wheels.fault:
        return core.wheels.fault
    if core.wheels.ahead:
        return Status(Reason.WAITING, f"waiting for {named(core.wheels.ahead)} ahead")
    if missing := core.waited_for:
        return Status(Reason.WAITING, f"waiting for {named(missing)}")
    if core.refusal:
        return Status(Reason.WAITING, core.refusal)
    if core.is_complete:
        return Status(Reason.COMPLETE, "no frontier can be reached: the map is complete")
    if core.is_sensing:
        return Status(Reason.WAITING, f"waiting for a scan of tick {core.tick}")
    begins = core.clock.begins(core.tick + 1) if core.is_between_ticks else None
    if begins is not None:
        when = f"which begins in {begins - now:.1f} s"
        return Status(Reason.WAITING, f"waiting for tick {core.tick + 1}, {when}")
    return Status(Reason.EXPLORING, f"exploring, tick {core.tick}")


def of_refusal(what: Literal["pose", "scan"], error: ValueError) -> Status:
    """What the refusal of a robot's own pose or scan says about it."""
    if isinstance(error, FutureStampError):
        return Status(Reason.OTHER_CLOCK, f"stamps of another clock: its {what}'s {error}")
    reason = Reason.NO_POSE if what == "pose" else Reason.NO_SCAN
    return Status(reason, f"its {what} was refused: {error}")


def _of_pose(core: RobotCore, now: float) -> Status | None:
    pose = core.sensors.pose
    fault = _of_age(core, now, "pose", pose.stamp if pose else None)
    if fault or pose is None:
        return fault
    if not core.frame.inside(core.frame.cell(pose.x, pose.y)):
        where = f"({pose.x:.2f}, {pose.y:.2f}) m"
        return Status(Reason.OUTSIDE, f"its pose {where} is outside the arena")
    return None


def _of_scan(core: RobotCore, now: float) -> Status | None:
    scan = core.sensors.scan
    return _of_age(core, now, "scan", scan.stamp if scan else None)


def _of_age(
    core: RobotCore, now: float, what: Literal["pose", "scan"], stamp: float | None
) -> Status | None:
    """Why there is no pose or scan of which the stamp is near enough; None if there is one."""
    reason, limit = Reason.NO_POSE, core.settings.max_pose_age
    if what == "scan":
        reason, limit = Reason.NO_SCAN, core.settings.max_scan_age
    if core.refused_data:
        when, why = core.refused_data
        just_now = abs(now - when) <= core.settings.max_pose_age  # clocks can be set back
        fails = stamp is None or abs(now - stamp) > limit
        if just_now and (why.reason is Reason.OTHER_CLOCK or (fails and why.reason is reason)):
            return why
    if stamp is None:
        return Status(reason, f"no {what} has arrived yet")
    age = now - stamp
    if abs(age) <= limit:
        return None
    if age < 0:
        return Status(Reason.OTHER_CLOCK, f"its {what} is stamped {-age:.1f} s ahead of its clock")
    arrived = core.sensors.arrived.get(what, stamp)
    if abs(now - arrived) <= limit:
        late = f"its {what} arrives with a stamp {age:.1f} s old, over {limit:g} s"
        return Status(Reason.OTHER_CLOCK, f"stamps of another clock, or a slow network: {late}")
    return Status(reason, f"its {what} is {age:.1f} s old, over {limit:g} s")

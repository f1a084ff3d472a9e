"""A robot of the team, without a transport and without torch; it needs only numpy.

``RobotCore`` takes stamped scans, poses and messages, and returns velocities and messages; a node
around it (ROS 2, a simulator) passes them on. docs/robots.md has frames, units and messages.
"""

from __future__ import annotations

from marl_explore.robot.clock import BarrierClock, PeriodClock
from marl_explore.robot.messages import Envelope, Pose, Scan, decode
from marl_explore.robot.observation import Observation
from marl_explore.robot.policy import ExportedPolicy
from marl_explore.robot.runtime import RobotCore
from marl_explore.robot.settings import RobotSettings

__all__ = [
    "BarrierClock",
    "Envelope",
    "ExportedPolicy",
    "Observation",
    "PeriodClock",
    "Pose",
    "RobotCore",
    "RobotSettings",
    "Scan",
    "decode",
]

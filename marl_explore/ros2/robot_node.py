"""One robot of the team as a ROS 2 node: ``ros2 run marl_explore_ros2 robot_node``.

With ``--dry-run`` it senses, decides and sends messages, but no velocity.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.clock import Clock, ClockType
from rclpy.qos import qos_profile_sensor_data
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import LaserScan
from std_msgs.msg import UInt8MultiArray

from marl_explore.robot import Pose, Scan
from marl_explore.robot.driving import ZERO, Velocity
from marl_explore.robot.status import Reason, Status
from marl_explore.ros2 import convert
from marl_explore.ros2.names import team_root
from marl_explore.ros2.node import LATEST, LETTERS, ParameterNode, diagnostics, run, time_of
from marl_explore.ros2.parameters import RobotParameters
from marl_explore.ros2.pose_sources import LidarTransforms, listen_to_tf
from marl_explore.ros2.status_log import StatusLog


class RobotNode(ParameterNode[RobotParameters]):
    """Passes scans, poses and messages to ``RobotCore``, and publishes its outputs.

    Args:
        dry_run: whether to send no velocities.
    """

    def __init__(self, dry_run: bool = False) -> None:
        super().__init__("robot_node", RobotParameters())
        self.core = self.given.make_core()
        self._published = 0
        self._told: Reason | None = None
        self._log = StatusLog()
        self._warned: set[object] = set()
        self._dropped = 0
        self._lidar: LidarTransforms | None = None
        if self.given.lidar_from_tf:
            buffer, missing = listen_to_tf(self, "lidar_from_tf=True")
            self._lidar = LidarTransforms(buffer, self.given.base_frame, missing)
        name = self.given.team[self.given.robot]
        root = team_root(self.get_namespace(), name)
        team, own = [f"{root}{name}" for name in self.given.team], f"{root}{name}"
        for robot, mate in enumerate(team):
            take = partial(self._take_pose, robot)
            self.create_subscription(PoseStamped, f"{mate}/pose", take, qos_profile_sensor_data)
        self.create_subscription(LaserScan, f"{own}/scan", self._take_scan, qos_profile_sensor_data)
        self.create_subscription(UInt8MultiArray, f"{own}/inbox", self._take_letter, LETTERS)
        self._inboxes = {
            robot: self.create_publisher(UInt8MultiArray, f"{mate}/inbox", LETTERS)
            for robot, mate in enumerate(team)
            if robot != self.given.robot
        }
        self._maps = self.create_publisher(OccupancyGrid, f"{own}/map", LATEST)
        self._statuses = self.create_publisher(DiagnosticArray, f"{own}/status", LATEST)
        kind = TwistStamped if self.given.stamped else Twist
        self._velocities = None if dry_run else self.create_publisher(kind, f"{own}/cmd_vel", 1)
        self.create_timer(1 / self.given.rate, self._advance)
        # also while simulated time stands still
        self.create_timer(1.0, self._send_status, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def stop(self) -> None:
        """Stop the robot."""
        self._send_velocity(ZERO, time_of(self))

    def _take_scan(self, message: Any) -> None:
        with self._dropping("a scan"):
            read = self._lidar.scan if self._lidar else convert.to_scan
            self._take_measured(read(message))

    def _take_pose(self, robot: int, message: Any) -> None:
        with self._dropping(f"a pose of robot {robot}"):
            convert.require_frame(message, self.given.frame)
            self._take_measured(convert.to_pose(message, robot))

    def _take_measured(self, event: Scan | Pose) -> None:
        now = time_of(self)
        if now:  # otherwise simulated time has not begun: the age is unknown
            self.core.receive(event, now)

    @contextmanager
    def _dropping(self, what: str, every: float = 5.0) -> Iterator[None]:
        """Log what cannot be used, at most once in so many seconds, and go on without it."""
        try:
            yield
        except ValueError as error:
            self._dropped += 1
            self.get_logger().error(f"dropped {what}: {error}", throttle_duration_sec=every)

    def _take_letter(self, message: Any) -> None:
        with self._dropping("a message", every=0.0):
            self.core.receive(convert.to_letter(message, self.given.robot), time_of(self))

    def _advance(self) -> None:
        now = time_of(self)
        if not now:  # simulated time has not begun
            return
        output = self.core.advance(now)
        for envelope in output.messages:
            letter = convert.fill(UInt8MultiArray(), convert.letter_fields(envelope))
            for receiver in envelope.to:
                self._inboxes[receiver].publish(letter)
        self._send_map(now)
        self._send_velocity(output.velocity, now)
        self._tell(now)
        self._warn()

    def _send_map(self, now: float) -> None:
        if self.core.knowledge.changes == self._published:
            return
        self._published = self.core.knowledge.changes
        fields = convert.grid_fields(
            self.core.knowledge.map, self.core.frame, now, self.given.frame
        )
        self._maps.publish(convert.fill(OccupancyGrid(), fields))

    def _tell(self, now: float) -> None:
        """Publish a status of another kind, and log what ``StatusLog`` chooses."""
        status = self.core.status
        level = self._log.level(status, now)
        if level == "warning":
            self.get_logger().warning(status.text)
        elif level:
            self.get_logger().info(status.text)
        if status.reason is not self._told:
            self._told = status.reason
            self._send_status()

    def _warn(self) -> None:
        """Log maps of others that were refused, and scans held against the map after a jump."""
        said: set[object] = {*self.core.knowledge.refusals, *self.core.jumps.reports}
        for report in said - self._warned:
            self.get_logger().warning(str(report))
        self._warned = said

    def _send_status(self) -> None:
        core, name, status = self.core, self.given.team[self.given.robot], self.core.status
        if not time_of(self):
            status = Status(Reason.WAITING, "waiting for simulated time on /clock")
            if status.reason is not self._told:
                self.get_logger().info(status.text)
                self._told = status.reason
        details = {
            **core.counts,
            "messages dropped": self._dropped,
            "last map refused": next(reversed(core.knowledge.refusals), "-"),
        }
        fields = convert.status_fields(status, name, details)
        self._statuses.publish(diagnostics(fields, time_of(self)))

    def _send_velocity(self, velocity: Velocity, now: float) -> None:
        if self._velocities is None:
            return
        if self.given.stamped:
            fields = convert.stamped_velocity_fields(velocity, now, self.given.base_frame)
            self._velocities.publish(convert.fill(TwistStamped(), fields))
        else:
            self._velocities.publish(convert.fill(Twist(), convert.velocity_fields(velocity)))


def main(args: list[str] | None = None) -> None:
    """Run the node until it is stopped."""
    words = sys.argv if args is None else args
    parser = argparse.ArgumentParser(prog="robot_node", description="One robot of the team.")
    parser.add_argument("--dry-run", action="store_true", help="send no velocity")
    given = parser.parse_args(remove_ros_args(words)[1:])
    run(lambda: RobotNode(given.dry_run), words, RobotNode.stop)


if __name__ == "__main__":
    main()

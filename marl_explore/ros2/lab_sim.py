"""The simulated lab as a ROS 2 node, which replaces robots, motion capture and clock.

``ros2 run marl_explore_ros2 lab_sim``; it needs the extra "lab", which includes torch.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.clock import Clock as SystemClock
from rclpy.clock import ClockType
from rclpy.qos import qos_profile_sensor_data
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import LaserScan
from std_msgs.msg import UInt32

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.checks import require_integer, require_positive
from marl_explore.envs.exploration import ExplorationEnv
from marl_explore.evaluation.episodes import TEST_STREAM
from marl_explore.lab import LabWorld, Noise
from marl_explore.robot import Pose, Scan
from marl_explore.robot.driving import ZERO, Velocity
from marl_explore.robot.geometry import Frame
from marl_explore.ros2 import convert
from marl_explore.ros2.names import frame_id, require_team
from marl_explore.ros2.node import LATEST, ParameterNode, run
from marl_explore.ros2.parameters import four_robots


@dataclass(frozen=True)
class LabParameters:
    """Parameters of ``lab_sim``."""

    team: list[str] = field(default_factory=four_robots)
    """Namespaces of all robots, in the order of their numbers."""
    frame: str = "arena"
    """Frame of poses and maps."""
    stamped: bool = False
    """Whether velocities are TwistStamped instead of Twist."""
    arena: ArenaConfig = field(default_factory=ArenaConfig)
    number: int = 0
    """Index of the test arena."""
    seed: int = 0
    """Seed of arenas, noise and initial headings."""
    noise: Noise = field(default_factory=Noise)
    speed: float = 1.0
    """Maximum number of simulated seconds per second."""
    scan_period: float = 0.2
    """Time between two turns of a lidar (seconds)."""
    watchdog: float = 0.5
    """A robot stands still if its last command is older than this (seconds)."""
    patience: float = 2.0
    """How long simulated time waits for a robot that has not answered (wall-clock seconds)."""

    def __post_init__(self) -> None:
        """Check the parameters."""
        for name in ("speed", "scan_period", "watchdog", "patience"):
            require_positive(name, getattr(self, name), "seconds")
        for name in ("number", "seed"):
            require_integer(name, getattr(self, name), 0)
        object.__setattr__(self, "frame", frame_id("frame", self.frame))
        require_team(self.team)
        if len(self.team) != self.arena.num_agents:
            raise ValueError(
                f"team={self.team!r} is not allowed: the arena has {self.arena.num_agents} robots"
            )


class LabNode(ParameterNode[LabParameters]):
    """Steps the lab: publishes scans, poses and the clock, and receives velocities.

    Simulated time stands still until every robot that is alive has answered the last step.
    """

    def __init__(self) -> None:
        super().__init__("lab_sim", LabParameters())
        given = self.given
        self.world = self._make_world()
        self._velocities = [(ZERO, 0.0)] * len(given.team)
        self._heard: dict[int, float] = {}
        self._answered: set[int] = set()
        self._next_scan = 0.0
        kind = TwistStamped if given.stamped else Twist
        for robot, name in enumerate(given.team):
            take = partial(self._take_velocity, robot)
            self.create_subscription(kind, f"/{name}/cmd_vel", take, 1)
        self._time = self.create_publisher(Clock, "/clock", 1)
        self._poses = [
            self.create_publisher(PoseStamped, f"/{name}/pose", qos_profile_sensor_data)
            for name in given.team
        ]
        self._scans = [
            self.create_publisher(LaserScan, f"/{name}/scan", qos_profile_sensor_data)
            for name in given.team
        ]
        self._contacts = self.create_publisher(UInt32, "~/contacts", LATEST)
        self._send_truth()
        wall = SystemClock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(self.world.step_seconds / given.speed, self._step, clock=wall)

    def _make_world(self) -> LabWorld:
        given = self.given
        env = ExplorationEnv(
            given.arena, 1, seed=given.seed, first_arena=given.number, stream=TEST_STREAM
        )
        start = env.reset()
        arenas = start["obstacles"], start["agents", "position"]
        return LabWorld(given.arena, arenas, given.noise, given.seed)

    def _send_truth(self) -> None:
        """Publish the true arena, for comparison."""
        self._truth = self.create_publisher(OccupancyGrid, "~/map", LATEST)
        obstacles = self.world.obstacles[0].numpy().astype(np.int8)
        fields = convert.grid_fields(obstacles, Frame.of(self.given.arena), 0.0, self.given.frame)
        self._truth.publish(convert.fill(OccupancyGrid(), fields))

    def _take_velocity(self, robot: int, message: Any) -> None:
        self._velocities[robot] = convert.to_velocity(message), self.world.now
        self._heard[robot] = time.monotonic()
        self._answered.add(robot)

    def _step(self) -> None:
        oldest = time.monotonic() - self.given.patience
        if {robot for robot, heard in self._heard.items() if heard > oldest} - self._answered:
            return
        self._answered.clear()
        self.world.drive(torch.tensor([[self._velocity(*last) for last in self._velocities]]))
        self._send_poses()
        if self.world.now >= self._next_scan:
            self._next_scan += self.given.scan_period
            self._send_scans()
        self._contacts.publish(UInt32(data=self.world.contacts.total()))
        self._time.publish(Clock(clock=self._stamp()))

    def _velocity(self, velocity: Velocity, told: float) -> Velocity:
        """A robot's actual velocity: zero if the command is too old."""
        return velocity if self.world.now - told <= self.given.watchdog else ZERO

    def _stamp(self) -> Any:
        return convert.fill(Clock().clock, convert.time_fields(self.world.now))

    def _send_poses(self) -> None:
        for robot, row in enumerate(self.world.measured_poses()[0].tolist()):
            fields = convert.pose_fields(Pose(self.world.now, robot, *row), self.given.frame)
            self._poses[robot].publish(convert.fill(PoseStamped(), fields))

    def _send_scans(self) -> None:
        for robot, ranges in enumerate(self.world.measured_ranges()[0]):
            fields = convert.scan_fields(
                Scan(self.world.now, ranges), f"{self.given.team[robot]}/base_scan"
            )
            self._scans[robot].publish(convert.fill(LaserScan(), fields))


def main(args: list[str] | None = None) -> None:
    """Run the node until it is stopped."""
    run(LabNode, args, lambda node: None)


if __name__ == "__main__":
    main()

"""A robot's node that asks tf where its lidar is, with a buffer in place of tf2's."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from contextlib import contextmanager

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import TransformStamped
from sensor_msgs.msg import LaserScan

from marl_explore.robot import Pose, Scan
from marl_explore.robot.geometry import Frame, Mount
from marl_explore.robot.mapper import sight
from marl_explore.ros2 import convert, robot_node
from marl_explore.ros2.pose_sources import LidarTransforms
from tests.extras.ros2.conftest import ROOT
from tests.helpers.robot_world import scan_of

WORDS = ["-p", "policy:=nearest-timer", "-p", "team:=[a]", "-p", "lidar_from_tf:=true"]


class Transforms:
    """As ``tf2_ros.Buffer``: (x, y, roll, pitch, yaw) of lidars in the robot's frame, by name."""

    def __init__(self, **mounts):
        self.mounts, self.asked = mounts, []

    def lookup_transform(self, target, source, when):
        self.asked.append((target, source, when.nanoseconds))
        if source not in self.mounts:
            raise LookupError("no transform")
        x, y, roll, pitch, yaw = self.mounts[source]
        found = TransformStamped().transform
        found.translation.x, found.translation.y = x, y
        (cr, sr), (cp, sp), (cy, sy) = (
            (math.cos(angle / 2), math.sin(angle / 2)) for angle in (roll, pitch, yaw)
        )
        found.rotation.w = cr * cp * cy + sr * sp * sy
        found.rotation.x = sr * cp * cy - cr * sp * sy
        found.rotation.y = cr * sp * cy + sr * cp * sy
        found.rotation.z = cr * cp * sy - sr * sp * cy
        return TransformStamped(transform=found)


def message_of(scan, frame):
    return convert.fill(LaserScan(), convert.scan_fields(scan, frame))


OBSTACLES = np.zeros((3, 3), bool)
OBSTACLES[0, 1] = OBSTACLES[1, 2] = True
FRAME, POSE = Frame(3, 3, 0.5), Pose(1.0, 0, 0.02, -0.03, 0.4)


@pytest.mark.parametrize("roll", [0.0, math.pi])
@pytest.mark.parametrize("mount", [Mount(0.1, -0.05, 2.0), Mount(-0.03, 0.0, 0.0)])
def test_a_robot_sees_the_same_with_any_lidar_also_upside_down(roll, mount):
    scan = scan_of(OBSTACLES, FRAME, POSE, mount=mount)
    if roll:  # its beams are read the other way round
        scan = Scan(1.0, np.roll(scan.ranges[::-1], 1))
    buffer = Transforms(laser=(mount.x, mount.y, roll, 0.0, mount.yaw))
    read = LidarTransforms(buffer, "base_link", LookupError).scan(message_of(scan, "/laser"))
    assert buffer.asked == [("base_link", "laser", 0)]
    seen = sight(read, POSE, [], FRAME, 1)
    expected = sight(scan_of(OBSTACLES, FRAME, POSE), POSE, [], FRAME, 1)
    assert np.array_equal(seen, expected)
    assert np.array_equal(seen == 1, OBSTACLES)


@contextmanager
def robot(monkeypatch, buffer):
    asked = []

    def listen(node, wanted):
        asked.append(wanted)
        return buffer, LookupError

    monkeypatch.setattr(robot_node, "listen_to_tf", listen)
    rclpy.init(args=["--ros-args", *WORDS])
    try:
        node = robot_node.RobotNode(dry_run=True)
        assert asked == ["lidar_from_tf=True"]  # not only when there is a scan
        yield node
        node.destroy_node()
    finally:
        rclpy.shutdown()


def test_a_node_reads_every_scan_where_tf_has_its_lidar(monkeypatch):
    level = {"front": (0.1, 0.0, 0.0, 0.0, 0.0), "back": (-0.2, 0.0, 0.0, 0.0, 3.0)}
    tilted = {"tilted": (0.0, 0.0, 0.0, 0.5, 0.0)}
    with robot(monkeypatch, Transforms(**level, **tilted)) as node:
        now = robot_node.time_of(node)
        scan = Scan(now, np.full(360, 1.0))
        for turn, (frame, (x, *_, yaw)) in enumerate(level.items()):
            node._take_scan(message_of(Scan(now + turn / 100, scan.ranges), frame))
            assert node.core.sensors.scan.mount == pytest.approx((x, 0.0, yaw), abs=1e-6)
        taken = node.core.sensors.scan
        for frame in ("nowhere", "tilted", ""):
            node._take_scan(message_of(Scan(now + 0.1, scan.ranges), frame))
        assert node.core.sensors.scan is taken
        assert node._dropped == 3


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (WORDS, "error: lidar_from_tf=True is not allowed: No module named 'tf2_ros'"),
        (["-p", "team:=[/a, /b]"], "error: team=['/a', '/b'] is not allowed: '/a' is no namespace"),
        (["-p", "team:=['a b', c]"], "error: team=['a b', 'c'] is not allowed: 'a b' is no names"),
        (["-p", "team:=[1, 2]"], "error: team="),
        (
            ["-p", "robot:=-1"],
            "error: robot=-1 is not allowed: it must be an integer of at least 0",
        ),
    ],
)
def test_what_cannot_work_is_refused_in_a_line(tmp_path, words, said):
    for name in ("torch", "tf2_ros"):
        (tmp_path / f"{name}.py").write_text(f"raise ImportError(\"No module named '{name}'\")\n")
    done = subprocess.run(
        [sys.executable, "-m", "marl_explore.ros2.robot_node", "--ros-args", *words],
        env={**os.environ, "PYTHONPATH": f"{tmp_path}:{ROOT}"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1
    assert said in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr

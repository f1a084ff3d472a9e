"""Robots and the lab as processes that hear each other over DDS on loopback."""

from __future__ import annotations

import array
import subprocess
import time
from contextlib import contextmanager

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import LaserScan
from std_msgs.msg import UInt8MultiArray

from marl_explore.robot import Envelope, Pose, Scan
from marl_explore.robot.driving import Velocity
from marl_explore.robot.geometry import Frame
from marl_explore.robot.messages import Done, Intent
from marl_explore.ros2 import convert
from marl_explore.ros2.node import LATEST, LETTERS, ParameterNode, run
from marl_explore.ros2.parameters import RobotParameters
from marl_explore.ros2.robot_node import RobotNode
from tests.extras.ros2.team import Team, Watcher
from tests.helpers.policy_file import policy_file

TICKS = 10
BUNDLED = ("paper-cnn-case1", "best")
"""Of the bundled policies of one size of team one that communicates often, and that of any."""
FAST = {"speed": 20.0}
"""As fast as the robots answer."""


@pytest.fixture
def policy(tmp_path):
    """A policy whose robots communicate often, with drawn weights."""
    return policy_file(tmp_path, talkative=1.5)


@pytest.fixture(params=BUNDLED)
def bundled(request, tmp_path):
    from marl_explore import load_policy
    from marl_explore.policies.export import export_npz

    return export_npz(load_policy(request.param), tmp_path / "bundled.npz")


@contextmanager
def running(workspace, policy, folder, lab=None, robots=None, **options):
    given = {"lab_sim": FAST | (lab or {}), "robot_node": robots or {}}
    rclpy.init()
    try:
        with Team(workspace, {"policy": str(policy)}, given, folder, **options) as team:
            yield team, Watcher(team)
    finally:
        rclpy.shutdown()


def test_four_robots_explore_the_lab_by_a_bundled_policy(workspace, bundled, tmp_path):
    with running(workspace, bundled, tmp_path) as (team, watcher):
        watcher.until(lambda: min(watcher.ticks.values()) >= TICKS and watcher.has_news)
        explored_and_merged(watcher)
    assert set(team.codes.values()) == {0}, team.said()


def test_four_robots_explore_by_the_time_of_day(workspace, policy, tmp_path):
    with running(workspace, policy, tmp_path, robots={"period": 8.0}) as (team, watcher):
        watcher.until(lambda: min(watcher.heard.values()) >= 5 and watcher.has_news)
        explored_and_merged(watcher)
        assert set(watcher.ticks.values()) == {-1}  # nobody said Done
    assert set(team.codes.values()) == {0}, team.said()


def explored_and_merged(watcher):
    """All maps shared so far are merged, none is wrong, and nobody has touched anything."""
    shared = list(watcher.shares)
    watcher.until(lambda: all(watcher.merged(envelope) for envelope in shared))
    watcher.until(lambda: watcher.truth is not None)
    assert watcher.contacts == watcher.broken == watcher.wrong_cells() == 0
    assert sum(int((grid >= 0).sum()) for grid in watcher.maps.values()) > 4 * 9


def test_a_robot_that_dies_stops_nobody_and_a_late_one_joins(workspace, policy, tmp_path):
    patient = {"patience": 20.0}
    with running(workspace, policy, tmp_path, robots=patient) as (team, watcher):
        watcher.until(lambda: min(watcher.ticks.values()) >= 2)
        team.kill("robot_3")
        died = watcher.ticks[3]
        watcher.until(lambda: min(watcher.ticks[robot] for robot in range(3)) >= died + 4)
        assert watcher.ticks[3] <= died + 1  # of what it had sent before
        team.start("robot_3")
        watcher.until(lambda: watcher.ticks[3] > died + 4)
        joined = watcher.ticks[3]
        watcher.until(lambda: min(watcher.ticks.values()) >= joined + 2)
        assert watcher.contacts == 0
        assert watcher.wrong_cells() == 0


def test_a_dry_run_sends_no_velocity_and_broken_letters_are_dropped(workspace, tmp_path):
    policy = policy_file(tmp_path)
    stamped = {"stamped": "true"}
    options = {"words": {"robot_0": ["--dry-run"]}, "names": ["lab", "robot_0", "robot_1"]}
    robots = stamped | {"patience": 3.0, "settings.move_expiry": 5.0}
    with running(workspace, policy, tmp_path, stamped, robots, **options) as (_, watcher):
        letters = watcher.create_publisher(UInt8MultiArray, "/robot_1/inbox", LETTERS)
        for data in (b"", b"\x01\x09", b"\x00" + Done(200, 9).encode()):
            letters.publish(UInt8MultiArray(data=array.array("B", data)))
        watcher.until(lambda: watcher.ticks[0] >= 1 and watcher.ticks[1] >= 3)
        watcher.until(lambda: watcher.maps.keys() >= {0, 1})
        assert watcher.count_publishers("/robot_0/cmd_vel") == 0
        (info,) = watcher.get_publishers_info_by_topic("/robot_1/cmd_vel")
        assert info.topic_type == "geometry_msgs/msg/TwistStamped"
        watcher.until(lambda: travelled(watcher.poses[1]) > 0.3)
        assert travelled(watcher.poses[0]) < 0.1  # noise alone
    said = (tmp_path / "robot_1.log").read_text()
    assert said.count("dropped a message") == 3


@pytest.mark.parametrize(
    ("program", "words", "said"),
    [
        ("robot_node", ["--dryrun"], "unrecognized arguments: --dryrun"),
        ("robot_node", [], "error: policy='' is not allowed"),
        ("robot_node", ["--ros-args", "-p", "rat:=5.0"], "error: parameter 'rat' is not allowed"),
        ("lab_sim", ["--ros-args", "-p", "speed:=0.0"], "error: speed=0.0 is not allowed"),
        ("lab_sim", ["--ros-args", "-p", "arena.num_agents:=2"], "the arena has 2 robots"),
        ("lab_sim", ["--ros-args", "-p", "team:=[/a, b, c, d]"], "'/a' is no namespace"),
        ("lab_sim", ["--ros-args", "-p", "seed:=-1"], "error: seed=-1 is not allowed"),
        ("lab_sim", ["--ros-args", "-p", "frame:=''"], "error: frame='' is not allowed"),
    ],
)
def test_what_cannot_work_is_refused_in_a_line(workspace, program, words, said):
    done = subprocess.run(
        [workspace.install / "lib" / "marl_explore_ros2" / program, *words],
        env=workspace.environment(),
        capture_output=True,
        text=True,
    )
    assert done.returncode in (1, 2)
    assert said in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr


def test_a_pose_that_is_not_finite_is_dropped_and_ends_no_node(workspace, tmp_path):
    log = tmp_path / "robot_0.log"
    pose = Pose(1.0, 0, float("nan"), 0.0, 0.0)
    broken = convert.fill(PoseStamped(), convert.pose_fields(pose, "arena"))
    options = {"names": ["lab", "robot_0"], "robots": {"patience": 3.0}}
    with running(workspace, policy_file(tmp_path), tmp_path, **options) as (_, watcher):
        poses = watcher.create_publisher(PoseStamped, "/robot_0/pose", qos_profile_sensor_data)

        def dropped():
            poses.publish(broken)
            return "dropped a pose of robot 0: x=nan" in log.read_text()

        watcher.until(dropped)
        tick = watcher.ticks[0]
        watcher.until(lambda: watcher.ticks[0] > tick + 1)


def test_a_node_that_ends_by_an_error_is_stopped_first(monkeypatch):
    monkeypatch.setattr("signal.signal", lambda number, handler: None)  # pytest keeps its own
    stopped = []

    def broken():
        node = Node("broken")
        node.create_timer(0.01, lambda: 1 / 0)
        return node

    with pytest.raises(ZeroDivisionError):
        run(broken, None, lambda node: stopped.append(node.get_name()))
    assert stopped == ["broken"]


def test_parameters_are_read_only_once_a_node_runs():
    rclpy.init(args=["--ros-args", "-p", "rate:=5.0"])
    try:
        node = ParameterNode("robot_node", RobotParameters())
        for name, value in (("rate", 5.0), ("patience", 60.0), ("settings.max_pose_age", 0.5)):
            (result,) = node.set_parameters([Parameter(name, value=value + 1)])
            assert not result.successful
            assert "read-only" in result.reason
            assert node.get_parameter(name).value == value
        assert node.given.rate == 5.0
    finally:
        rclpy.shutdown()


def test_before_simulated_time_begins_a_robot_of_a_fleet_says_so(tmp_path):
    """Its topics and those of its team stand under the namespace of the fleet."""
    given = ("use_sim_time:=true", f"policy:={policy_file(tmp_path)}")
    words = [word for entry in given for word in ("-p", entry)]
    rclpy.init(args=["--ros-args", *words, "-r", "__ns:=/fleet/robot_0"])
    try:
        node, listener, found = RobotNode(), Node("listener"), []
        listener.create_subscription(DiagnosticArray, "/fleet/robot_0/status", found.append, LATEST)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        executor.add_node(listener)
        until = time.monotonic() + 30
        while not found and time.monotonic() < until:
            executor.spin_once(timeout_sec=0.1)
        (status,) = found[0].status
        assert status.message == "waiting for simulated time on /clock"
        details = {entry.key: entry.value for entry in status.values}
        assert details["numpy instead of the kernel"] in ("0", "1")
        for name in ("robot_0", "robot_1"):
            assert len(node.get_subscriptions_info_by_topic(f"/fleet/{name}/pose")) == 1
        assert node.count_publishers("/fleet/robot_1/inbox") == 1
    finally:
        rclpy.shutdown()


def travelled(poses):
    """Furthest from where it was first (metres)."""
    if not poses:
        return 0.0
    places = np.array([(pose.x, pose.y) for pose in poses])
    return np.hypot(*(places - places[0]).T).max()


# ---------------------------------------------------------------- fields in rclpy's messages

MAP = np.array([[1, 0, -1], [0, 0, 1]], np.int8)


def test_rclpys_messages_take_all_fields():
    scan = Scan(4.5, np.array([0.5, np.inf, 0.0]))
    back = convert.to_scan(convert.fill(LaserScan(), convert.scan_fields(scan, "base_scan")))
    assert np.array_equal(back.ranges, scan.ranges)
    assert back.angle_increment == pytest.approx(scan.angle_increment)
    pose = convert.fill(PoseStamped(), convert.pose_fields(Pose(4.5, 1, 1.0, 2.0, 0.5), "arena"))
    assert convert.to_pose(pose, 1) == Pose(4.5, 1, 1.0, 2.0, pytest.approx(0.5))
    fields = convert.grid_fields(MAP, Frame(2, 3, 0.5), 1.0, "arena")
    grid = convert.fill(OccupancyGrid(), fields)
    assert np.array_equal(convert.to_grid(grid), MAP)
    assert grid.info.resolution == 0.5
    letter = Envelope(2, (0,), Intent(2, 7, (3, 4), 5, True))
    assert (
        convert.to_letter(convert.fill(UInt8MultiArray(), convert.letter_fields(letter)), 0)
        == letter
    )
    velocity = Velocity(0.125, -1.5)
    twist = convert.fill(Twist(), convert.velocity_fields(velocity))
    stamped = convert.fill(
        TwistStamped(), convert.stamped_velocity_fields(velocity, 2.0, "base_link")
    )
    assert convert.to_velocity(twist) == convert.to_velocity(stamped) == velocity

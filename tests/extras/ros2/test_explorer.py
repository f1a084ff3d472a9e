"""Explorer nodes as processes, with a simulated SLAM and Nav2, over DDS on loopback."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String

from marl_explore.robot.explorer import OccupancyMap, Place
from marl_explore.ros2 import convert
from marl_explore.ros2.node import LATEST
from tests.extras.ros2.conftest import ROOT
from tests.extras.ros2.explorers import (
    MOST_SECONDS,
    Explorers,
    Slam,
    map_message,
    without_torch,
)
from tests.helpers.slam import World

PLAN = """
####################################
#...........#......................#
#...........#......................#
#...........#......................#
#...1..............................#
#...2..............................#
#...........#......................#
#...........##########aaaa##########
#...........#......................#
#...........#......................#
#...........#......................#
####################################
"""
"""A room with doors to the east, and one in the south that closes."""
DONE = ("complete", "stuck")


@pytest.fixture
def environment():
    return {**os.environ, "PYTHONPATH": str(ROOT)}


@contextmanager
def exploring(environment, folder, *args, **options):
    rclpy.init()
    slam = Slam(*args, **options)
    try:
        with Explorers(environment, folder) as explorers:
            yield explorers, slam
    finally:
        slam.destroy_node()
        rclpy.shutdown()


def test_two_robots_explore_while_a_door_closes(workspace, tmp_path):
    """As the launch file starts them; maps are latched or not, and in frames of their own."""
    frames = {"robot_1": Place(1.1, 1.6), "robot_2": Place(1.1, 2.6)}  # as in explorers.yaml
    args = workspace.environment(), tmp_path, World(PLAN), frames
    with exploring(*args, volatile=("robot_2",), waits=2.0) as (explorers, slam):
        explorers.launch(workspace, "explorers.launch.xml", ["use_sim_time:=true"])
        # before anybody is behind the door
        under_way = lambda: any(rover.driven > 1.5 for rover in slam.rovers.values())  # noqa: E731
        slam.events.append((under_way, lambda: slam.world.close("a")))
        slam.until(lambda: all(slam.state(name) in DONE for name in frames), explorers)
        assert {slam.state(name) for name in frames} == {"complete"}
        for name in frames:
            status, values = slam.statuses[name]
            assert status.message.startswith("complete: no frontier is left")
            assert status.level == b"\x00"
            assert int(values["goals given up"]) == 0
            (team,) = (said for key, said in values.items() if key.startswith("teammate"))
            assert "map merged" in team
            assert slam.markers[name].keys() == {"frontiers", "plan", "skipped"}
            rover = slam.rovers[name]
            assert rover.driven > 1
            start = rover.frame.relative(slam.world.starts[name[-1]])
            assert rover.place.distance(start) < 0.6, status.message
        reached = slam.explored()
        assert 0.55 < reached < 0.9  # not what is behind the closed door
        slam.world.open("a")
    assert set(explorers.codes.values()) == {0}, explorers.said()


def test_one_robot_without_a_namespace_and_a_shared_clock(environment, tmp_path):
    """The node starts before SLAM and waits for it; then with SLAM's stamps of another time."""
    words = ["-p", "settings.settle:=2.0", "-p", "settings.map_patience:=1.0", "-p", "rate:=8.0"]
    words += ["-p", "settings.return_to_start:=false"]
    world = World(PLAN)
    with exploring(environment, tmp_path, world, {"": Place(1.0, 0.5)}, has_clock=False) as (
        explorers,
        slam,
    ):
        send_map, send_pose = slam._send_map, slam._send_pose
        slam._send_map = slam._send_pose = lambda *message: None
        explorers.start("", words)
        slam.until(lambda: slam.state("") == "waiting", explorers)
        assert "waiting for a map" in slam.statuses[""][0].message
        slam._send_map, slam._send_pose = send_map, send_pose
        slam.until(lambda: slam.state("") in DONE, explorers)
        assert slam.states[""] == ["waiting", "exploring", "complete"]
        assert slam.explored() > 0.93
        goal = slam.markers[""]
        assert goal["plan"].header.frame_id == "map"


def test_a_teammate_that_comes_late_or_dies(environment, tmp_path):
    words = ["-p", "team:=[robot_1, robot_2]", "-p", "use_sim_time:=true"]
    words += ["-p", "settings.lost_after:=5.0"]
    frames = {"robot_1": Place(0.0, 0.0), "robot_2": Place(0.0, 0.0)}
    args = environment, tmp_path, World(PLAN), frames
    with exploring(*args, together=False) as (explorers, slam):

        def team():
            return slam.statuses["robot_1"][1].get("teammate robot_2", "")

        silent, send = slam._poses.pop("robot_2"), slam._send_map
        slam._send_pose = lambda name, place, send=slam._send_pose: (
            send(name, place) if name in slam._poses else None
        )
        slam._send_map = lambda name, grid: send(name, grid) if name in slam._poses else None
        explorers.start("robot_1", words)
        slam.until(lambda: slam.state("robot_1") == "exploring", explorers)
        assert team() == "not heard yet"
        slam._poses["robot_2"] = silent
        explorers.start("robot_2", words)
        slam.until(lambda: "map merged" in team(), explorers)
        explorers.processes["robot_2"].kill()
        explorers.processes.pop("robot_2").wait()
        del slam._poses["robot_2"]
        slam.until(lambda: "lost, last heard" in team(), explorers)
        slam.until(lambda: slam.state("robot_1") in DONE, explorers)
        assert slam.state("robot_1") == "complete"


def test_simulated_time_that_has_not_begun_is_waited_for(environment, tmp_path):
    args = environment, tmp_path, World(PLAN), {"": Place(0.0, 0.0)}
    with exploring(*args, has_clock=False) as (explorers, slam):
        explorers.start("", ["-p", "use_sim_time:=true"])
        slam.until(lambda: slam.state("") == "waiting", explorers)
        assert "/clock" in slam.statuses[""][0].message
        slam.has_clock = True
        slam.until(lambda: slam.state("") == "exploring", explorers)


def test_what_cannot_be_used_is_dropped_with_a_reason(environment, tmp_path):
    args = environment, tmp_path, World(PLAN), {"": Place(0.0, 0.0)}
    with exploring(*args, has_clock=False) as (explorers, slam):
        slam._send_map = slam._send_pose = lambda *message: None
        explorers.start("", [])
        slam.until(lambda: slam.state("") == "waiting", explorers)
        grid = OccupancyMap(np.zeros((3, 4), np.int8), 0.05, Place(0.0, 0.0))
        other, short, none = (map_message(grid) for _ in range(3))
        other.header.frame_id = "odom"
        short.info.height = 5
        none.info.origin.orientation.w = 0.0
        pose = PoseWithCovarianceStamped()
        pose.header.frame_id = "map"
        log = tmp_path / "alone.log"
        for message, said in (
            (other, "frame_id='odom' is not allowed: it must be 'map'"),
            (short, "data of 12 cells are not allowed: the map has 5 x 4"),
            (none, "orientation=(0.0, 0.0, 0.0, 0.0) is not allowed"),
            (pose, "dropped from /pose: orientation=(0.0, 0.0, 0.0, 0.0) is not allowed"),
        ):
            topic = slam._poses[""] if message is pose else slam._maps[""]

            def dropped(topic=topic, message=message, said=said):
                topic.publish(message)
                return said in log.read_text()

            pose.pose.pose.orientation.w = 0.0
            slam.until(dropped, explorers)


@contextmanager
def explorer_node(*words):
    """An explorer's node in this process, in a team of a and b."""
    from marl_explore.ros2.explorer_node import ExplorerNode

    rclpy.init(args=["--ros-args", "-r", "__ns:=/a", "-p", "team:=[a, b]", *words])
    try:
        node = ExplorerNode()
        yield node
        node.destroy_node()
    finally:
        rclpy.shutdown()


def a_room(percent=0, size=60, resolution=0.05, frame="map"):
    grid = OccupancyMap(np.full((size, size), percent, np.int8), resolution, Place(0.0, 0.0))
    return map_message(grid, frame_id=frame)


def a_pose(frame="map", x=2.5):
    return convert.fill(PoseStamped(), convert.place_fields(Place(x, 1.0), 0.0, frame))


def hear(node, topic, message):
    """Give a node a message as its subscription does."""
    (listener,) = (entry for entry in node.listeners if entry.topic == topic)
    listener.take(message)


@pytest.mark.parametrize(
    ("words", "frame", "other"),
    [
        ((), "map", "odom"),
        (("-p", "map_frames:=[a/map, b/map]", "-p", "frame:=/a/map"), "b/map", "a/map"),
    ],
)
def test_what_a_teammate_says_in_another_frame_is_dropped(words, frame, other):
    """It used to be taken as if it were in the frame of its map."""
    with explorer_node(*words) as node:
        mate = node.core.team.mates["b"]
        for dropped, (topic, message) in enumerate(
            (
                ("/b/map", a_room(frame=other)),
                ("/b/explorer/pose", a_pose(other)),
                ("/b/goal_pose", a_pose(other)),
                ("/a/map", a_room(frame="odom")),
            ),
            1,
        ):
            hear(node, topic, message)
            assert node._dropped == dropped
        assert (mate.map, mate.place, mate.goal, node.core.map) == (None,) * 4
        for topic, message in (
            ("/b/map", a_room(frame=frame)),
            ("/b/explorer/pose", a_pose(f"/{frame}")),
            ("/b/goal_pose", a_pose(frame)),
            ("/a/map", a_room(frame=node.given.frame)),
        ):
            hear(node, topic, message)
        assert None not in (mate.map, mate.place, mate.goal, node.core.map)
        assert node._dropped == 4


def test_maps_of_any_size_end_no_node(monkeypatch):
    """Small ones are explored, and those that would take minutes are dropped and counted."""
    with explorer_node() as node:
        said = []
        monkeypatch.setattr(node._statuses, "publish", lambda message: said.append(message))
        hear(node, "/a/map", a_room())
        node.poses.place = lambda: Place(1.0, 1.0)
        for topic in ("/b/map", "/a/map"):
            for size, resolution in ((1, 0.05), (2, 0.05), (3, 0.03), (5, 0.02)):
                hear(node, topic, a_room(size=size, resolution=resolution))
                node.core._looked_at = -99.0
                node._advance()
        assert node._dropped == 0
        own = node.core.map
        for message in (a_room(resolution=5.0), a_room(percent=101), a_room(resolution=0.0)):
            hear(node, "/a/map", message)
            hear(node, "/b/map", message)
        assert node.core.map is own
        node._advance()
        values = {entry.key: entry.value for entry in said[-1].status[0].values}
        assert values["messages dropped"] == "6"


def test_a_pose_that_cannot_be_used_is_dropped_once():
    with explorer_node() as node:
        for _ in range(2):
            node.poses._take(a_pose("odom"))
            for _ in range(3):
                node._advance()
        assert node._dropped == 2
        node.poses._take(a_pose())
        node._advance()
        node._advance()
        assert node.core.place == (2.5, 1.0, 0.0)
        assert node._dropped == 2


# ---------------------------------------------------------------- --check and parameters


def checked(environment, *words):
    return subprocess.run(
        [sys.executable, "-m", "marl_explore.ros2.explorer_node", "--check", "--ros-args", *words],
        env=environment,
        capture_output=True,
        text=True,
    )


def test_check_says_what_is_missing(environment):
    done = checked(environment, "-p", "team:=[a, b]", "-r", "__ns:=/a")
    assert done.returncode == 1, done.stderr
    lines = done.stdout.splitlines()
    assert lines == [
        "/a/goal_pose: no subscriber: is Nav2 running?",
        "/a/map: no publisher",
        "/a/pose: no publisher",
        "/b/explorer/pose: no publisher",
        "/b/goal_pose: no publisher",
        "/b/map: no publisher",
    ]


def test_check_is_content_and_names_a_wrong_type(environment):
    rclpy.init()
    node = Node("some_stack")
    try:
        node.create_publisher(OccupancyGrid, "/map", LATEST)
        node.create_subscription(PoseStamped, "/goal_pose", lambda message: None, 1)
        wrong = node.create_publisher(String, "/pose", 1)
        done = checked(environment)
        assert done.returncode == 1
        assert "/pose: published as std_msgs/msg/String, not geometry_msgs/msg/Pose" in done.stdout
        node.destroy_publisher(wrong)
        node.create_publisher(PoseStamped, "/pose", 1)
        done = checked(environment)
        assert done.stdout.splitlines() == ["/goal_pose: ok", "/map: ok", "/pose: ok"]
        assert done.returncode == 0
    finally:
        node.destroy_node()
        rclpy.shutdown()


def test_check_does_not_take_a_teammate_for_nav2_and_needs_simulated_time(environment):
    rclpy.init()
    mate, nav2 = Node("explorer_node", namespace="/b"), Node("bt_navigator", namespace="/a")
    words = "-p", "team:=[a, b]", "-r", "__ns:=/a", "-p", "use_sim_time:=true"
    try:
        mate.create_subscription(PoseStamped, "/a/goal_pose", lambda message: None, 1)
        lines = checked(environment, *words).stdout.splitlines()
        assert "/a/goal_pose: no subscriber: is Nav2 running?" in lines
        assert "/clock: no publisher, and use_sim_time is true" in lines
        nav2.create_subscription(PoseStamped, "/a/goal_pose", lambda message: None, 1)
        nav2.create_publisher(Clock, "/clock", 1)
        lines = checked(environment, *words).stdout.splitlines()
        assert {"/a/goal_pose: ok", "/clock: ok"} <= {*lines}
    finally:
        mate.destroy_node()
        nav2.destroy_node()
        rclpy.shutdown()


def test_check_of_a_robot_in_a_fleet(environment):
    done = checked(environment, "-p", "team:=[a, b]", "-r", "__ns:=/fleet/a")
    assert "/fleet/b/map: no publisher" in done.stdout.splitlines()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["-p", "settings.radius:=0.0"], "error: radius=0.0 is not allowed"),
        (["-p", "team:=[a, b]"], "error: team=['a', 'b'] is not allowed: the node's namespace ''"),
        (["-p", "pose_source:=odom"], "error: pose_source='odom' is not allowed"),
        (["-p", "pose_source:=tf"], "error: pose_source='tf' is not allowed: No module named"),
        (["-p", "min_frontier:=1.0"], "error: parameter 'min_frontier' is not allowed"),
        (["-p", "settings.radius:=0.003"], "error: radius=0.003 is not allowed: it must be from"),
        (
            ["-r", "__ns:=/a", "-p", "team:=[a, /b]"],
            "error: team=['a', '/b'] is not allowed: '/b' is no namespace",
        ),
        (["-p", "map_topic:='a b'"], "error: map_topic='a b' is not allowed: it must be a topic"),
        (
            ["-r", "__ns:=/a", "-p", "team:=[a, b]", "-p", "map_topic:=/map"],
            "error: map_topic='/map' is not allowed: in a team it must be relative",
        ),
        (["-p", "frame:=''"], "error: frame='' is not allowed: it must be the name of a frame"),
        (["-p", "team:=[1, 2]"], "error: team="),
    ],
)
def test_what_cannot_work_is_refused_in_a_line(environment, words, said):
    done = checked(environment, *words)
    assert done.returncode == 1
    assert said in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr


def test_torch_cannot_be_imported_where_it_is_blocked(environment, tmp_path):
    """The processes above run on such a path."""
    environment["PYTHONPATH"] = f"{without_torch(tmp_path / 'without')}:{ROOT}"
    code = "import marl_explore.ros2.explorer_node, marl_explore.ros2.robot_node\nimport torch"
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True
    )
    assert done.stderr.splitlines()[-1] == "ImportError: torch is not on robots"


# ---------------------------------------------------------------- subscriptions


BEST_EFFORT = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


@pytest.mark.parametrize(
    "profiles",
    [[LATEST], [QoSProfile(depth=1)], [BEST_EFFORT], [LATEST, QoSProfile(depth=1)]],
    ids=["latched", "volatile", "best effort", "both"],
)
def test_a_listener_hears_every_publisher(profiles):
    from marl_explore.ros2.explorer_node import MAPS
    from marl_explore.ros2.listening import Listener

    with two_nodes() as (hears, speaks):
        heard = []
        listener = Listener(hears, "map", MAPS, lambda m: heard.append(m.info.resolution))
        speakers = [speaks.create_publisher(OccupancyGrid, "/map", qos) for qos in profiles]
        message = OccupancyGrid()
        if profiles == [LATEST]:  # once, before it listens
            speakers[0].publish(message)
        turns = itertools.count(1)

        def speak():
            if profiles != [LATEST]:
                turn = next(turns) % len(speakers)
                message.info.resolution = float(turn)
                speakers[turn].publish(message)

        until(lambda: len({*heard}) == len(speakers), listener, speak)
        assert len({*heard}) == len(speakers)
        assert listener.problem() is None


def until(happened, listener, speak):
    """Speak and listen until something has happened.

    How long DDS needs to find another node depends on what else the machine does: it announces
    itself a few times at once, then every three seconds.
    """
    end = time.monotonic() + MOST_SECONDS
    while not happened():
        listener.update()
        speak()
        rclpy.spin_once(listener.node, timeout_sec=0.05)
        if time.monotonic() > end:
            infos = listener.node.get_publishers_info_by_topic(listener.topic)
            found = [(info.node_name, info.topic_type, info.qos_profile) for info in infos]
            pytest.fail(f"{listener.topic} as {listener._choice}: {found}")


@contextmanager
def two_nodes():
    """As in two processes: in one, a topic can have one type only."""
    rclpy.init()
    other = rclpy.Context()
    other.init()
    nodes = Node("hears"), Node("speaks", context=other)
    try:
        yield nodes
    finally:
        for node in nodes:
            node.destroy_node()
        other.shutdown()
        rclpy.shutdown()


@pytest.mark.parametrize("kind", [PoseStamped, PoseWithCovarianceStamped])
def test_poses_may_be_of_either_type(kind):
    from marl_explore.ros2.pose_sources import TopicPoses

    fields = convert.place_fields(Place(1.0, 2.0, 0.5), 0.0, "map")
    if kind is PoseWithCovarianceStamped:
        fields["pose"] = {"pose": fields["pose"]}
    message = convert.fill(kind(), fields)
    with two_nodes() as (node, speaks):
        source = TopicPoses(node, "pose", "map")
        assert source.place() is None
        assert source.problem() == "no publisher"
        topic = speaks.create_publisher(kind, "/pose", 1)
        place = source.place
        until(lambda: place() is not None, source._listener, lambda: topic.publish(message))
        assert source.place() == source.place() == pytest.approx((1.0, 2.0, 0.5))
        assert source.problem() is None


def test_poses_may_be_of_tf():
    from marl_explore.ros2.pose_sources import TransformPoses

    buffer = FakeBuffer()
    transforms = TransformPoses(buffer, "map", "base_link", LookupError)
    assert transforms.place() is None
    assert transforms.problem() == "no transform"
    buffer.found = a_pose().pose
    assert transforms.place() == pytest.approx((2.5, 1.0, 0.0))
    assert transforms.problem() is None
    assert buffer.asked == ("map", "base_link", 0)


class FakeBuffer:
    """As ``tf2_ros.Buffer``: what was found is a pose."""

    found = asked = None

    def lookup_transform(self, target, source, when):
        self.asked = target, source, when.nanoseconds
        if self.found is None:
            raise LookupError("no transform")
        from geometry_msgs.msg import TransformStamped

        message = TransformStamped()
        place = self.found.position
        message.transform.translation.x, message.transform.translation.y = place.x, place.y
        message.transform.rotation = self.found.orientation
        return message

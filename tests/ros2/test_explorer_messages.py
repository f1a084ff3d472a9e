"""What explorers take and show, as fields of messages, and their parameters."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from marl_explore.robot import Scan
from marl_explore.robot.explorer import Output, Place, Status
from marl_explore.ros2 import convert, displays
from marl_explore.ros2.explorer_parameters import ExplorerParameters
from marl_explore.ros2.parameters import flat, replaced
from tests.ros2.test_convert import message
from tests.ros2.test_parameters import CONFIG, of_file


def quaternion(x, y, z, w):
    return SimpleNamespace(x=x, y=y, z=z, w=w)


@pytest.mark.parametrize("length", [0.01, 1.0, 7.0])
@pytest.mark.parametrize("yaw", [-3.0, 0.0, 0.5, 2.5])
def test_quaternions_of_any_length_have_a_yaw(length, yaw):
    turned = quaternion(0.0, 0.0, length * math.sin(yaw / 2), length * math.cos(yaw / 2))
    assert convert.yaw_of(turned) == pytest.approx(yaw)


@pytest.mark.parametrize(
    "numbers", [(0, 0, 0, 0), (1e-5, 0, 0, 0), (0, math.nan, 0, 1), (0, 0, 0, math.inf)]
)
def test_quaternions_that_are_none_are_refused(numbers):
    with pytest.raises(ValueError, match=r"orientation=\(.*\) is not allowed"):
        convert.yaw_of(quaternion(*map(float, numbers)))


def test_places_come_back_with_and_without_covariance():
    fields = convert.place_fields(Place(1.0, -2.0, 0.7), 3.0, "map")
    plain = message(fields)
    assert convert.to_place(plain) == pytest.approx((1.0, -2.0, 0.7))
    covered = message(fields | {"pose": {"pose": fields["pose"], "covariance": 0}})
    assert convert.to_place(covered) == pytest.approx((1.0, -2.0, 0.7))


def occupancy_grid(data, height, width, yaw=0.0):
    origin = convert.place_fields(Place(1.5, -0.5, yaw), 0.0, "map")["pose"]
    info = {"resolution": 0.05, "height": height, "width": width, "origin": origin}
    return message({"info": info, "data": np.array(data, np.int8)})


def test_an_occupancy_grid_keeps_its_rows_resolution_and_origin():
    grid = convert.to_occupancy_map(occupancy_grid([0, 100, -1, 50, 0, 0], 2, 3, 0.3))
    assert grid.percent.tolist() == [[0, 100, -1], [50, 0, 0]]
    assert grid.resolution == 0.05
    assert grid.origin == pytest.approx((1.5, -0.5, 0.3))
    with pytest.raises(ValueError, match="data of 5 cells are not allowed: the map has 2 x 3"):
        convert.to_occupancy_map(occupancy_grid([0] * 5, 2, 3))


STATUS = Status("stuck", "nothing left", 12.34, 3, 1, 2, 9, 0, 2, 1, ("b: map refused: 9 of 10",))


def test_a_status_is_a_diagnostic_with_all_counts():
    fields = displays.status_fields(STATUS, "robot_1")
    assert fields["name"] == "robot_1/explorer"
    assert fields["message"] == "stuck: nothing left"
    assert fields["level"] == b"\x01"
    values = dict(fields["values"])
    assert values["known area (m2)"] == "12.3"
    assert values["goals given up"] == "2"
    assert values["teammate b"] == "map refused: 9 of 10"
    assert values["messages dropped"] == "0"
    assert ("messages dropped", "3") in displays.status_fields(STATUS, "", 3)["values"]
    assert displays.status_fields(Status("complete", "done"), "")["level"] == b"\x00"
    assert displays.status_fields(Status("complete", "done"), "")["name"] == "explorer"


def test_markers_show_frontiers_plan_and_skipped_goals_and_take_them_back():
    output = Output(None, STATUS, [[(1.0, 2.0)], [(3.0, 4.0), (5.0, 6.0)]], [], [(0.0, 0.0)])
    shown = {
        fields["ns"]: (fields, points)
        for fields, points in displays.markers(output, 0.2, 1.0, "map")
    }
    assert shown["frontiers"][1] == [(1.0, 2.0), (3.0, 4.0), (5.0, 6.0)]
    assert shown["plan"][1] == [(0.0, 0.0)]
    assert shown["skipped"][1] == []
    assert [shown[name][0]["action"] for name in ("frontiers", "plan", "skipped")] == [0, 0, 2]
    assert shown["frontiers"][0]["header"]["frame_id"] == "map"


@pytest.mark.parametrize("name", ["explorer", "explorers"])
def test_files_have_parameters_that_exist_and_their_defaults(name):
    given = of_file(CONFIG / f"{name}.yaml")
    parameters = replaced(ExplorerParameters(), given)
    default = flat(ExplorerParameters())
    for key, value in given.items():
        assert key in ("team", "frames") or default[key] == value
    assert parameters.make_core("robot_1").team.mates.keys() == {*parameters.team} - {"robot_1"}


def test_teammates_frames_are_relative_to_the_own_one():
    given = ExplorerParameters(team=["a", "b"], frames=[1, 0, math.pi / 2, 1, 2, math.pi / 2])
    assert given.mates("a")["b"] == pytest.approx((2, 0, 0), abs=1e-9)
    assert given.mates("b")["a"] == pytest.approx((-2, 0, 0), abs=1e-9)
    assert ExplorerParameters(team=["a", "b"]).mates("a") == {"b": Place(0.0, 0.0, 0.0)}
    assert ExplorerParameters().mates("whoever") == {}


@pytest.mark.parametrize(
    ("given", "allowed"),
    [
        ({"team": ["a", "a"]}, "team=.* is not allowed: a robot is in it twice"),
        ({"team": ["a"], "frames": [0.0]}, "frames=.* is not allowed: x, y, yaw for each"),
        ({"rate": 0.5}, "rate=0.5 is not allowed"),
        ({"pose_source": "gps"}, "pose_source='gps' is not allowed"),
        ({"team": ["a", "/b"]}, "team=.* is not allowed: '/b' is no namespace"),
        ({"team": ["a", "b/"]}, "team=.* is not allowed: 'b/' is no namespace"),
        ({"team": ["a", ""]}, "team=.* is not allowed: '' is no namespace"),
        ({"team": ["a", "b c"]}, "team=.* is not allowed: 'b c' is no namespace"),
        ({"team": ["a", "2b"]}, "team=.* is not allowed: '2b' is no namespace"),
        ({"team": ["a", 1]}, "team=.* is not allowed: 1 is no namespace"),
        ({"team": ["a", "b" * 101]}, "team=.* is not allowed: 'bbb"),
        ({"map_topic": "a b"}, "map_topic='a b' is not allowed: it must be a topic"),
        ({"map_topic": ""}, "map_topic='' is not allowed: it must be a topic"),
        ({"pose_topic": "pose/"}, "pose_topic='pose/' is not allowed: it must be a topic"),
        ({"goal_topic": "//goal"}, "goal_topic='//goal' is not allowed: it must be a topic"),
        ({"goal_topic": "map"}, "goal_topic='map' is not allowed: it is the map's"),
        ({"pose_topic": "map"}, "pose_topic='map' is not allowed: it is the map's or that of goal"),
        ({"mate_pose_topic": "goal_pose"}, "mate_pose_topic='goal_pose' is not allowed"),
        (
            {"team": ["a", "b"], "map_topic": "/map"},
            "map_topic='/map' is not allowed: in a team it must be relative, .*: -r map:=/map",
        ),
        ({"team": ["a", "b"], "goal_topic": "~/goal"}, "goal_topic='~/goal' .* relative"),
        ({"team": ["a", "b"], "mate_pose_topic": "/pose"}, "mate_pose_topic='/pose' .* relative"),
        ({"frame": ""}, "frame='' is not allowed: it must be the name of a frame"),
        ({"frame": "/"}, "frame='/' is not allowed"),
        ({"base_frame": " "}, "base_frame=' ' is not allowed"),
        ({"rate": 1e9}, "rate=1000000000.0 is not allowed: it must be at most 1000 1/s"),
        ({"rate": math.nan}, "rate=nan is not allowed"),
        ({"team": ["a"], "frames": [0.0, math.nan, 0.0]}, "frames=nan is not allowed"),
        ({"team": ["a", "b"], "map_frames": ["map"]}, "map_frames=.* a name for each of the team"),
        ({"team": ["a"], "map_frames": [""]}, "map_frames='' is not allowed"),
    ],
)
def test_parameters_that_cannot_work_are_refused(given, allowed):
    with pytest.raises(ValueError, match=allowed):
        ExplorerParameters(**given)


def test_topics_of_one_robot_may_be_absolute():
    given = ExplorerParameters(map_topic="/map", pose_topic="/pose", goal_topic="~/goal")
    assert given.map_topic == "/map"
    in_team = ExplorerParameters(team=["fleet/a", "fleet/b"], pose_topic="/pose")
    assert in_team.mates("fleet/a").keys() == {"fleet/b"}
    assert ExplorerParameters(mate_pose_topic="pose").mate_pose_topic == "pose"


def test_frames_lose_the_slash_that_tf_has_no_more():
    given = ExplorerParameters(frame="/map", base_frame="/base_link", map_frames=[])
    assert (given.frame, given.base_frame) == ("map", "base_link")
    message_ = message({"header": {"frame_id": "/map"}})
    convert.require_frame(message_, given.frame)
    convert.require_frame(message_, "/map")
    with pytest.raises(ValueError, match="frame_id='map' is not allowed: it must be 'odom'"):
        convert.require_frame(message_, "odom")


def test_map_frames_of_a_team_are_those_of_the_own_one_or_named():
    given = ExplorerParameters(team=["a", "b"])
    assert [given.frame_of(robot) for robot in (None, "a", "b")] == ["map"] * 3
    named = ExplorerParameters(team=["a", "b"], frame="a/map", map_frames=["a/map", "/b/map"])
    assert [named.frame_of(robot) for robot in (None, "a", "b")] == ["a/map", "a/map", "b/map"]
    assert named.make_core("a").team.mates.keys() == {"b"}
    with pytest.raises(ValueError, match="map_frames=.* that of 'b' must be frame='a/map'"):
        named.make_core("b")


# ---------------------------------------------------------------- tilted maps and lidars


def turned_by(yaw=0.0, pitch=0.0, roll=0.0):
    """A quaternion of yaw, then pitch, then roll."""
    (cy, sy), (cp, sp), (cr, sr) = (
        (math.cos(angle / 2), math.sin(angle / 2)) for angle in (yaw, pitch, roll)
    )
    return {
        "w": cr * cp * cy + sr * sp * sy,
        "x": sr * cp * cy - cr * sp * sy,
        "y": cr * sp * cy + sr * cp * sy,
        "z": cr * cp * sy - sr * sp * cy,
    }


@pytest.mark.parametrize("yaw", [0.0, 2.0])
@pytest.mark.parametrize("length", [0.5, 1.0])
def test_the_tilt_of_a_quaternion_is_the_angle_to_up(yaw, length):
    for pitch, roll in ((0.0, 0.0), (0.3, 0.0), (0.0, -0.4), (0.0, math.pi), (math.pi, 0.0)):
        turned = {name: length * n for name, n in turned_by(yaw, pitch, roll).items()}
        expected = max(abs(pitch), abs(roll))
        assert convert.tilt_of(message(turned)) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    ("turned", "degrees"),
    [(turned_by(roll=math.pi), 180), (turned_by(0.5, pitch=0.3), 17), (turned_by(0, 0, -0.2), 11)],
)
def test_maps_that_are_not_level_are_refused(turned, degrees):
    """They used to be read as if they were."""
    given = occupancy_grid([0] * 6, 2, 3)
    given.info.origin.orientation = message(turned)
    with pytest.raises(ValueError, match=f"tilted by {degrees} degrees is not allowed"):
        convert.to_occupancy_map(given)
    given.info.origin.orientation = message(turned_by(0.5, 0.02, -0.02))
    assert convert.to_occupancy_map(given).origin.yaw == pytest.approx(0.5, abs=1e-3)


def test_data_that_are_not_int8_are_refused():
    given = occupancy_grid([0] * 6, 2, 3)
    given.data = [0, 0, 0, 0, 0, 200]
    with pytest.raises(ValueError, match="data beyond -128 to 127 are not allowed"):
        convert.to_occupancy_map(given)
    given.data = [0, 0, 0, 0, 0, 101]
    with pytest.raises(ValueError, match="percent=101 is not allowed"):
        convert.to_occupancy_map(given).check()


SCAN = Scan(4.5, np.array([1.0, 2.0, 3.0, 4.0]), -0.5, 0.25, 0.1, 5.0)


def mounted(**angles):
    transform = {"translation": {"x": 0.1, "y": -0.2, "z": 0.3}, "rotation": turned_by(**angles)}
    fields = message(convert.scan_fields(SCAN, "laser"))
    return convert.to_mounted_scan(fields, message(transform))


@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5])
@pytest.mark.parametrize("roll", [0.0, math.pi])
def test_a_scan_points_where_its_lidar_does_also_upside_down(yaw, roll):
    scan = mounted(yaw=yaw, roll=roll)
    scan.check()
    assert scan.mount == pytest.approx((0.1, -0.2, yaw))
    angles = SCAN.angle_min + SCAN.angle_increment * np.arange(4)
    in_lidar = np.stack((np.cos(angles), np.sin(angles) * math.cos(roll)))  # turned about x
    turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    read = scan.mount.yaw + scan.angle_min + scan.angle_increment * np.arange(4)
    assert np.stack((np.cos(read), np.sin(read))) == pytest.approx(turn @ in_lidar, abs=1e-6)


@pytest.mark.parametrize("angles", [{"pitch": 0.3}, {"roll": 1.57}, {"roll": math.pi - 0.2}])
def test_a_lidar_that_is_tilted_is_refused(angles):
    with pytest.raises(ValueError, match="a lidar that is tilted by [0-9]+ degrees is not allowed"):
        mounted(yaw=0.4, **angles)

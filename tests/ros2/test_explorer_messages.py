"""What explorers take and show, as fields of messages, and their parameters."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

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
    ],
)
def test_parameters_that_cannot_work_are_refused(given, allowed):
    with pytest.raises(ValueError, match=allowed):
        ExplorerParameters(**given)

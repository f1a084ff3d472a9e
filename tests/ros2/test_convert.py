"""Messages' fields and what robots know: there and back, and against fields written by hand."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_explore.robot import Envelope, Pose, Scan
from marl_explore.robot.driving import Velocity
from marl_explore.robot.evidence import Evidence
from marl_explore.robot.geometry import Frame
from marl_explore.robot.messages import Done, Share
from marl_explore.ros2 import convert

METRES = st.floats(-50, 50)
SECONDS = st.floats(0, 2e9)


def message(fields):
    """An object with those fields, as a message has them."""
    return SimpleNamespace(
        **{
            name: message(value) if isinstance(value, dict) else value
            for name, value in fields.items()
        }
    )


@given(SECONDS)
def test_times_come_back_to_the_resolution_of_floats(seconds):
    fields = convert.time_fields(seconds)
    assert 0 <= fields["nanosec"] < 10**9
    assert abs(convert.to_seconds(message(fields)) - seconds) < 1e-6


def test_a_time_that_rounds_up_to_the_next_second():
    assert convert.time_fields(17.9999999999) == {"sec": 18, "nanosec": 0}


@given(SECONDS, METRES, METRES, st.floats(-math.pi, math.pi))
def test_poses_come_back(stamp, x, y, yaw):
    fields = convert.pose_fields(Pose(stamp, 2, x, y, yaw), "arena")
    assert fields["header"]["frame_id"] == "arena"
    back = convert.to_pose(message(fields), 2)
    assert (back.robot, back.x, back.y) == (2, x, y)
    assert math.isclose(math.cos(back.yaw - yaw), 1)
    assert abs(back.stamp - stamp) < 1e-6


@given(st.floats(-3, 3), st.floats(-1.5, 1.5), st.floats(-3, 3))
def test_yaw_is_that_of_a_tilted_robot(yaw, pitch, roll):
    """Quaternion of yaw, then pitch, then roll, multiplied out."""
    (cy, sy), (cp, sp), (cr, sr) = (
        (math.cos(angle / 2), math.sin(angle / 2)) for angle in (yaw, pitch, roll)
    )
    turned = SimpleNamespace(
        w=cr * cp * cy + sr * sp * sy,
        x=sr * cp * cy - cr * sp * sy,
        y=cr * sp * cy + sr * cp * sy,
        z=cr * cp * sy - sr * sp * cy,
    )
    fields = message(convert.pose_fields(Pose(0.0, 0, 0.0, 0.0, 0.0), "arena"))
    fields.pose.orientation = turned
    assert math.isclose(convert.to_pose(fields, 0).yaw, yaw, abs_tol=1e-6)


def test_a_scan_comes_back_as_ros_has_it():
    ranges = np.array([0.0, np.inf, np.nan, 1.25, 3.5])
    scan = Scan(4.5, ranges, -1.0, 0.5, 0.25, 3.5)
    fields = convert.scan_fields(scan, "robot_1/base_scan")
    assert fields["angle_max"] == 1.0
    assert fields["ranges"].dtype == np.float32
    back = convert.to_scan(message(fields))
    assert np.array_equal(back.ranges, ranges, equal_nan=True)
    given = (scan.stamp, scan.angle_min, scan.angle_increment, scan.range_min, scan.range_max)
    assert given == (
        back.stamp,
        back.angle_min,
        back.angle_increment,
        back.range_min,
        back.range_max,
    )


def test_row_0_of_an_occupancy_grid_is_the_south():
    grid = np.array([[1, 0, 0], [-1, -1, 0]], np.int8)
    fields = convert.grid_fields(grid, Frame(2, 3, 0.5), 7.25, "arena")
    assert fields["data"].tolist() == [-1, -1, 0, 100, 0, 0]
    assert fields["data"].dtype == np.int8
    info = fields["info"]
    assert (info["width"], info["height"], info["resolution"]) == (3, 2, 0.5)
    assert info["origin"]["position"] == {"x": -0.75, "y": -0.5, "z": 0.0}
    assert fields["header"] == {"stamp": {"sec": 7, "nanosec": 250_000_000}, "frame_id": "arena"}


@given(
    st.lists(st.lists(st.sampled_from((-1, 0, 1)), min_size=4, max_size=4), min_size=1, max_size=5)
)
def test_maps_come_back(rows):
    grid = np.array(rows, np.int8)
    fields = convert.grid_fields(grid, Frame(*grid.shape, 0.5), 0.0, "arena")
    assert np.array_equal(convert.to_grid(message(fields)), grid)


def test_other_probabilities_are_occupied_from_a_half_on():
    fields = convert.grid_fields(np.zeros((1, 3), np.int8), Frame(1, 3, 0.5), 0.0, "arena")
    fields["data"] = np.array([49, 50, -1], np.int8)
    assert convert.to_grid(message(fields)).tolist() == [[0, 1, -1]]


def test_a_letter_comes_back_with_its_sender():
    known = Evidence(np.array([[2, -1, 0]], np.int8), np.array([[9, 5, -1]]))
    share = Share(1, 9, known)
    fields = convert.letter_fields(Envelope(3, (0, 2), share))
    assert len(fields["data"]) == 5 + len(share.encode())
    back = convert.to_letter(message(fields), 2)
    assert (back.sender, back.to, back.message.robot, back.message.tick) == (3, (2,), 1, 9)
    assert back.message.map.tolist() == [[1, 0, -1]]
    assert np.array_equal(back.message.evidence.rank, known.rank)


@pytest.mark.parametrize(
    "data", [b"", b"\x01", b"\x01\x09\x00", b"\x00" + Done(1, 2).encode()[:-1]]
)
def test_bytes_that_are_no_letter_are_refused(data):
    with pytest.raises(ValueError, match="bytes|message"):
        convert.to_letter(SimpleNamespace(data=data), 0)


@pytest.mark.parametrize("stamped", [False, True])
def test_velocities_come_back(stamped):
    velocity = Velocity(0.15, -1.5)
    fields = (
        convert.stamped_velocity_fields(velocity, 3.0, "base_link")
        if stamped
        else convert.velocity_fields(velocity)
    )
    twist = fields["twist"] if stamped else fields
    assert (twist["linear"]["x"], twist["angular"]["z"]) == (0.15, -1.5)
    assert convert.to_velocity(message(fields)) == velocity


def test_fields_are_filled_in_deep_and_arrays_of_their_type():
    empty = SimpleNamespace(header=SimpleNamespace(frame_id=""), data=None, other=5)
    filled = convert.fill(empty, {"header": {"frame_id": "a"}, "data": np.array([-1, 7], np.int8)})
    assert filled is empty
    assert (filled.header.frame_id, filled.other) == ("a", 5)
    assert (filled.data.typecode, filled.data.tolist()) == ("b", [-1, 7])

"""The small parts of a robot, by known answers."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_explore.config.constants import FREE, UNKNOWN
from marl_explore.robot import BarrierClock, Envelope, PeriodClock, Pose, RobotSettings, decode
from marl_explore.robot.driving import ZERO, Drive
from marl_explore.robot.evidence import Evidence, EvidenceModel
from marl_explore.robot.geometry import Frame, wrapped
from marl_explore.robot.jumps import JumpLimits
from marl_explore.robot.knowledge import Knowledge
from marl_explore.robot.mailbox import Mailbox
from marl_explore.robot.mapper import BeamModel
from marl_explore.robot.messages import Done, Intent, Share
from marl_explore.robot.observation import in_range
from marl_explore.robot.sensors import Sensors
from tests.helpers.boards import map_cells
from tests.helpers.strategies import repeatable

MODEL = EvidenceModel()
GAINS = ("max_forward", "max_turn", "arrival", "heading_tolerance", "forward_gain", "turn_gain")

# ---------------------------------------------------------------- geometry


def test_row_0_is_north_and_the_origin_in_the_middle():
    frame = Frame(12, 12, 0.5)
    assert frame.centre((0, 0)) == (-2.75, 2.75)
    assert frame.centre((11, 0)) == (-2.75, -2.75)
    assert frame.centre((0, 11)) == (2.75, 2.75)
    assert frame.cell(0.1, -0.1) == (6, 6)
    assert not frame.inside(frame.cell(3.01, 0))


@repeatable(max_examples=50)
@given(st.integers(1, 30), st.integers(1, 30), st.floats(0.1, 2), st.data())
def test_the_centre_of_a_cell_lies_in_it(height, width, size, data):
    frame = Frame(height, width, size)
    cell = (data.draw(st.integers(0, height - 1)), data.draw(st.integers(0, width - 1)))
    assert frame.cell(*frame.centre(cell)) == cell


def test_angles_wrap():
    assert wrapped(3 * math.pi / 2) == pytest.approx(-math.pi / 2)


def test_ranges_have_the_tolerance_of_the_rules():
    assert in_range((0, 0), (3, 0), 0.3 / 0.1)
    assert not in_range((0, 0), (3, 1), 3)
    assert in_range((0, 0), (99, 99), math.inf)


# ---------------------------------------------------------------- messages


@pytest.mark.parametrize(
    ("message", "size"),
    [
        (Intent(3, 70_000, (-1, 500), 9, True, False), 16),
        (Intent(0, 0, (0, 0), 1, False, True), 16),
        (Done(2, 2**40), 10),
    ],
)
def test_messages_come_back_from_their_bytes(message, size):
    assert decode(message.encode()) == message
    assert len(message.encode()) == size


@pytest.mark.parametrize("data", [b"", b"\x09abc", b"\x01\x00", b"\x02" + bytes(9)[:-1]])
def test_other_bytes_are_refused(data):
    with pytest.raises(ValueError, match="message"):
        decode(data)


def test_a_map_is_passed_on_once_and_counted():
    mail = Mailbox(0)
    share = Share(2, 4, Evidence.none(12, 12))
    mail.receive(Envelope(1, (0,), share))
    mail.receive(Envelope(3, (0,), share))
    for _ in range(2):
        mail.pass_on(4, {1, 3})
    (envelope,) = mail.collect()
    assert (envelope.sender, envelope.to, envelope.message) == (0, (3,), share)
    assert mail.sent == {"share": 1}
    assert mail.sent_bytes == {"share": len(envelope.encode())}
    assert mail.shared(4, {5}) == {}  # from nobody it talks to
    assert mail.take_new().keys() == {2}
    assert mail.take_new() == {}


def test_no_map_hides_another_one_of_the_same_robot():
    mail, tick = Mailbox(0), 2**40
    maps = [np.full((3, 3), UNKNOWN, np.int8) for _ in range(3)]
    for cell, found in enumerate(maps):
        found[0, cell] = FREE
    evidence = [Evidence.none(3, 3).looked(found, 1, EvidenceModel(), (2, 2)) for found in maps]
    mail.receive(Envelope(1, (0,), Share(1, tick, evidence[0])))  # a wrong tick, far ahead
    assert (mail.take_new()[1].map[0] == [FREE, UNKNOWN, UNKNOWN]).all()
    mail.receive(Envelope(1, (0,), Share(1, 6, evidence[1])))
    mail.receive(Envelope(1, (0,), Share(1, 5, evidence[2])))
    assert (mail.take_new()[1].map[0] == [UNKNOWN, FREE, FREE]).all()


# ---------------------------------------------------------------- sensors


def test_robots_can_have_driven_since_they_were_heard_as_far_as_wheels_take_them():
    sensors = Sensors(0, max_pose_age=0.5, max_scan_age=1.0)
    for robot, stamp in ((0, 1.0), (1, 9.0), (2, 5.0), (3, 4.0), (4, 10.0)):
        sensors.add_pose(Pose(stamp, robot, float(robot), -1.0, 0.0), stamp)
    discs = sensors.astray(10.0, speed=0.25, patience=5.0, reach=1.0)
    assert discs == [(1.0, -1.0, 0.25), (2.0, -1.0, 1.0)]
    assert sensors.at(10.0).keys() == {4}


# ---------------------------------------------------------------- knowledge


def test_bookkeeping_follows_the_rules():
    knowledge = Knowledge(0, 3, Frame(3, 3, 0.5))
    corner = map_cells("???\n?..\n?#.").numpy()
    assert knowledge.sense((0, 0), corner, tick=0) == 4
    assert knowledge.unshared.tolist() == [0, 4, 4]
    assert knowledge.steps_since_merge.tolist() == [0, 1_000_000, 1_000_000]
    other = map_cells("#..\n...\n...").numpy()
    assert knowledge.merge({2: Evidence.none(3, 3).looked(other, 0, MODEL, (2, 2))}, tick=1) == 5
    assert np.array_equal(knowledge.map, map_cells("...\n#..\n...").numpy())
    assert knowledge.unshared.tolist() == [0, 4, 1]  # it has been where robot 2 saw an obstacle
    assert knowledge.sense((1, 1), map_cells("...\n#..\n...").numpy(), tick=1) == 0
    assert knowledge.steps_since_merge.tolist() == [0, 1_000_000, 1]
    knowledge.pass_time()
    assert knowledge.steps_since_merge.tolist() == [0, 1_000_000, 2]


# ---------------------------------------------------------------- driving


def test_a_robot_turns_then_drives_then_stops():
    drive = Drive()
    assert drive.velocity(Pose(0, 0, 0, 0, 0), (0, 1), []) == (0, 2.0)
    assert drive.velocity(Pose(0, 0, 0, 0, math.pi), (0, 1), []) == (0, -2.0)
    assert drive.velocity(Pose(0, 0, 0, 0, math.pi / 2), (0, 1), []) == pytest.approx((0.2, 0))
    assert drive.velocity(Pose(0, 0, 0, 0.98, 0), (0, 1), []) == ZERO


def test_a_robot_ahead_is_waited_for_and_one_behind_is_not():
    drive = Drive()
    ahead, behind, far = (Pose(0, 1, x, 0, 0) for x in (0.3, -0.3, 0.4))
    assert drive.velocity(Pose(0, 0, 0, 0, 0), (1, 0), [ahead]).forward == 0
    assert drive.velocity(Pose(0, 0, 0, 0, 0), (1, 0), [behind, far]).forward == 0.2


@pytest.mark.parametrize(
    ("kind", "name", "value", "allowed"),
    [
        *((Drive, name, value, "positive finite") for name in GAINS for value in (0.0, -1.0)),
        *((Drive, name, math.nan, "a number, not NaN") for name in GAINS),
        (Drive, "clearance", -0.1, "at least 0"),
        (Drive, "clearance", math.nan, "a number, not NaN"),
        (BeamModel, "votes", 0, "integer of at least 1"),
        (BeamModel, "votes", 2.5, "an integer"),
        (BeamModel, "tolerance", 0.0, "positive finite"),
        (BeamModel, "margin", -0.01, "at least 0"),
        (BeamModel, "robot_radius", math.nan, "a number, not NaN"),
        (BeamModel, "zero_is_no_return", 1, "true or false"),
        (BeamModel, "lidar_x", math.nan, "a number, not NaN"),
        (BeamModel, "lidar_y", math.inf, "a finite number of metres"),
        (BeamModel, "lidar_yaw", -math.inf, "a finite number of radians"),
        (RobotSettings, "shut_seconds", -1.0, "at least 0 seconds"),
        (RobotSettings, "mate_patience", -1.0, "at least 0 seconds"),
        (RobotSettings, "mate_reach", math.inf, "at least 0 metres, and finite"),
        *((Drive, name, 1e300, "at most") for name in (*GAINS, "radius", "clearance", "margin")),
        *(
            (BeamModel, name, 1e300, "at most")
            for name in ("tolerance", "margin", "robot_radius", "lidar_x", "lidar_y", "lidar_yaw")
        ),
        *((JumpLimits, name, 1e300, "at most") for name in ("distance", "turn")),
        (RobotSettings, "mate_reach", 1e300, "at most 1000 metres"),
        (RobotSettings, "max_pose_age", 1e300, "at most 86400 seconds"),
        (RobotSettings, "shut_seconds", 1e300, "at most 86400 seconds"),
        (BeamModel, "lidar_x", -6.0, "at most 5 metres on either side of 0"),
    ],
)
def test_settings_that_are_none_are_refused(kind, name, value, allowed):
    with pytest.raises(
        ValueError, match=f"{name}={re.escape(str(value))} is not allowed: .*{allowed}"
    ):
        kind(**{name: value})


def test_settings_at_their_bounds_are_taken():
    assert Drive(clearance=0.0).clearance == 0
    assert BeamModel(margin=0.0, robot_radius=0.0, votes=1, lidar_x=-0.064).votes == 1


# ---------------------------------------------------------------- clocks


def test_a_period_clock_reads_the_time():
    clock = PeriodClock(2.0, start=10.0)
    assert [clock.tick(now) for now in (9, 10, 11.9, 12, 21)] == [-1, 0, 0, 1, 5]
    with pytest.raises(ValueError, match=r"period=0 .*positive"):
        PeriodClock(0)
    assert clock.begins(5) == 20.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((1e-300,), "period=1e-300 is not allowed: it must be from 0.01 to 86400 seconds"),
        ((1e9,), "period=1000000000.0 is not allowed: it must be from 0.01"),
        ((8.0, math.nan), "start=nan is not allowed: it must be at most"),
        ((8.0, math.inf), "start=inf is not allowed: it must be at most"),
    ],
)
def test_periods_and_starts_that_are_none_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        PeriodClock(*arguments)


def test_a_barrier_opens_when_all_are_through():
    clock = BarrierClock(range(2))
    assert clock.tick(0) == 0
    clock.report(0, 0, 1)
    assert clock.tick(1) == 0
    clock.report(1, 0, 2)
    assert clock.tick(2) == 1


def test_a_barrier_gives_up_the_silent_and_takes_them_back():
    clock = BarrierClock(range(2), patience=5)
    assert clock.tick(0) == 0
    clock.report(0, 0, 1)
    assert clock.tick(5) == 0
    assert clock.tick(5.1) == 1
    clock.report(0, 1, 6)
    assert clock.tick(6) == 2  # no longer waited for
    clock.report(1, 2, 7)
    clock.report(0, 2, 7)
    assert clock.tick(7) == 3
    clock.report(0, 3, 8)
    assert clock.tick(8) == 3  # waited for again


def test_a_barrier_waits_no_longer_when_the_clock_is_set_back():
    clock = BarrierClock(range(2), patience=5)
    assert clock.tick(1000) == 0
    clock.report(0, 0, 1001)
    assert [clock.tick(now) for now in (20, 25, 25.1)] == [0, 0, 1]


@pytest.mark.parametrize("robots", [[], [1, 2], [0, 2], [0, 0], [0, -1], [0.0, 1.0], [True, False]])
def test_the_robots_of_a_barrier_are_numbered_from_0(robots):
    """One that waits for a robot that there is not would wait for ever."""
    with pytest.raises(ValueError, match="robots=.* is not allowed"):
        BarrierClock(robots)


def test_a_barrier_is_for_one_size_of_team():
    BarrierClock({2, 0, 1}).check(3)
    with pytest.raises(ValueError, match="robots=2 is not allowed: the clock is for a team of 3"):
        BarrierClock(range(2)).check(3)


def test_who_comes_late_joins_the_others():
    clock = BarrierClock(range(3))
    clock.report(1, 40, 0)
    assert clock.tick(0) == 40

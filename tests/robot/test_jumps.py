"""Poses that jump: the next scan is held against the map before it is believed."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from marl_explore import ArenaConfig
from marl_explore.robot import BarrierClock, Pose, RobotCore
from marl_explore.robot.driving import Drive
from marl_explore.robot.jumps import JumpGuard, JumpLimits
from marl_explore.robot.merging import Fit
from tests.helpers.boards import arena
from tests.helpers.robot_world import PATIENT, scan_of, scripted

HERE = Pose(1.0, 0, 0.25, 0.25, 0.0)


def guard_after(*poses, **limits):
    guard = JumpGuard(JumpLimits(**limits), Drive())
    for pose in poses:
        guard.add(pose)
    return guard


def later(seconds=0.1, east=0.0, turn=0.0):
    return replace(HERE, stamp=HERE.stamp + seconds, x=HERE.x + east, yaw=HERE.yaw + turn)


@pytest.mark.parametrize(
    ("pose", "jumps"),
    [
        (later(), 0),
        (later(east=0.26), 0),  # 2 cm by its wheels, and noise
        (later(east=0.28), 1),
        (later(seconds=5.0, east=1.2), 0),  # it was not heard for 5 s
        (later(seconds=5.0, east=1.3), 1),
        (later(turn=0.6), 0),
        (later(turn=-0.8), 1),
        (later(turn=2 * math.pi), 0),
        (later(seconds=1.0, turn=math.pi), 1),
        (later(seconds=1.5, turn=math.pi), 0),
        (later(seconds=-100.0), 0),  # the clock was set back
        (later(seconds=-100.0, east=0.5), 1),
    ],
)
def test_a_jump_is_more_than_wheels_can_do(pose, jumps):
    assert guard_after(HERE, pose).jumps == jumps


def test_without_a_jump_everything_is_written_and_nothing_reported():
    guard = guard_after(HERE, later())
    assert guard.admits(later(), Fit(9, 9), tick=3)
    assert not guard.reports


def test_a_scan_that_fits_after_a_jump_is_written_and_reported():
    there = later(east=1.0)
    guard = guard_after(HERE, there)
    assert guard.admits(there, Fit(1, 9), tick=3)
    ((tick, jump, fit, written),) = guard.reports
    assert (tick, fit, written) == (3, (1, 9), True)
    assert (jump.stamp, jump.distance, jump.turn) == (there.stamp, 1.0, 0.0)
    assert guard.admits(there, Fit(9, 9), tick=4), "only the next scan is held against the map"


def test_scans_that_contradict_the_map_after_a_jump_are_not_written_until_they_fit():
    there = later(east=1.0)
    guard = guard_after(HERE, there)
    fits = [Fit(3, 9), Fit(9, 9), Fit(2, 9), Fit(1, 9), Fit(9, 9)]
    written = [guard.admits(there, fit, tick) for tick, fit in enumerate(fits)]
    assert written == [False, False, False, True, True]
    assert [(report.tick, report.written) for report in guard.reports] == [(0, False), (3, True)]
    assert str(guard.reports[0]) == (
        "the pose jumped by 1.00 m and 0 degrees; at tick 0 the scan contradicts 3 of 9 known "
        "cells and is not written into the map"
    )


def test_a_map_that_nothing_fits_is_outdated_after_a_while():
    there = later(east=1.0)
    guard = guard_after(HERE, there, patience=5)
    written = [guard.admits(there, Fit(9, 9), tick) for tick in range(10, 18)]
    assert written == [False] * 5 + [True] * 3
    assert [report.tick for report in guard.reports] == [10, 15]


def test_a_scan_of_before_the_jump_is_written():
    guard = guard_after(HERE, later(east=1.0))
    assert guard.admits(HERE, Fit(9, 9), tick=0)
    assert not guard.admits(later(east=1.0), Fit(9, 9), tick=0)


def test_another_jump_is_another_check():
    guard = guard_after(HERE, later(east=1.0))
    assert not guard.admits(later(east=1.0), Fit(9, 9), tick=0)
    guard.add(later(seconds=0.2))  # back again
    assert guard.admits(later(seconds=0.2), Fit(0, 9), tick=1)
    assert guard.jumps == 2
    assert [report.written for report in guard.reports] == [False, True]


BOARD = """
    ........
    .0.#..#.
    ..#..#..
    ........
"""


class Carried:
    """A robot that stays, in an arena that it knows around its start."""

    def __init__(self, **settings):
        self.obstacles, ((row, column),) = (part.numpy() for part in arena(BOARD))
        config = ArenaConfig(*self.obstacles.shape, 0.0, num_agents=1)
        given = replace(PATIENT, **settings)
        self.core = RobotCore(0, config, scripted([]), BarrierClock([0]), settings=given)
        self.now, self.cell = 0.0, (row, column)

    def look(self, says=None):
        """One tick, in which the robot is told that it is in another cell than it is."""
        self.now += 3
        true = Pose(self.now, 0, *self.core.frame.centre(self.cell), 0.0)
        told = Pose(self.now, 0, *self.core.frame.centre(says or self.cell), 0.0)
        self.core.advance(self.now)
        self.core.receive(told, self.now)
        self.core.receive(scan_of(self.obstacles, self.core.frame, true), self.now)
        self.core.advance(self.now)


def test_a_wrong_pose_spoils_no_map():
    robot = Carried()
    for robot.cell in ((1, 1), (0, 2), (0, 3), (0, 4)):
        robot.look()
    known, guard = robot.core.knowledge, robot.core.jumps
    before = known.map.copy()
    for _ in range(4):
        robot.look(says=(1, 1))
    assert np.array_equal(known.map, before)
    assert guard.jumps == 1
    ((_, jump, fit, written),) = guard.reports
    assert jump.distance > 1.5
    assert fit.contradictions >= 2
    assert not written
    robot.look()
    assert robot.core.tick == 9  # it did not wait
    assert [report.written for report in guard.reports] == [False, True]
    assert np.array_equal(known.map, before)


def test_a_robot_that_is_carried_to_where_it_says_goes_on_mapping():
    robot = Carried()
    robot.look()
    robot.cell = (1, 5)
    robot.look()
    assert [report.fit.contradictions for report in robot.core.jumps.reports] == [0]
    assert robot.core.knowledge.map[1, 6] == 1


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("distance", 0.0, "positive finite number of metres"),
        ("turn", math.inf, "positive finite number of radians"),
        ("share", -0.1, r"in \[0, 1\]"),
        ("patience", -1, "at least 0"),
    ],
)
def test_limits_that_are_none_are_refused(name, value, allowed):
    with pytest.raises(ValueError, match=f"{name}={value} is not allowed: .*{allowed}"):
        JumpLimits(**{name: value})


def test_a_clock_that_is_set_back_ends_no_check_of_a_jump():
    guard = JumpGuard(JumpLimits(), Drive())
    wrong, right = Fit(5, 9), Fit(0, 9)
    guard.add(Pose(1000.0, 0, 0.0, 0.0, 0.0))
    guard.add(Pose(1000.1, 0, 2.0, 0.0, 0.0))
    assert not guard.admits(Pose(1000.1, 0, 2.0, 0.0, 0.0), wrong, 1)
    guard.add(Pose(5.0, 0, 2.0, 0.0, 0.0))
    assert not guard.admits(Pose(5.0, 0, 2.0, 0.0, 0.0), wrong, 2)
    assert guard.is_checking
    assert guard.admits(Pose(5.1, 0, 2.0, 0.0, 0.0), right, 3)
    assert not guard.is_checking

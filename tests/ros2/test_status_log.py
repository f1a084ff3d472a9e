"""A status is logged once, also when it comes and goes."""

from __future__ import annotations

import numpy as np

from marl_explore import ArenaConfig
from marl_explore.robot import BarrierClock, Pose, RobotCore, Scan
from marl_explore.robot.status import Reason, Status
from marl_explore.ros2.status_log import Sightings, StatusLog
from tests.helpers.robot_world import scripted


def test_what_went_away_for_a_moment_is_not_new():
    seen = Sightings(gone=10.0)
    assert [seen.is_new("a", now) for now in (0.0, 5.0, 15.0, 25.1)] == [True, False, False, True]
    assert seen.is_new("b", 25.1)
    assert not seen.is_new("a", 3.0)  # the clock was set back
    assert not seen.is_new("a", 13.0)
    assert seen.is_new("a", 23.1)


def logged(reasons, step=0.5):
    """When reasons are logged, one every so many seconds, and how."""
    log = StatusLog(gone=10.0)
    levels = [(k, log.level(Status(reason, ""), k * step)) for k, reason in enumerate(reasons)]
    return [(k * step, level) for k, level in levels if level]


FAULT, RUNS, WAITS = Reason.NO_POSE, Reason.EXPLORING, Reason.WAITING


def test_a_fault_is_logged_at_once_and_its_end_when_it_lasts():
    assert logged([FAULT] * 9 + [RUNS] * 30) == [(0.0, "warning"), (14.5, "info")]


def test_a_fault_that_flickers_is_logged_once():
    assert logged([FAULT, RUNS, WAITS] * 40 + [RUNS] * 30) == [(0.0, "warning"), (69.0, "info")]


def test_a_fault_that_comes_back_later_is_logged_again_and_another_one_at_once():
    reasons = [FAULT] + [RUNS] * 30 + [FAULT, Reason.NO_SCAN]
    assert logged(reasons) == [
        (0.0, "warning"),
        (10.5, "info"),
        (15.5, "warning"),
        (16.0, "warning"),
    ]


def test_waiting_is_not_logged_and_a_complete_map_is_once():
    assert logged([WAITS, RUNS] * 9 + [Reason.COMPLETE, WAITS] * 50) == [(9.0, "info")]


def test_a_long_wait_is_logged_once():
    log = StatusLog(gone=10.0)
    waits = [Status(Reason.WAITING, "waiting for robot 1")] * 30
    waits += [Status(Reason.WAITING, "waiting for robot 2")] * 30
    waits += [Status(Reason.EXPLORING, "")] + [Status(Reason.WAITING, "waiting for robot 2")] * 15
    levels = [(second, log.level(status, second)) for second, status in enumerate(waits)]
    assert [(second, level) for second, level in levels if level] == [
        (11, "info"),
        (41, "info"),
        (72, "info"),
    ]


def test_a_wait_is_as_long_as_the_clock_says_after_it_was_set_back():
    log, wait = StatusLog(gone=10.0), Status(Reason.WAITING, "waiting for robot 1")
    assert [log.level(wait, now) for now in (100.0, 50.0, 55.0, 60.0)] == [None] * 4
    assert log.level(wait, 60.5) == "info"


def test_poses_that_are_a_little_too_rare_fill_no_log():
    """One every 0.6 s, with a limit of 0.5 s: the kind of status changes 200 times a minute."""
    core = RobotCore(0, ArenaConfig(6, 6, num_agents=1), scripted([]), BarrierClock([0]))
    log, changes, levels, before = StatusLog(), 0, [], None
    for turn in range(1200):
        now = 1 + turn * 0.05
        if turn % 12 == 0:
            core.receive(Pose(now, 0, 0.25, 0.25, 0.0), now)
        if turn % 4 == 0:
            core.receive(Scan(now, np.full(360, 1.0)), now)
        core.advance(now)
        changes += core.status.reason is not before
        before = core.status.reason
        levels.append(log.level(core.status, now))
    assert changes > 100
    assert [level for level in levels if level] == ["warning"]

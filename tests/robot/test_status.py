"""A robot says why it stands still."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from marl_explore import ArenaConfig
from marl_explore.robot import BarrierClock, PeriodClock, Pose, RobotCore, RobotSettings, Scan
from marl_explore.robot.planners import Nearest
from marl_explore.robot.status import Reason, named
from tests.helpers.boards import arena
from tests.helpers.robot_world import PATIENT, World, scripted

CONFIG = ArenaConfig(6, 6, num_agents=4)


def robot(config=CONFIG, **options):
    policy = options.pop("policy", scripted([2] * 9))
    return RobotCore(0, config, policy, BarrierClock(range(config.num_agents)), **options)


def told(core, now):
    core.advance(now)
    return core.status.reason, core.status.text


def a_scan(stamp):
    return Scan(stamp, np.full(360, 1.0))


def test_without_a_pose_it_says_so():
    assert told(robot(), 1.0) == (Reason.NO_POSE, "no pose has arrived yet")


def test_an_old_pose_is_named_with_its_age():
    core = robot()
    core.receive(Pose(1.0, 0, 0.0, 0.0, 0.0), 1.0)
    assert told(core, 4.2) == (Reason.NO_POSE, "its pose is 3.2 s old, over 0.5 s")


def test_a_pose_outside_the_arena_is_named():
    core = robot()
    core.receive(Pose(1.0, 0, 0.0, 9.0, 0.0), 1.0)
    assert told(core, 1.0) == (Reason.OUTSIDE, "its pose (0.00, 9.00) m is outside the arena")


def test_a_missing_and_an_old_scan_are_named():
    core = robot()
    core.receive(Pose(1.0, 0, 0.25, 0.25, 0.0), 1.0)
    assert told(core, 1.0) == (Reason.NO_SCAN, "no scan has arrived yet")
    core.receive(a_scan(1.0), 1.0)
    core.receive(Pose(4.0, 0, 0.25, 0.25, 0.0), 4.0)
    assert told(core, 4.0) == (Reason.NO_SCAN, "its scan is 3.0 s old, over 1 s")


def test_stamps_of_another_clock_are_named_for_a_while():
    core = robot()
    with pytest.raises(ValueError, match="stamp=99.0"):
        core.receive(Pose(99.0, 0, 0.0, 0.0, 0.0), 1.0)
    reason, text = told(core, 1.2)
    assert reason is Reason.OTHER_CLOCK
    assert "stamp=99.0 is not allowed: it is 1 s, and clocks may differ by 0.5 s" in text
    assert told(core, 2.0)[0] is Reason.NO_POSE


def test_stamps_that_are_late_whenever_they_arrive_are_of_another_clock():
    core = robot()
    for now in (100.0, 100.2, 100.4):
        core.receive(Pose(now - 60, 0, 0.25, 0.25, 0.0), now)
    reason, text = told(core, 100.5)
    assert reason is Reason.OTHER_CLOCK
    assert text.endswith("or a slow network: its pose arrives with a stamp 60.1 s old, over 0.5 s")
    assert told(core, 103.0) == (Reason.NO_POSE, "its pose is 62.6 s old, over 0.5 s")
    for now in (103.0, 103.2):
        core.receive(Pose(now, 0, 0.25, 0.25, 0.0), now)
        core.receive(a_scan(now - 60), now)
    assert told(core, 103.2)[0] is Reason.OTHER_CLOCK
    assert "its scan arrives with a stamp 60.0 s old, over 1 s" in told(core, 103.2)[1]


def test_after_the_clock_was_set_back_stamps_are_ahead():
    core = robot()
    core.receive(Pose(1000.0, 0, 0.25, 0.25, 0.0), 1000.0)
    ahead = "its pose is stamped 10.0 s ahead of its clock"
    assert told(core, 990.0) == (Reason.OTHER_CLOCK, ahead)


@pytest.mark.parametrize(
    ("event", "reason", "why"),
    [
        (Pose(1.0, 0, np.nan, 0.0, 0.0), Reason.NO_POSE, "its pose was refused: .*nan"),
        (Scan(1.0, np.zeros(360)), Reason.NO_SCAN, "its scan was refused: "),
    ],
)
def test_what_is_refused_is_named(event, reason, why):
    """Until something that is none arrives: one bad scan among good ones is no fault."""
    core = robot()
    if reason is Reason.NO_SCAN:
        core.receive(Pose(1.0, 0, 0.25, 0.25, 0.0), 1.0)
    with pytest.raises(ValueError, match="is not allowed"):
        core.receive(event, 1.0)
    assert told(core, 1.1)[0] is reason
    assert re.match(why, told(core, 1.1)[1])
    core.receive(Pose(1.1, 0, 0.25, 0.25, 0.0), 1.1)
    core.receive(a_scan(1.1), 1.1)
    with pytest.raises(ValueError, match="is not allowed"):
        core.receive(event, 1.1)
    assert "refused" not in told(core, 1.1)[1]


def waiting_team(dead):
    obstacles, positions = arena("......\n.0..1.\n......\n.3..2.\n......")
    config = ArenaConfig(5, 6, 0.0, num_agents=4)
    policies = [scripted([]) for _ in range(4)]
    world = World(config, obstacles.numpy(), positions.tolist(), policies, settings=PATIENT)
    world.run(1)
    world.dead |= set(dead)
    for _ in range(5):
        world.step()
    return world.cores[0]


def test_the_robots_it_waits_for_are_named():
    assert waiting_team({1, 3}).status == (Reason.WAITING, "waiting for robots 1 and 3")
    assert waiting_team({2}).status == (Reason.WAITING, "waiting for robot 2")
    assert named([3, 0, 1]) == "robots 0, 1 and 3"


def test_a_complete_map_is_named():
    obstacles, positions = arena("...\n.0.\n...")
    config = ArenaConfig(3, 3, 0.0, num_agents=1)
    settings = replace(PATIENT, stop_when_complete=True)
    policies = [Nearest(0, config)]
    world = World(config, obstacles.numpy(), positions.tolist(), policies, settings=settings)
    world.run(2)
    assert world.cores[0].status == (
        Reason.COMPLETE,
        "no frontier can be reached: the map is complete",
    )


def test_faults_are_what_somebody_should_look_after():
    core = robot()
    core.advance(1.0)
    assert core.status.is_fault
    assert not waiting_team({1}).status.is_fault


def test_counts_name_what_went_wrong():
    counts = robot().counts
    assert counts["moves given up for wheels"] == counts["merges refused"] == 0


# ------------------------------------------------- policies and poses of other teams, clocks


def test_a_policy_for_another_team_is_refused_when_the_robot_is_made(tmp_path):
    from marl_explore.robot import ExportedPolicy
    from tests.helpers.policy_file import policy_file

    policy = ExportedPolicy(policy_file(tmp_path), 0)
    with pytest.raises(ValueError, match="trained for num_agents=4, not 3"):
        robot(replace(CONFIG, num_agents=3), policy=policy)
    with pytest.raises(ValueError, match="the policy was trained for fov_radius=1"):
        robot(replace(CONFIG, sensing_range=2.0), policy=policy)


@pytest.mark.parametrize("number", [3, -1, 99])
def test_a_pose_of_a_robot_that_is_not_in_the_team_is_refused(number):
    """It used to be taken, and the next step failed."""
    core = robot(replace(CONFIG, num_agents=3))
    with pytest.raises(ValueError, match=f"a pose of robot {number} is not allowed: 0 to 2"):
        core.receive(Pose(1.0, number, 0.0, 0.0, 0.0), 1.0)
    core.receive(Pose(1.0, 0, 0.25, 0.25, 0.0), 1.0)
    core.receive(a_scan(1.0), 1.0)
    core.advance(1.0)


def test_ticks_of_a_short_period_since_1970_fit_into_messages():
    """Of 0.1 s: more than 32 bits hold."""
    config = replace(CONFIG, num_agents=2)
    clock = PeriodClock(0.1)
    core = RobotCore(0, config, scripted([]), clock, settings=RobotSettings())
    now = 1.79e9
    core.advance(now)
    for number in range(2):
        core.receive(Pose(now, number, 0.25, 0.25 + number, 0.0), now)
    core.receive(a_scan(now), now)
    (letter,) = core.advance(now).messages
    assert letter.message.tick == clock.tick(now) > 2**32
    assert letter.decode(letter.encode(), 1).message == letter.message


def test_a_clock_counts_from_the_start_of_the_experiment():
    clock = PeriodClock(8.0, start=1.79e9)
    assert [clock.tick(1.79e9 + seconds) for seconds in (-1, 0, 7.9, 8, 80)] == [-1, 0, 0, 1, 10]


def test_stamps_of_another_clock_are_forgotten_when_the_clock_is_set_back():
    core = robot(replace(CONFIG, num_agents=1), policy=scripted([]))
    with pytest.raises(ValueError, match="stamp=2000"):
        core.receive(Pose(2000.0, 0, 0.0, 0.0, 0.0), 1000.0)
    core.receive(Pose(5.0, 0, 0.25, 0.25, 0.0), 5.0)
    core.receive(a_scan(5.0), 5.0)
    assert told(core, 5.0)[0] is not Reason.OTHER_CLOCK


def test_stamps_of_another_robot_are_no_fault_of_this_one():
    core = robot()
    with pytest.raises(ValueError, match="stamp=99.0"):
        core.receive(Pose(99.0, 1, 0.0, 0.0, 0.0), 1.0)
    assert told(core, 1.0)[0] is Reason.NO_POSE
    with pytest.raises(ValueError, match="stamp=99.0"):
        core.receive(a_scan(99.0), 1.0)
    assert "its scan's stamp=99.0" in told(core, 1.0)[1]


def at_period(times, start=0.0):
    """What a robot alone says at some times, with a tick every 8 s."""
    config = replace(CONFIG, num_agents=1)
    core = RobotCore(0, config, scripted([]), PeriodClock(8.0, start))
    for now in times:
        core.receive(Pose(now, 0, 0.25, 0.25, 0.0), now)
        core.receive(a_scan(now), now)
        text = told(core, now)
    return text


def test_the_tick_that_it_waits_for_is_named_with_its_time():
    before = Reason.WAITING, "waiting for tick 0, which begins in 1000.0 s"
    assert at_period([0.0], start=1000.0) == before
    back = Reason.WAITING, "waiting for tick 451, which begins in 3608.0 s"
    assert at_period([3600.0, 0.0]) == back

"""Parameters: every field of the dataclasses can be given, and the files name no others."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from marl_explore.robot import BarrierClock, PeriodClock
from marl_explore.ros2.parameters import RobotParameters, flat, replaced
from tests.helpers.policy_file import policy_file

CONFIG = Path(__file__).parents[2] / "marl_explore" / "ros2" / "config"


def names(parameters, prefix=""):
    """Nested parameters by their full names."""
    found = {}
    for name, value in parameters.items():
        if isinstance(value, dict):
            found |= names(value, f"{prefix}{name}.")
        else:
            found[prefix + name] = value
    return found


def of_file(path):
    return names(yaml.safe_load(path.read_text())["/**"]["ros__parameters"])


def robot_of(given):
    return replaced(RobotParameters(), given)


def test_nested_fields_have_full_names():
    fields = flat(RobotParameters())
    assert fields["settings.beams.votes"] == 3
    assert fields["rate"] == 20
    assert "settings" not in fields
    robot = robot_of({"settings.drive.max_turn": 1.5, "settings.max_pose_age": 0.25})
    assert robot.settings.drive.max_turn == 1.5
    assert robot.settings.max_pose_age == 0.25
    assert robot.settings.lock_expiry == fields["settings.lock_expiry"] == 20


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"settings.drive.max_foward": 0.1},
            "'settings.drive.max_foward' is not allowed: .*max_forward",
        ),
        (
            {"settings.beams.lidar_ahead": 0.1},
            "'settings.beams.lidar_ahead' is not allowed: .*settings.beams.lidar_x",
        ),
        ({"rate": "fast"}, "rate='fast' is not allowed: it must be of type float"),
        ({"robot": 1.0}, "robot=1.0 is not allowed: it must be of type int"),
        ({"robot": True}, "robot=True is not allowed: it must be of type int"),
        ({"settings.lock_expiry": 0.0}, "lock_expiry=0.0 is not allowed"),
    ],
)
def test_names_types_and_values_are_checked(given, message):
    with pytest.raises(ValueError, match=message):
        robot_of(given)


def test_a_whole_number_will_do_for_a_float():
    assert robot_of({"rate": 5}).rate == 5


@pytest.mark.parametrize("number", range(4))
def test_every_robot_has_a_file_that_fits(number):
    robot = robot_of(of_file(CONFIG / f"robot_{number}.yaml"))
    assert robot.robot == number
    assert robot.team == RobotParameters().team


def test_a_robot_is_made_of_its_parameters(tmp_path):
    path = policy_file(tmp_path, robots=2)
    robot = robot_of({"policy": str(path), "team": ["a", "b"], "robot": 1, "patience": 9.0})
    core = robot.make_core()
    assert (core.robot, core.config.num_agents, core.fpr) == (1, 2, "proximity")
    assert isinstance(core.clock, BarrierClock)
    assert core.clock.patience == 9
    timed = robot_of({"policy": str(path), "team": ["a", "b"], "period": 8.0})
    assert isinstance(timed.make_core().clock, PeriodClock)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"policy": "none.npz"}, "policy='none.npz' is not allowed"),
        ({"team": ["a"]}, r"team=\['a'\] is not allowed: the policy is for 2 robots"),
        ({"team": ["a", "b"], "robot": 2}, "robot=2 is not allowed"),
        ({"team": ["a", "b"], "rate": 0.0}, "rate=0.0 is not allowed"),
        ({"team": ["a", "b"], "rate": 1e9}, "rate=1000000000.0 is not allowed: .* at most 1000"),
        ({"team": ["a", "b"], "robot": -1}, "robot=-1 is not allowed: it must be an integer of"),
        ({"team": ["a", "b"], "seed": -1}, "seed=-1 is not allowed: it must be an integer of"),
        ({"team": []}, r"team=\[\] is not allowed: namespaces of 1 to 16 robots"),
        ({"team": [f"r{n}" for n in range(17)]}, "team=.* is not allowed: namespaces of 1 to 16"),
        ({"team": ["a", "a"]}, "team=.* is not allowed: a robot is in it twice"),
        ({"team": ["/a", "/b"]}, "team=.* is not allowed: '/a' is no namespace"),
        ({"team": ["a b", "c"]}, "team=.* is not allowed: 'a b' is no namespace"),
        ({"team": ["a", ""]}, "team=.* is not allowed: '' is no namespace"),
        ({"team": ["a", "b"], "frame": ""}, "frame='' is not allowed"),
        ({"team": ["a", "b"], "base_frame": "/"}, "base_frame='/' is not allowed"),
        ({"team": ["a", "b"], "period": -1.0}, "period=-1.0 is not allowed"),
        ({"team": ["a", "b"], "period": 8.0, "start": 1e300}, r"start=1e\+300 is not allowed"),
    ],
)
def test_parameters_that_cannot_work_are_refused(tmp_path, given, message):
    given = {"policy": str(policy_file(tmp_path, robots=2))} | given
    with pytest.raises(ValueError, match=message):
        robot_of(given).make_core()


def test_frames_lose_the_slash_that_tf_has_no_more():
    robot = robot_of({"frame": "/arena", "base_frame": "/robot_0/base_link"})
    assert (robot.frame, robot.base_frame) == ("arena", "robot_0/base_link")


def test_a_planner_runs_in_a_team_of_sixteen():
    team = [f"robot_{number}" for number in range(16)]
    core = robot_of({"policy": "goal-utility", "team": team, "robot": 15}).make_core()
    assert (core.robot, core.config.num_agents) == (15, 16)

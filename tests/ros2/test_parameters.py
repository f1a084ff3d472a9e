"""Parameters: every field of the dataclasses can be given, and the files name no others."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from marl_explore.robot import BarrierClock, PeriodClock
from marl_explore.ros2.parameters import RobotParameters, declared
from tests.robot.policy_file import policy_file

CONFIG = Path(__file__).parents[2] / "marl_explore" / "ros2" / "config"


def flat(parameters, prefix=""):
    """Nested parameters by their full names."""
    names = {}
    for name, value in parameters.items():
        if isinstance(value, dict):
            names |= flat(value, f"{prefix}{name}.")
        else:
            names[prefix + name] = value
    return names


def of_file(path):
    return flat(yaml.safe_load(path.read_text())["/**"]["ros__parameters"])


def robot_of(given):
    """The parameters of a robot, and all names that were declared."""
    defaults = {}

    def declare(name, default):
        defaults[name] = default
        return given.get(name, default)

    return declared(declare, RobotParameters()), defaults


def test_nested_fields_are_declared_by_their_full_names():
    robot, defaults = robot_of({"settings.drive.max_turn": 1.5, "settings.max_pose_age": 0.25})
    assert robot.settings.drive.max_turn == 1.5
    assert robot.settings.max_pose_age == 0.25
    assert robot.settings.lock_expiry == defaults["settings.lock_expiry"] == 20
    assert defaults["settings.beams.votes"] == 3


@pytest.mark.parametrize("number", range(4))
def test_every_robot_has_a_file_that_fits(number):
    given = of_file(CONFIG / f"robot_{number}.yaml")
    robot, defaults = robot_of(given)
    assert given.keys() <= defaults.keys()
    assert {name: type(value) for name, value in given.items()} == {
        name: type(defaults[name]) for name in given
    }
    assert robot.robot == number
    assert robot.team == RobotParameters().team


def test_a_robot_is_made_of_its_parameters(tmp_path):
    path = policy_file(tmp_path, robots=2)
    robot, _ = robot_of({"policy": str(path), "team": ["a", "b"], "robot": 1, "patience": 9.0})
    core = robot.make_core()
    assert (core.robot, core.config.num_agents, core.fpr) == (1, 2, "proximity")
    assert isinstance(core.clock, BarrierClock)
    assert core.clock.patience == 9
    timed, _ = robot_of({"policy": str(path), "team": ["a", "b"], "period": 8.0})
    assert isinstance(timed.make_core().clock, PeriodClock)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"policy": "none.npz"}, "policy='none.npz' is not allowed"),
        ({"team": ["a"]}, r"team=\['a'\] is not allowed: the policy is of 2 robots"),
        ({"team": ["a", "b"], "robot": 2}, "robot=2 is not allowed"),
        ({"team": ["a", "b"], "rate": 0.0}, "rate=0.0 is not allowed"),
    ],
)
def test_parameters_that_cannot_work_are_refused(tmp_path, given, message):
    given = {"policy": str(policy_file(tmp_path, robots=2))} | given
    with pytest.raises(ValueError, match=message):
        robot_of(given)[0].make_core()

"""Namespaces: the team's may stand under another one."""

from __future__ import annotations

import pytest

from marl_explore.ros2.names import own_name, team_root

TEAM = ["robot_1", "robot_2", "fleet/robot_1"]


@pytest.mark.parametrize(
    ("namespace", "name", "root"),
    [
        ("/robot_2", "robot_2", "/"),
        ("/fleet/robot_2", "robot_2", "/fleet/"),
        ("/a/b/robot_2", "robot_2", "/a/b/"),
        ("/fleet/robot_1", "fleet/robot_1", "/"),
        ("/my_robot_2", "my_robot_2", "/"),
        ("/", "", "/"),
    ],
)
def test_a_robot_is_found_in_its_team_and_its_mates_beside_it(namespace, name, root):
    assert own_name(namespace, TEAM) == name
    assert team_root(namespace, name or "robot_1") == root


def test_a_node_that_runs_elsewhere_speaks_for_its_robot():
    assert team_root("/", "robot_2") == team_root("/base_station", "robot_2") == "/"

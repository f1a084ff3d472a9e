"""Planners drive the robots of the lab: those on board, and all others in torch."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from marl_explore import PLANNERS, ArenaConfig, ExplorationEnv, load_policy
from marl_explore.cli import lab as command
from marl_explore.lab import LabRunner, planner_policies
from marl_explore.lab.planner_policy import PlannerPolicy
from marl_explore.policies.export import robot_observation

ROBOTS = [name for name in PLANNERS if name not in ("central", "clairvoyant")]


def free_to_move(now):
    """The same situation with every action allowed: then the yield rule draws nothing."""
    agents = now["agents"].clone()
    agents["action_mask"] = torch.ones_like(agents["action_mask"])
    agents["dangerous"] = torch.zeros_like(agents["dangerous"])
    return now.clone().set("agents", agents)


@pytest.mark.parametrize("name", [name for name in ROBOTS if name != "random"])
def test_every_robot_decides_as_in_its_team(name):
    config = ArenaConfig()
    env = ExplorationEnv(config, seed=1)
    torch.manual_seed(0)
    planner = PLANNERS[name](config)
    team = [PlannerPolicy(PLANNERS[name](config), robot, 0) for robot in range(4)]
    now = env.reset()
    for _ in range(25):
        situation = free_to_move(now)
        expected = planner(situation.clone())["agents", "action"]
        seen = [robot_observation(situation, 0, robot) for robot in range(4)]
        assert [decide(own) for decide, own in zip(team, seen, strict=True)] == expected[0].tolist()
        mask = now["agents", "action_mask"]
        allowed = mask.gather(-1, expected.unsqueeze(-1)).squeeze(-1)
        drawn = torch.multinomial(mask.flatten(0, 1).float(), 1).view_as(expected)
        action = torch.where(allowed, expected, drawn)
        now = env.step(now.set(("agents", "action"), action))["next"].exclude("reward")


def test_random_choices_repeat_themselves_and_leave_torch_alone():
    seen = robot_observation(ExplorationEnv(ArenaConfig()).reset(), 0, 0)
    make = planner_policies("random", ArenaConfig(), seed=3)
    torch.manual_seed(1)
    expected = torch.rand(())
    torch.manual_seed(1)
    draws = [[decide(seen) for _ in range(12)] for decide in (make(0, 0), make(0, 0), make(1, 0))]
    assert torch.rand(()) == expected
    assert draws[0] == draws[1] != draws[2]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("central", "planner='central' is not allowed: it uses what no robot knows"),
        ("best-of-all", "planner='best-of-all' is not one of random, nearest"),
    ],
)
def test_references_and_unknown_names_are_refused(name, message):
    with pytest.raises(ValueError, match=message):
        planner_policies(name, ArenaConfig())


@pytest.mark.parametrize("name", ["goal-utility", "rendezvous"])
def test_a_team_of_planners_explores_the_lab(name):
    config = replace(ArenaConfig(), height=8, width=8, num_agents=3)
    start = ExplorationEnv(config, seed=2).reset()
    arenas = start["obstacles"], start["agents", "position"]
    lab = LabRunner(planner_policies(name, config), arenas, config=config)
    found = lab.run(25)
    assert found.wrong_cells() == 0
    assert found.coverage()["merged"][0, -1] == 1


def test_the_bundled_policy_of_any_team_explores_the_lab():
    config = replace(ArenaConfig(), height=8, width=8, num_agents=3)
    start = ExplorationEnv(config, seed=2).reset()
    arenas = start["obstacles"], start["agents", "position"]
    found = LabRunner(load_policy("best"), arenas, config=config).run(25)
    assert found.wrong_cells() == 0
    assert found.coverage()["merged"][0, -1] == 1


def test_the_command_takes_a_planner(tmp_path):
    command.run(
        command.parse(
            ["nearest-timer", "--layouts", "1", "--steps", "3", "--out", str(tmp_path / "lab")]
        )
    )
    told = json.loads((tmp_path / "lab" / "lab.json").read_text())
    assert told["run"]["settings"]["policy"] == "nearest-timer"
    assert np.isfinite(told["mean coverage"]["best"]).all()

"""Planners on a robot plan as those of ``marl_explore.planners`` do, over whole episodes."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from marl_explore import PLANNERS, ArenaConfig, Caves, ExplorationEnv, Mazes, Rooms
from marl_explore.config.constants import COMMUNICATE, STAY
from marl_explore.core import native
from marl_explore.policies.export import robot_observation
from marl_explore.robot import planners
from marl_explore.robot.planners import frontiers
from tests.robot.test_goal_policy import observations

ARENAS = {
    "uniform": lambda robots: (ArenaConfig(num_agents=robots), "uniform"),
    "rooms": lambda robots: _of(Rooms, robots),
    "maze": lambda robots: _of(Mazes, robots),
    "cave": lambda robots: _of(Caves, robots),
}


def _of(kind, robots):
    config = ArenaConfig(20, 20, num_agents=robots)
    return config, kind(config)


@pytest.fixture(params=["kernel", "numpy"])
def backend(request, monkeypatch):
    if request.param == "numpy":
        monkeypatch.setattr(native, "missing", lambda name="frontier": "no compiler")
    elif native.missing():
        pytest.skip("the kernel was not built")


def plans(planner, env, now):
    """The wanted actions of ``Planner.plan`` with its communication rule, int64 [N]."""
    wanted = planner.plan(now.clone())
    return wanted.masked_fill(planner.communicate(now), COMMUNICATE)[0]


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("name", planners.PLANNERS)
@pytest.mark.parametrize("arenas", ARENAS)
@pytest.mark.parametrize("robots", [1, 4, 9, 16])
def test_wanted_actions_are_those_in_torch(name, arenas, robots):
    config, kind = ARENAS[arenas](robots)
    env = ExplorationEnv(config, arenas=kind, seed=3)
    team = [planners.PLANNERS[name](robot, config, 0) for robot in range(robots)]
    planner = PLANNERS[name](config)
    torch.manual_seed(0)
    now, communicated = env.reset(), 0
    for _ in range(40):
        expected = plans(planner, env, now)
        for robot, mine in enumerate(team):
            observed = robot_observation(now, 0, robot)
            # with nothing to give way to, the action is the plan
            free = observed._replace(refused=False, action_mask=np.ones(10, bool))
            assert mine(free) == expected[robot], robot
        mask = now["agents", "action_mask"][0]
        allowed = mask.gather(-1, expected.unsqueeze(-1)).squeeze(-1)
        action = torch.where(allowed, expected, torch.multinomial(mask.float(), 1).squeeze(-1))
        communicated += int((action == COMMUNICATE).sum())
        now = env.step(now.set(("agents", "action"), action[None]))["next"].exclude("reward")
    assert communicated > 0 or robots == 1


@pytest.mark.parametrize("name", planners.PLANNERS)
def test_a_robot_gives_way(name):
    """After a refused move it makes a random allowed move, or stays."""
    start = observations(2)[0]
    planner = planners.PLANNERS[name](0, ArenaConfig(num_agents=2), 5)
    alone = start._replace(mates={}, refused=True)
    found = {planner(alone) for _ in range(60)}
    assert found == set(start.action_mask[: STAY + 1].nonzero()[0].tolist())


@pytest.mark.parametrize("name", planners.PLANNERS)
def test_a_seed_repeats_itself(name):
    start = observations(2)[0]._replace(mates={}, refused=True)
    planner = planners.PLANNERS[name](0, ArenaConfig(num_agents=2), 5)
    first, second = (planner.with_seed([7, 0]) for _ in range(2))
    assert [first(start) for _ in range(9)] == [second(start) for _ in range(9)]


@pytest.mark.parametrize("name", planners.PLANNERS)
def test_with_everything_known_it_stays(name):
    start = observations(1)[0]
    done = start._replace(map=np.zeros_like(start.map), mates={})
    assert not frontiers(done).any()
    assert planners.PLANNERS[name](0, ArenaConfig(num_agents=1), 0)(done) == STAY


def test_names_are_those_of_the_planners_in_torch():
    assert planners.PLANNERS.keys() <= PLANNERS.keys()

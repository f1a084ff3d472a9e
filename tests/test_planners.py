"""Planners: what they choose on drawn boards, and what they reach on arenas."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from marl_explore import ArenaConfig, ExplorationEnv
from marl_explore.core.grid import COMMUNICATE, STAY
from marl_explore.evaluation import evaluate, find_policy
from marl_explore.planners import PLANNERS, NearestFrontier, PairTimer, never
from tests import reference
from tests.boards import arena


def on_board(board, height, width, **settings):
    """An env of one drawn arena, and its first observation."""
    obstacles, position = arena(board)
    config = ArenaConfig(height=height, width=width, num_agents=len(position), **settings)
    env = ExplorationEnv(config, num_envs=1)
    start = TensorDict({"obstacles": obstacles.unsqueeze(0)}, [1])
    start.set(("agents", "position"), position.unsqueeze(0))
    return env, env.reset(start, set_state=True)


@pytest.mark.parametrize("name", sorted(PLANNERS))
def test_planners_take_allowed_actions_only(name):
    config = ArenaConfig(num_agents=5, height=8, width=8)
    td = ExplorationEnv(config, num_envs=32).rollout(40, PLANNERS[name](config))
    allowed = td["agents", "action_mask"].gather(-1, td["agents", "action"].unsqueeze(-1))
    assert allowed.all()


def test_the_random_walk_is_uniform_over_allowed_actions():
    _, td = on_board("0...\n....\n...1", 3, 4)
    td = td.expand(6000).clone()
    action = PLANNERS["random"](ArenaConfig())(td)["agents", "action"]
    for robot in range(2):
        mask = td["agents", "action_mask"][0, robot]
        share = torch.bincount(action[:, robot], minlength=10) / 6000
        torch.testing.assert_close(share, mask / mask.sum(), atol=0.03, rtol=0)


def test_nearest_frontier_goes_the_reference_way():
    config = ArenaConfig(num_agents=2)
    planner = NearestFrontier(never)
    td = ExplorationEnv(config, num_envs=20).rollout(20)
    plan = planner.plan(td)
    for wanted, grid, position in zip(
        plan.flatten().tolist(),
        td["agents", "map"].flatten(0, 2).tolist(),
        td["agents", "position"].flatten(0, 2).tolist(),
        strict=True,
    ):
        paths = reference.trajectories(grid, position)
        if paths:
            _, direction = min((length, first) for first, length in paths)
            assert wanted == direction
        else:
            assert wanted == STAY


def test_a_robot_whose_move_was_refused_yields_with_a_random_move():
    _, td = on_board("0.......\n........\n.......1", 3, 8)
    td = td.expand(300).clone()
    td["agents", "dangerous"] = torch.tensor([True, False]).expand(300, 2)
    action = NearestFrontier(never)(td)["agents", "action"]
    assert set(action[:, 0].tolist()) == {2, 3, 4}  # all open moves from the corner: E, SE, S
    assert len(set(action[:, 1].tolist())) == 1


def test_a_robot_that_is_shut_in_stays():
    _, td = on_board("0#.\n##.\n...", 3, 3)
    assert NearestFrontier(never)(td)["agents", "action"].tolist() == [[STAY]]


def test_the_pair_timer_talks_to_strangers_and_then_waits():
    env, td = on_board("0.1.....", 1, 8, communication_range=1.0)
    rule = PairTimer(3, env.config.communication_cells)
    assert rule(td).all()
    said = []
    for _ in range(8):
        communicating = rule(td)
        said.append(bool(communicating.all()))
        action = torch.where(communicating, COMMUNICATE, STAY)
        td = env.step(td.set(("agents", "action"), action))["next"]
    assert said == [True, False, False, False, True, False, False, False]


def test_the_pair_timer_does_not_talk_out_of_range():
    env, td = on_board("0...1", 1, 5, communication_range=1.0)
    assert not PairTimer(3, env.config.communication_cells)(td).any()


def test_planners_explore_as_well_as_they_should():
    """Bounds with slack around what prototypes measured: 236, 66 and 39 steps on 200 arenas."""
    config = ArenaConfig()
    steps = {
        name: evaluate(find_policy(name, config), config, num_arenas=60)["steps_to_100"]
        for name in PLANNERS
    }
    assert 200 < steps["random"] < 300
    assert 55 < steps["nearest"] < 75
    assert 30 < steps["nearest-timer"] < 45

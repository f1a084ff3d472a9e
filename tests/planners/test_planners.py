"""Planners: what they choose on drawn boards, and what they reach on arenas."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import step_mdp

from marl_explore import ArenaConfig, ExplorationEnv
from marl_explore.core.grid import STAY
from marl_explore.evaluation.episodes import watch
from marl_explore.evaluation.registry import find_policy
from marl_explore.evaluation.results import evaluate
from marl_explore.planners import PLANNERS, NearestFrontier, never
from tests.helpers import oracle
from tests.helpers.boards import arena
from tests.helpers.situations import beyond_robot_0, on_board


@pytest.mark.parametrize("name", sorted(PLANNERS))
def test_planners_take_allowed_actions_only(name):
    config = ArenaConfig(num_agents=5, height=8, width=8)
    td = ExplorationEnv(config, num_envs=8).rollout(20, PLANNERS[name](config))
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
        paths = oracle.trajectories(grid, position)
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
    # all open moves from the corner, E, SE and S, and waiting
    assert set(action[:, 0].tolist()) == {2, 3, 4, STAY}
    assert len(set(action[:, 1].tolist())) == 1


def test_a_robot_that_is_shut_in_stays():
    _, td = on_board("0#.\n##.\n...", 3, 3)
    assert NearestFrontier(never)(td)["agents", "action"].tolist() == [[STAY]]


NARROW = {
    "a dead end": """
        #####
        #0..#
        #1###
        #####""",
    "a corridor of one cell": """
        ########
        #...01.#
        ####23.#
        ########""",
}


@pytest.mark.parametrize("board", NARROW)
@pytest.mark.parametrize(
    "name",
    [
        "nearest-timer",
        "fpr-greedy",
        "utility-cost",
        "sequential",
        "hungarian",
        "hedac",
        "rendezvous",
        "goal-utility",
    ],
)
def test_robots_in_narrow_places_get_past_each_other(name, board):
    """One of two robots has to wait until the other has left the only way."""
    assert (steps_to_complete(name, "\n".join(NARROW[board].split()), 16) <= 300).all()


def steps_to_complete(name, board, runs):
    """Steps until some robot's map is complete, int64 [runs]."""
    obstacles, position = arena(board)
    height, width = obstacles.shape
    config = ArenaConfig(height=height, width=width, num_agents=len(position))
    env = ExplorationEnv(config, num_envs=runs, max_steps=301, terminate_at_coverage=1.0)
    start = {"obstacles": obstacles, "agents": {"position": position}}
    start = TensorDict(start).expand(runs).clone()
    observed = env.reset(start, set_state=True)
    policy, needed = find_policy(name, config), torch.full((runs,), 301)
    torch.manual_seed(0)
    for step in range(1, 301):
        observed = step_mdp(env.step(policy(observed)))
        complete = observed["terminated"].squeeze(-1)
        needed = torch.where(complete, needed.clamp_max(step), needed)
        if complete.all():
            break
    return needed


def test_planners_explore_as_well_as_they_should():
    """Bounds with slack around docs/planners.md."""
    config = ArenaConfig()
    bounds = {
        "random": (200, 300),
        "nearest": (55, 75),
        "nearest-timer": (30, 45),
        "fpr-greedy": (28, 42),
        "utility-cost": (24, 33),
        "sequential": (23, 32),
        "hungarian": (27, 38),
        "hedac": (23, 33),
    }
    for name, (low, high) in bounds.items():
        steps = evaluate(find_policy(name, config), config, num_arenas=60)["steps_to_100"]
        assert low < steps < high, name


def test_joint_planning_explores_as_well_as_it_should():
    config = ArenaConfig()
    options = {"num_arenas": 12, "steps": 30}
    own = evaluate(find_policy("rendezvous", config), config, **options)
    shared = evaluate(find_policy("central", config), config, **options)
    clairvoyant = evaluate(find_policy("clairvoyant", config), config, **options)
    assert own["steps_to_100"] < 24
    # few obstacles: to know them beforehand hardly helps
    assert max(clairvoyant["steps_to_100"], shared["steps_to_100"]) < 16.5
    assert shared["merged_steps_to_100"] == shared["steps_to_100"]
    assert shared["communication_share"] == 0


def test_a_reference_is_watched_by_the_union_of_its_maps():
    steps = watch(find_policy("central", ArenaConfig()), ArenaConfig(), steps=40)
    assert 10 < len(steps) < 25
    maps = steps[-1]["agents", "map"]
    assert (maps == maps[:, :1]).all()
    assert (steps[-2]["agents", "map"] != maps).any()


@pytest.mark.parametrize("name", sorted(PLANNERS))
def test_batches_of_any_shape_are_planned_alike(name):
    config = ArenaConfig(num_agents=3, height=8, width=9)
    history = ExplorationEnv(config, num_envs=4, stream="test").rollout(6)
    flat, square, single = (PLANNERS[name](config) for _ in range(3))
    for step in history.unbind(1):
        torch.manual_seed(1)
        action = flat(step.clone())["agents", "action"]
        torch.manual_seed(1)
        assert square(step.reshape(2, 2))["agents", "action"].equal(action.view(2, 2, 3))
        assert single(step[0])["agents", "action"].shape == (3,)


BLIND = [
    name for name in PLANNERS if not getattr(PLANNERS[name](ArenaConfig()), "reference", False)
]


WORLDS = {
    "the paper's": {},
    "a wide one": {
        "sensing_range": (1.5, 2.0, 2.0),
        "sensing_shape": "disc",
        "line_of_sight": True,
        "communication_range": 2.5,
        "wall_loss_db": 6.0,
        "message_loss": 0.5,
        "failure_rate": 0.03,
        "num_walkers": 4,
        "move_period": (1, 2, 1),
        "obstacle_density": 0.2,
    },
}


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("name", BLIND)
def test_a_robot_decides_by_what_it_can_know(name, world):
    """The truth, others' maps and memories, and where unlinked robots are, change nothing."""
    config = ArenaConfig(num_agents=3, **WORLDS[world])
    history = ExplorationEnv(config, num_envs=8, stream="test").rollout(
        13, break_when_any_done=False
    )
    planner, ignorant = (PLANNERS[name](config) for _ in range(2))
    moved = 0
    for step in history.unbind(1):
        torch.manual_seed(1)
        action = planner(step.clone())["agents", "action"][:, 0]
        changed, hidden = beyond_robot_0(step)
        moved += hidden
        torch.manual_seed(1)
        assert ignorant(changed)["agents", "action"][:, 0].equal(action), name
    assert moved > 0

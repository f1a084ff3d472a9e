"""Policies that do what is likeliest: they yield after a refusal, and so get past each other."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.envs import ExplorationType, set_exploration_type

from marl_explore import ArenaConfig, ExplorationEnv
from marl_explore.config import goals
from marl_explore.config.constants import COMPASS, GOAL_COLUMNS, MAX_FRONTIERS
from marl_explore.evaluation.registry import find_policy
from marl_explore.planners import goal_moves
from marl_explore.planners.goal_moves import keep_goal
from marl_explore.policies.argmax import ArgmaxPolicy
from marl_explore.policies.export import export_npz, robot_observation
from marl_explore.policies.io import load_policy, save_policy
from marl_explore.policies.networks import MLP
from marl_explore.policies.policy import Policy, PolicyConfig
from marl_explore.robot import ExportedPolicy, goal_actor
from marl_explore.robot import candidates as robot_candidates
from marl_explore.transforms.goals import Candidates
from tests.helpers.boards import ACTIONS, arena
from tests.policies.test_policies import a_policy


class Always(nn.Module):
    """An actor that prefers one action, whatever it sees."""

    inputs = ("fov", "fpr", "net")

    def __init__(self, name):
        super().__init__()
        self.action = ACTIONS.index(name)
        self.weight = nn.Parameter(torch.zeros(1))

    def forward(self, fov, fpr, net):
        logits = torch.zeros(*net.shape[:-1], 10)
        logits[..., self.action] = 1
        return logits


def two_robots(board, *names, **world):
    """An environment that starts from a drawn arena, and robots with these wishes."""
    obstacles, positions = arena(board)
    config = ArenaConfig(*obstacles.shape, num_agents=len(names), obstacle_density=0.0, **world)
    env = ExplorationEnv(config)
    td = TensorDict({"obstacles": obstacles[None], "agents": {"position": positions[None]}}, [1])
    spec = PolicyConfig(config, MLP(hidden=(8,)))
    return env, env.reset(td, set_state=True), Policy(spec, [Always(name) for name in names])


BOARD = ".....\n.0.1.\n....."


def test_a_contested_cell_blocks_the_policy_alone_for_ever():
    torch.manual_seed(0)
    env, start, policy = two_robots(BOARD, "E", "W")
    td = start
    for _ in range(10):
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            td = env.step(policy(td))["next"]
        assert td["agents", "dangerous"].all()


@pytest.mark.parametrize("period", [1, 2, 3])
def test_after_a_refusal_a_robot_gives_way(period):
    torch.manual_seed(0)
    env, td, policy = two_robots(BOARD, "E", "W", move_period=period)
    careful = ArgmaxPolicy(policy, patience=1000)
    first = careful(td.clone())["agents", "action"]
    assert first.tolist() == [[ACTIONS.index("E"), ACTIONS.index("W")]]
    places = set()
    for _ in range(10 * period):
        td = env.step(careful(td))["next"]
        places.add(tuple(td["agents", "position"].flatten().tolist()))
    assert len(places) > 3


class ToAndFro(nn.Module):
    """An actor that prefers east where it sees the arena's border in the west, else west."""

    inputs = ("fov", "fpr", "net")

    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(1))

    def forward(self, fov, fpr, net):
        logits = torch.zeros(*net.shape[:-1], 10)
        west = fov[..., 1, 0] > 0
        logits[..., ACTIONS.index("E")] = west.float()
        logits[..., ACTIONS.index("W")] = (~west).float()
        return logits


def test_a_robot_that_goes_in_circles_draws_its_actions():
    torch.manual_seed(0)
    env, start, _ = two_robots(".....0\n......\n......\n......", "E")
    policy = Policy(PolicyConfig(env.config, MLP(hidden=(8,))), [ToAndFro()])
    for patience, rows in ((4, {0, 1, 2, 3}), (100, {0})):
        likeliest, seen, td = ArgmaxPolicy(policy, patience), set(), start.clone()
        env.reset(start.clone(), set_state=True)
        for _ in range(60):
            td = env.step(likeliest(td))["next"]
            seen.add(td["agents", "position"][0, 0, 0].item())
        assert seen == rows


def test_patience_begins_anew_with_every_episode():
    torch.manual_seed(0)
    env, start, policy = two_robots("0.....", "stay")
    likeliest = ArgmaxPolicy(policy, patience=5)
    for _ in range(3):
        td = env.reset(start.clone(), set_state=True)
        for _ in range(6):
            td = env.step(likeliest(td))["next"]
            assert td["agents", "position"].tolist() == [[[0, 0]]]


def test_likeliest_actions_of_a_saved_policy_by_name(tmp_path):
    policy = a_policy()
    path = save_policy(policy, tmp_path / "team.safetensors")
    found = find_policy(f"{path}:argmax", ArenaConfig())
    td = ExplorationEnv(num_envs=30).reset()
    one, two = (found(td.clone())["agents", "action"] for _ in range(2))
    assert torch.equal(one, two)
    drawn = find_policy(str(path), ArenaConfig())(td.clone())["agents", "action"]
    assert not torch.equal(one, drawn)


def steps_to_the_end(act):
    """In an arena where the likeliest goals of two robots change with every step; at most 120."""
    env = ExplorationEnv(
        ArenaConfig(num_agents=2),
        seed=3,
        stream="test",
        first_arena=58,
        max_steps=120,
        terminate_at_coverage=1.0,
    )
    td = env.reset()
    for step in range(1, 121):
        td = env.step(act(td))["next"]
        if td["done"].all():
            return step
    raise AssertionError("an episode ends after 120 steps")


def test_two_robots_do_not_turn_back_and_forth_for_each_other(monkeypatch):
    """Each of two rules is enough: to keep the last goal, and not to turn back again."""
    torch.manual_seed(0)
    policy = load_policy("best")
    assert steps_to_the_end(ArgmaxPolicy(policy, patience=1000)) < 110
    monkeypatch.setattr(goal_moves, "PATIENCE", 1000)
    assert steps_to_the_end(ArgmaxPolicy(policy)) < 110
    assert steps_to_the_end(ArgmaxPolicy(policy, patience=1000)) == 120


def test_two_robots_with_numpy_alone_do_not_either(tmp_path):
    path = export_npz(load_policy("best"), tmp_path / "policy.npz")
    robots = [ExportedPolicy(path, robot, sample=False) for robot in range(2)]

    def act(td):
        actions = [robots[robot](robot_observation(td, 0, robot)) for robot in range(2)]
        return td.set(("agents", "action"), torch.tensor([actions]))

    assert steps_to_the_end(act) < 110


def test_who_goes_to_and_fro_turns_back_after_long_without_growth():
    """Against a loop, in torch and in numpy."""
    stalled, heading, move = torch.meshgrid(
        torch.tensor([0, goals.PATIENCE, goals.PATIENCE + 1, 300]),
        torch.arange(-1, 8),
        torch.arange(10),
        indexing="ij",
    )
    memory = TensorDict({"agents": {"memory": {"stalled": stalled, "heading": heading}}})
    found = goal_moves.goes_to_and_fro(memory, move)
    chooser = goal_actor.GoalChooser(0, ArenaConfig().sight)
    for steps, last, wanted, answer in zip(
        *(entry.flatten().tolist() for entry in (stalled, heading, move, found)), strict=True
    ):
        back = last >= 0 and wanted < 8 and COMPASS[wanted] == tuple(-x for x in COMPASS[last])
        assert answer == (back and steps > goals.PATIENCE)
        chooser._episode = SimpleNamespace(memory=SimpleNamespace(stalled=steps, heading=last))
        assert chooser.goes_to_and_fro(wanted) == answer
    assert found.sum() == 2 * 8


def test_the_goal_that_is_kept_is_the_nearest_to_the_last_one():
    """Against a loop, in torch and in numpy."""
    random = np.random.default_rng(0)
    robots, away, moves = 3, GOAL_COLUMNS.index("from_last_goal"), GOAL_COLUMNS.index("moves")
    frontiers = np.zeros((200, MAX_FRONTIERS, len(GOAL_COLUMNS)), np.int32)
    for table in frontiers:
        number = random.integers(0, MAX_FRONTIERS + 1)
        table[:number, moves] = random.integers(1, 9, number)
        table[:number, away] = random.integers(0, 6, number) if random.random() < 0.7 else -1
    choice = random.integers(0, MAX_FRONTIERS + robots + 2, len(frontiers))
    stalled = random.random(len(frontiers)) < 0.8
    mates = np.zeros((len(frontiers), robots, 9), np.int32)
    tables = (
        torch.from_numpy(frontiers),
        torch.tensor(0),
        torch.from_numpy(mates),
        torch.tensor(0),
    )
    kept = keep_goal(Candidates(*tables), torch.from_numpy(choice), torch.from_numpy(stalled))
    for row, (table, old) in enumerate(zip(frontiers, choice.tolist(), strict=True)):
        near = [(d, i) for i, d in enumerate(table[:, away]) if table[i, moves] > 0 and d >= 0]
        keeps = near and old != MAX_FRONTIERS + robots
        expected = min(near)[1] if keeps else old
        assert kept[row] == (expected if stalled[row] else old)
        found = robot_candidates.Candidates(table, None, mates[row], None)
        assert goal_actor.keep_goal(found, old) == expected
    assert (kept != torch.from_numpy(choice)).sum() > 50

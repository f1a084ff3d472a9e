"""Policies that do what is likeliest: they yield after a refusal, and so get past each other."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import nn
from torchrl.envs import ExplorationType, set_exploration_type

from marl_explore import ArenaConfig, ExplorationEnv
from marl_explore.evaluation.registry import find_policy
from marl_explore.policies.argmax import ArgmaxPolicy
from marl_explore.policies.io import save_policy
from marl_explore.policies.networks import MLP
from marl_explore.policies.policy import Policy, PolicyConfig
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


def two_robots(board, *names):
    """An environment that starts from a drawn arena, and robots with these wishes."""
    obstacles, positions = arena(board)
    config = ArenaConfig(*obstacles.shape, num_agents=len(names), obstacle_density=0.0)
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


def test_after_a_refusal_a_robot_gives_way():
    torch.manual_seed(0)
    env, td, policy = two_robots(BOARD, "E", "W")
    careful = ArgmaxPolicy(policy)
    first = careful(td.clone())["agents", "action"]
    assert first.tolist() == [[ACTIONS.index("E"), ACTIONS.index("W")]]
    places = set()
    for _ in range(10):
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

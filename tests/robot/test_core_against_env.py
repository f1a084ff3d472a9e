"""A team of robots with perfect scans knows, cell by cell, what ``ExplorationEnv`` says."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from marl_explore import ArenaConfig, make_env
from marl_explore.planners import PLANNERS
from tests.robot.world import PATIENT, RADIUS, World

ENTRIES = ("map", "position", "unshared", "steps_since_merge", "action_mask")
FEATURES = ("fov", "fpr", "net")


def played(config, policy, arena, steps, seed):
    """An episode of one arena, robots acting by a policy: observations and actions of every step."""
    torch.manual_seed(seed)
    env = make_env(config, first_arena=arena, max_steps=steps, stream="test", fpr="proximity")
    return env.rollout(steps, policy, break_when_any_done=False)[0]


class Script:
    """A policy that takes given actions in turn, and keeps what it saw."""

    def __init__(self, actions):
        self.actions, self.seen = actions, []

    def __call__(self, observation):
        self.seen.append(observation)
        return self.actions[len(self.seen) - 1] if len(self.seen) <= len(self.actions) else 8


def assert_team_is_env(config, episode, seed):
    group = episode["agents"]
    steps = len(group["action"])
    scripts = [Script(group["action"][:, i].tolist()) for i in range(config.num_agents)]
    obstacles, starts = episode["obstacles"][0].numpy(), group["position"][0].tolist()
    world = World(config, obstacles, starts, scripts, seed=seed, fpr="proximity", settings=PATIENT)
    world.run(steps)
    for robot, script in enumerate(scripts):
        for moment, seen in enumerate(script.seen[:steps]):
            for name in ENTRIES:
                expected = group[name][moment, robot].numpy()
                assert np.array_equal(getattr(seen, name), expected), (name, moment, robot)
            for name in FEATURES:
                expected = group["observation", name][moment, robot].numpy()
                assert np.array_equal(getattr(seen, name), expected), (name, moment, robot)
    assert world.closest > 2 * RADIUS


@pytest.mark.parametrize("arena", range(3))
def test_an_exploring_team_is_the_environment(arena):
    config = ArenaConfig(occlusion=True)
    episode = played(config, PLANNERS["nearest-timer"](config), arena, 25, seed=arena)
    assert episode["next", "agents", "merged"].any()
    assert_team_is_env(config, episode, seed=arena)


@pytest.mark.parametrize("arena", range(4))
def test_a_crowded_random_team_is_the_environment(arena):
    """Small arenas: robots contend, cross, hold each other up and communicate in chains."""
    config = ArenaConfig(
        height=6,
        width=7,
        num_agents=5,
        obstacle_density=0.15,
        communication_range=1.5,
        occlusion=True,
    )
    episode = played(config, PLANNERS["random"](config), arena, 25, seed=arena)
    assert episode["next", "agents", "dangerous"].any()
    assert_team_is_env(config, episode, seed=arena)

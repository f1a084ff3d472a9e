"""A team of robots with perfect scans knows, cell by cell, what the environment says."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from marl_explore import ArenaConfig, make_env
from marl_explore.core.motion import dangerous_moves
from tests.helpers.robot_world import PATIENT, RADIUS, World

ENTRIES = ("map", "position", "unshared", "steps_since_merge", "action_mask")
FEATURES = ("fov", "fpr", "net")
STEPS = 25


class Wanderer:
    """Takes random allowed actions, and keeps what it saw and did."""

    def __init__(self, seed):
        self.chance, self.seen, self.actions = np.random.default_rng(seed), [], []

    def __call__(self, observation):
        action = int(self.chance.choice(observation.action_mask.nonzero()[0]))
        self.seen.append(observation)
        self.actions.append(action)
        return action


def wandered(config, arena):
    """A team that has wandered through an arena, and the environment at its start."""
    env = make_env(config, first_arena=arena, stream="test", fpr="proximity")
    start = env.reset()
    robots = [Wanderer([arena, i]) for i in range(config.num_agents)]
    obstacles, cells = start["obstacles"][0].numpy(), start["agents", "position"][0].tolist()
    world = World(config, obstacles, cells, robots, seed=arena, fpr="proximity", settings=PATIENT)
    world.run(STEPS)
    return robots, world, env, start


def assert_same(robots, group, moment):
    for robot, wanderer in enumerate(robots):
        seen = wanderer.seen[moment]
        for name in ENTRIES:
            expected = group[name][0, robot].numpy()
            assert np.array_equal(getattr(seen, name), expected), (name, moment, robot)
        for name in FEATURES:
            expected = group["observation", name][0, robot].numpy()
            assert np.array_equal(getattr(seen, name), expected), (name, moment, robot)


def assert_same_team(robots, observation, moment, gave_up):
    """The step, the cells of linked robots, and whether the last move was refused or given up."""
    position, linked = (observation["agents", key][0] for key in ("position", "linked"))
    for robot, wanderer in enumerate(robots):
        seen = wanderer.seen[moment]
        others = [mate for mate in linked[robot].nonzero().flatten().tolist() if mate != robot]
        assert seen.step == int(observation["step_count"]) == moment
        assert seen.mates == {mate: tuple(position[mate].tolist()) for mate in others}
        refused = observation["agents", "dangerous"][0, robot] | gave_up[0, robot]
        assert seen.refused == bool(refused), (moment, robot)


def replayed(robots, env, observation):
    """Hold the environment against the robots, step by step.

    A robot may have to give up a diagonal that is open on the grid, since no cell beside it was to
    be had; there it stays. Returns how often that was, how often robots were refused, and merged.
    """
    given_up = refused = merged = 0
    gave_up = torch.zeros(1, len(robots), dtype=torch.bool)
    for moment in range(STEPS):
        group = observation["agents"]
        assert_same(robots, group, moment)
        assert_same_team(robots, observation, moment, gave_up)
        action = torch.tensor([[robot.actions[moment] for robot in robots]])
        dangerous = dangerous_moves(group["action_mask"], group["position"], action)
        after = torch.tensor([[robot.seen[moment + 1].position for robot in robots]])
        stayed = (after == group["position"]).all(-1)
        gave_up = stayed & ~dangerous & (action < 8)
        assert (action[gave_up] % 2 == 1).all()
        taken = action.masked_fill(gave_up, 8)
        step = env.step(observation.set(("agents", "action"), taken))["next"]
        given_up += int(gave_up.sum())
        refused += int(step["agents", "dangerous"].sum())
        merged += int(step["agents", "merged"].sum())
        observation = TensorDict(dict(step.items()), batch_size=[1])
    return given_up, refused, merged


@pytest.mark.parametrize("arena", range(3))
def test_a_team_in_the_papers_arena_is_the_environment(arena):
    robots, world, env, start = wandered(ArenaConfig(occlusion=True), arena)
    given_up, _, _ = replayed(robots, env, start)
    assert given_up <= 1
    assert world.closest > 2 * RADIUS


def test_a_crowded_team_is_the_environment():
    """Robots contend, cross, hold each other up and communicate in chains."""
    config = ArenaConfig(6, 7, 0.15, num_agents=5, communication_range=1.5, occlusion=True)
    counts = []
    for arena in range(4):
        robots, world, env, start = wandered(config, arena)
        counts.append(replayed(robots, env, start))
        assert world.closest > 2 * RADIUS
    given_up, refused, merged = np.sum(counts, 0)
    assert given_up <= 12
    assert refused > 5
    assert merged > 5

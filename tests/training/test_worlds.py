"""Worlds drawn at random: always the same, allowed, and of every kind."""

from __future__ import annotations

import math
from collections import Counter

import pytest

from marl_explore import ArenaConfig, ExplorationEnv
from marl_explore.training.worlds import random_world

ARENA = ArenaConfig(height=14, width=16, num_agents=3, cell_size=0.25, obstacle_density=0.2)
WORLDS = [random_world(number, ARENA) for number in range(400)]


def test_a_world_is_always_the_same_and_keeps_size_and_robots():
    assert [random_world(number, ARENA) for number in range(5)] == WORLDS[:5]
    for world in WORLDS:
        assert (world.height, world.width, world.num_agents) == (14, 16, 3)
        assert (world.cell_size, world.obstacle_density) == (0.25, 0.2)
    known = random_world(1, ArenaConfig())
    ranges = (known.sensing_range, known.communication_range)
    assert ranges == pytest.approx((3.1944407, 1.1916719))


def test_worlds_are_of_every_kind():
    kinds = Counter((w.sensing_shape, w.line_of_sight, w.types == ((0, 1, 2),)) for w in WORLDS)
    assert len(kinds) == 6  # robots of paper's sensors differ by radio
    assert min(kinds.values()) > 5
    assert {w.wall_loss_db for w in WORLDS} == {0.0, 3.0, 6.0, math.inf}
    assert {w.num_walkers for w in WORLDS} == {0, 1, 2, 3, 4}
    for name, most in (("message_loss", 0.3), ("failure_rate", 0.002), ("shadowing_db", 6.0)):
        found = [getattr(world, name) for world in WORLDS]
        assert 0.4 < found.count(0.0) / len(found) < 0.6
        assert 0.95 * most < max(found) <= most
    ranges = [world.communication_range for world in WORLDS]
    cells = [r / 0.25 for r in ranges if isinstance(r, float)]
    assert 2 <= min(cells) < 2.2 < 14.5 < max(cells) <= 16
    lidars = [w.sensing_range / 0.25 for w in WORLDS if isinstance(w.sensing_range, float)]
    assert max(lidars) > 9.5


@pytest.mark.parametrize("number", range(12))
def test_robots_can_act_in_them(number):
    env = ExplorationEnv(random_world(number, ArenaConfig(num_agents=3)), num_envs=2)
    assert env.rollout(5)["next", "reward"].isfinite().all()

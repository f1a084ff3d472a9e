"""The PettingZoo environment under SuperSuit and Stable-Baselines3."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from marl_explore import ArenaConfig
from marl_explore.adapters.pettingzoo import parallel_env
from recipes import sb3_ppo as recipe

STAY = 8


def returns_of_staying(seed):
    """The return of a team that never moves, in the second arena of a seed."""
    arena = ArenaConfig(height=6, width=6, num_agents=3, communication_range=2.0)
    env = parallel_env(arena, "team", recipe.STEPS)
    env.reset(seed)
    env.reset()
    total = 0.0
    while env.agents:
        total += env.step(dict.fromkeys(env.agents, STAY))[1]["robot_0"]
    return total


def test_the_episodes_are_those_of_the_environment():
    vector = recipe.vectorized_env(seed=4)
    assert vector.num_envs == 3 * recipe.ARENAS
    observation = vector.reset()
    assert not np.array_equal(*observation["observation"][[0, 3]])  # another arena
    stay = np.full(vector.num_envs, STAY)
    for _ in range(recipe.STEPS):
        *_, done, infos = vector.step(stay)
    assert done.all()
    expected = [returns_of_staying(4 + i) for i in range(recipe.ARENAS) for _ in range(3)]
    assert [info["episode"]["r"] for info in infos] == pytest.approx(expected, abs=1e-4)


def test_the_recipe_learns():
    before, after = recipe.main(steps=15_000)
    assert after > before + 0.3


def test_help():
    command = [sys.executable, recipe.__file__, "--help"]
    assert "usage:" in subprocess.run(command, capture_output=True, text=True, check=True).stdout

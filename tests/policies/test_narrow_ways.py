"""Arenas in which robots start in each other's only way: nobody may wait there for ever."""

from __future__ import annotations

import pytest

from marl_explore import ArenaConfig, ExplorationEnv, metrics, record
from marl_explore.evaluation.episodes import play
from marl_explore.evaluation.registry import find_policy
from tests.helpers.boards import arena

BOARDS = {
    "one behind the other": "#####\n#0..#\n#1###\n#####",
    "four at a corner": "########\n#...01.#\n####23.#\n########",
    "three in a dead end": "########\n#012...#\n########",
}
RUNS, STEPS = 32, 300
SHARED_WAYS = {
    "two in a way of two cells": "############\n#....01....#\n#....23....#\n############",
    "a room at the end": "###########\n#....#....#\n#.01....#.#\n#....#....#\n###########",
    "a dead end": "########\n#....01#\n#####..#\n########",
}
THREE = "#########\n#.....01#\n#####..2#\n#########"


@pytest.mark.parametrize("board", BOARDS.values(), ids=BOARDS)
@pytest.mark.parametrize("policy", ["best", "best:argmax", "goal-utility", "nearest-timer"])
def test_every_run_completes(policy, board):
    obstacles, position = arena(board)
    config = ArenaConfig(*obstacles.shape, num_agents=len(position))

    def drawn(seed, arenas, episodes):
        return obstacles.expand(len(arenas), -1, -1), position.expand(len(arenas), -1, -1)

    env = ExplorationEnv(
        config, num_envs=RUNS, max_steps=STEPS, terminate_at_coverage=1.0, arenas=drawn
    )
    *_, last = play(find_policy(policy, config), env, STEPS, until_done=True)
    complete = int(last["terminated"].sum())
    assert complete == RUNS, f"{complete} of {RUNS} runs are complete after {STEPS} steps"


@pytest.mark.parametrize("board", SHARED_WAYS.values(), ids=SHARED_WAYS)
@pytest.mark.parametrize("policy", ["best", "best:argmax", "goal-utility", "nearest-timer"])
def test_every_robot_completes_its_map_though_none_is_ever_linked(policy, board):
    """Who has nothing left to explore does not know that it stands in another's only way."""
    steps = steps_until_all_maps_are_complete(policy, board, STEPS, runs=RUNS)
    assert (steps <= STEPS).all(), steps.tolist()


@pytest.mark.parametrize("board", SHARED_WAYS.values(), ids=SHARED_WAYS)
@pytest.mark.parametrize("policy", ["best", "best:argmax", "goal-utility"])
def test_who_remembers_does_too_where_one_is_slow(policy, board):
    """A slow robot may move at every second step only, when others may have stepped back."""
    steps = steps_until_all_maps_are_complete(policy, board, 2 * STEPS, slow=1)
    assert (steps <= 2 * STEPS).all(), steps.tolist()


@pytest.mark.parametrize("policy", ["best", "best:argmax", "goal-utility"])
def test_three_go_into_a_dead_end_one_after_the_other(policy):
    steps = steps_until_all_maps_are_complete(policy, THREE, 2 * STEPS)
    assert (steps <= 2 * STEPS).all(), steps.tolist()


def steps_until_all_maps_are_complete(policy, board, steps, slow=0, runs=8):
    """Of each run in an arena in which no robot is ever linked; the first ``slow`` ones are so."""
    obstacles, position = arena(board)
    robots = len(position)
    period = tuple([2] * slow + [1] * (robots - slow))
    config = ArenaConfig(
        *obstacles.shape, num_agents=robots, communication_range=0.0, move_period=period
    )

    def drawn(seed, arenas, episodes):
        return obstacles.expand(len(arenas), -1, -1), position.expand(len(arenas), -1, -1)

    acting = find_policy(policy, config)
    episodes = record(acting, config, runs, steps, arenas=drawn, until_mapped=True)
    return metrics.per_episode(episodes)["steps_to_all_complete"]

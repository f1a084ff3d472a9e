"""Arenas in which robots start in each other's only way: nobody may wait there for ever."""

from __future__ import annotations

import pytest

from marl_explore import ArenaConfig, ExplorationEnv
from marl_explore.evaluation.episodes import play
from marl_explore.evaluation.registry import find_policy
from tests.helpers.boards import arena

BOARDS = {
    "one behind the other": "#####\n#0..#\n#1###\n#####",
    "four at a corner": "########\n#...01.#\n####23.#\n########",
    "three in a dead end": "########\n#012...#\n########",
}
RUNS, STEPS = 32, 300


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

"""Joint planning with exchanges at known times, and the yardsticks."""

from __future__ import annotations

import torch

from marl_explore import ArenaConfig, ExplorationEnv
from marl_explore.planners import (
    Central,
    Clairvoyant,
    Rendezvous,
    SharedClock,
    counting_bound,
    never,
)
from tests.helpers.situations import knowing, names, on_board, placed


def test_robots_exchange_by_the_clock_and_explore_meanwhile():
    config = ArenaConfig(height=20, width=20, num_agents=2, communication_range=20.0)
    env = ExplorationEnv(config, num_envs=4)
    planner = Rendezvous(config, SharedClock(4, 3), answer=False)
    td, merged = env.reset(), []
    for _ in range(8):
        td = env.step(planner(td))["next"]
        merged.append(td["agents", "merged"].tolist())
    nobody, all_robots = [[False, False]] * 4, [[True, True]] * 4
    assert merged == [nobody] * 4 + [all_robots] + [nobody] * 2 + [all_robots]


def test_cells_that_others_in_range_have_seen_are_left_to_them():
    """All that robot 0 does not know lies around robot 1, so it communicates."""
    env, td = on_board("0......1", 1, 8, communication_range=4.0)
    planner = Rendezvous(env.config, never)
    assert names(planner.plan(knowing(td, "......??", "????...."))) == ["talk", "W"]


def test_with_others_cells_left_a_robot_walks_to_whom_it_saw_last():
    env, td = on_board("0.........1", 1, 11, communication_range=2.5)  # 5 cells
    planner = Rendezvous(env.config, never, patience_steps=3)
    known, other = "........???", "???????...."
    td = placed(env, td, [0, 4], [0, 9])
    assert names(planner.plan(knowing(td, known, other)))[0] == "talk"
    td = placed(env, td, [0, 3], [0, 10])
    for step in range(1, 5):
        td["step_count"] = torch.tensor([[step]])
        assert names(planner.plan(knowing(td, known, other)))[0] == "E"
        # after three steps without a meeting it will look at those cells itself
        assert planner._covered[0, 0].any() == (step < 3)


def test_memory_starts_anew_with_an_episode():
    env, td = on_board("0....1", 1, 6, communication_range=1.0)  # 2 cells
    planner = Rendezvous(env.config, never)
    near = placed(env, td, [0, 0], [0, 2])
    planner.plan(near)
    assert planner._covered.any()
    planner.plan(td)
    assert not planner._covered.any()
    assert (planner._seen.step < 0).all()


def test_a_robot_answers_one_that_waits_beside_it():
    env, td = on_board("0....1........", 1, 14)
    planner = Rendezvous(env.config, never)
    planner.plan(td)
    td["step_count"] += 1
    assert names(planner.plan(td)) == ["talk", "talk"]  # neither has moved
    quiet = Rendezvous(env.config, never, answer=False)
    td["step_count"] -= 1
    quiet.plan(td)
    td["step_count"] += 1
    assert "talk" not in names(quiet.plan(td))


def test_references_say_that_they_are():
    assert Central.reference
    assert Clairvoyant.reference
    assert not Rendezvous.reference


def test_the_clairvoyant_knows_a_dead_end_before_it_is_seen():
    board = "0#......\n.#.####.\n.#.#..#.\n........"
    env, td = on_board(board, 4, 8, communication_range=0.0)
    shared = Central(env.config).plan(td)
    truth = Clairvoyant(env.config).plan(td)
    assert names(truth) == names(shared) == ["S"]  # the only way out of the corner


def test_the_counting_bound_is_never_beaten():
    config = ArenaConfig()
    env = ExplorationEnv(config, num_envs=8, stream="test")
    td = env.reset()
    bound = counting_bound(config, td)
    # 144 cells less at most 36 seen at the start, 20 new ones a step
    assert ((bound >= 6) & (bound <= 8)).all()
    planner = Clairvoyant(config)
    for _ in range(int(bound.min())):
        union = (td["agents", "map"].amax(1) >= 0).flatten(1).sum(-1)
        assert (union < 144).all()
        td = env.step(planner(td))["next"]

"""Rewards against values worked out by hand."""

from __future__ import annotations

import pytest
import torch

from marl_explore.config.arena import ArenaConfig
from marl_explore.core.rewards import (
    REWARDS,
    StepRecord,
    case1,
    case2,
    case2_lone_idle,
    progress,
    resolve,
    team,
    union,
)
from marl_explore.core.world import advance, start
from tests.helpers.boards import actions, arena


def record(names, **changes):
    """A step in a 12 x 12 arena (144 cells, e_max 5) in which nothing happened but ``changes``."""
    action = actions(names)
    robots = len(action)
    step = StepRecord(
        action=action,
        dangerous=torch.zeros(robots, dtype=torch.bool),
        network=torch.zeros(robots, robots, dtype=torch.bool),
        discovered=torch.zeros(robots, dtype=torch.int64),
        received=torch.zeros(robots, dtype=torch.int64),
        known=torch.full((robots,), 50),
        unshared=torch.zeros(robots, robots, dtype=torch.int64),
        missing=torch.full((robots,), 50),
        alive=torch.ones(robots, dtype=torch.bool),
        maps=(torch.full((robots, 12, 12), -1), torch.full((robots, 12, 12), -1)),
        num_cells=144,
        max_discovery=5,
    )
    return step._replace(**{name: torch.tensor(value) for name, value in changes.items()})


def assert_rewards(reward, step, expected):
    torch.testing.assert_close(reward(step), torch.tensor(expected), rtol=0, atol=1e-6)


MERGE_OF_THREE = {
    "network": [
        [True, True, True, False],
        [True, True, True, False],
        [True, True, True, False],
        [False, False, False, False],
    ],
    "received": [12, 0, 36, 0],
    "unshared": [[0, 10, 30, 99], [0, 0, 0, 99], [72, 72, 0, 99], [99, 99, 99, 0]],
}
"""Robots 0, 1 and 2 merge; robot 3 is elsewhere, so what it is owed counts for nobody."""


# ---------------------------------------------------------------- case 1


def test_case1_pays_every_new_cell_however_it_came():
    step = record("N stay talk talk", discovered=[5, 0, 0, 0], received=[0, 0, 7, 0])
    assert_rewards(case1, step, [5.0, 0.0, 7.0, 0.0])


def test_case1_punishes_danger_with_100():
    step = record("N E", dangerous=[True, False], discovered=[0, 3])
    assert_rewards(case1, step, [-100.0, 3.0])


# ---------------------------------------------------------------- case 2


@pytest.mark.parametrize("reward", [case2, case2_lone_idle])
def test_case2_pays_discoveries_as_a_share_of_the_most_one_move_can_bring(reward):
    step = record("N SE W", discovered=[5, 3, 0])
    assert_rewards(reward, step, [1.0, 0.6, 0.0])
    assert_rewards(reward, step._replace(max_discovery=9), [5 / 9, 3 / 9, 0.0])


@pytest.mark.parametrize("reward", [case2, case2_lone_idle])
def test_case2_takes_1_for_staying(reward):
    assert_rewards(reward, record("stay N"), [-1.0, 0.0])


@pytest.mark.parametrize("reward", [case2, case2_lone_idle])
def test_case2_punishes_danger_with_10(reward):
    assert_rewards(reward, record("N E", dangerous=[True, False]), [-10.0, 0.0])


def test_a_lone_communicator_is_idle_only_in_case2_lone_idle():
    step = record("talk")
    assert_rewards(case2, step, [0.0])
    assert_rewards(case2_lone_idle, step, [-1.0])


def test_a_lone_communicator_gets_nothing_even_for_discoveries():
    """It cannot discover in an episode, but a state that is set by hand may leave cells to see."""
    assert_rewards(case2, record("talk", discovered=[3]), [0.0])
    assert_rewards(case2_lone_idle, record("talk", discovered=[3]), [3 / 5 - 1])


@pytest.mark.parametrize("reward", [case2, case2_lone_idle])
def test_case2_pays_a_merge_by_what_it_brought_and_what_was_new_to_the_others(reward):
    step = record("talk talk talk E", **MERGE_OF_THREE)
    expected = [
        (0.8 + 20 / 144) * 12 / 144,  # q: the mean of 10 and 30
        0.0,  # nothing new for robot 1
        (0.8 + 72 / 144) * 36 / 144,
        0.0,
    ]
    assert expected[0] == pytest.approx(0.0782407407)
    assert expected[2] == pytest.approx(0.325)
    assert_rewards(reward, step, expected)


def test_what_a_robot_keeps_to_itself_does_not_enter_its_mean():
    """q_ii is no pair: with one other member the mean is q_ij itself."""
    step = record(
        "talk talk",
        network=[[True, True], [True, True]],
        received=[72, 72],
        unshared=[[1000, 36], [72, 1000]],
    )
    assert_rewards(case2, step, [(0.8 + 0.25) * 0.5, (0.8 + 0.5) * 0.5])


# ---------------------------------------------------------------- team


def test_team_pays_the_growth_of_the_largest_map_less_time_and_danger():
    # maps of 30 and 35 cells grow to 40 and 50, one of two robots is refused
    step = record(
        "talk E", known=[40, 50], discovered=[0, 15], received=[10, 0], dangerous=[False, True]
    )
    assert_rewards(team, step, [15 / 40 - 0.1 - 0.125] * 2)


def test_team_compares_the_largest_maps_not_one_robots_own():
    # 48 was the largest and robot 1 overtakes it with 50: the growth is 2, not 20
    step = record("N E", known=[48, 50], discovered=[0, 20])
    assert_rewards(team, step, [2 / 40 - 0.1] * 2)


def test_team_takes_nothing_for_time_once_a_map_is_complete():
    assert_rewards(team, record("N E N", missing=[0, 50, 50]), [0.0] * 3)


def test_team_takes_a_quarter_when_all_are_refused():
    step = record("N E N", dangerous=[True, True, True], missing=[0, 50, 50])
    assert_rewards(team, step, [-0.25] * 3)


def test_progress_pays_half_for_the_mean_map():
    # maps of 30 and 35 cells grow to 40 and 50: the largest by 15, the mean one by 12.5
    step = record(
        "talk E", known=[40, 50], discovered=[0, 15], received=[10, 0], dangerous=[False, True]
    )
    assert_rewards(progress, step, [(15 + 12.5) / 80 - 0.1 - 0.125] * 2)


def test_progress_counts_what_has_not_reached_the_largest_map():
    step = record("N E", known=[48, 20], discovered=[0, 8])
    assert_rewards(progress, step, [4 / 80 - 0.1] * 2)


# ---------------------------------------------------------------- from a board to the reward


def test_the_rewards_of_a_step_on_a_drawn_board():
    """Robots 0 and 1 merge, 2 moves into an obstacle, 3 finds cells, 4 stays."""
    config = ArenaConfig(
        height=3, width=16, num_agents=5, obstacle_density=0, communication_range=1.0
    )
    state = start(
        config,
        *arena("""
            ................
            0.1..#2...3...4.
            ................
        """),
    )
    # robot 0 knows the columns 0 and 1, robot 1 the columns 1, 2 and 3: together 12 cells
    _, step = advance(config, state, actions("talk talk W E stay"))
    assert step.received.tolist() == [6, 3, 0, 0, 0]
    assert step.discovered.tolist() == [0, 0, 0, 3, 0]
    # q of each member is its first sensing: 6 and 9 of 48 cells; e_max is 5
    first, second = (0.8 + 6 / 48) * 6 / 48, (0.8 + 9 / 48) * 3 / 48
    assert_rewards(case1, step, [6.0, 3.0, -100.0, 3.0, 0.0])
    assert_rewards(case2, step, [first, second, -10.0, 3 / 5, -1.0])
    assert_rewards(case2_lone_idle, step, [first, second, -10.0, 3 / 5, -1.0])
    # the largest map had 9 cells and has 12
    assert_rewards(team, step, [3 / 40 - 0.1 - 0.25 / 5] * 5)
    # nobody knew the three cells that robot 3 found
    assert_rewards(union, step, [(3 + 3) / 80 - 0.1 - 0.25 / 5] * 5)


def test_union_pays_for_a_cell_once():
    """Robot 0 walks to the columns 5 to 7, which robot 1 knows."""
    config = ArenaConfig(height=3, width=10, num_agents=2, obstacle_density=0)
    state = start(
        config,
        *arena("""
            ..........
            .0....1...
            ..........
        """),
    )
    for growth in (3, 3, 0):
        state, step = advance(config, state, actions("E stay"))
        assert step.discovered.tolist() == [3, 0]
        assert step.union_growth == growth
        assert_rewards(union, step, [(3 + growth) / 80 - 0.1] * 2)


def test_without_a_discount_union_pays_for_time_alone():
    """Whatever the robots do: the growths are those of a whole arena once it is complete."""
    config = ArenaConfig(height=1, width=6, num_agents=2, obstacle_density=0)
    for plan in (
        ["E W", "talk talk"],
        ["E stay"] * 4,
        ["stay stay", "E W", "talk talk"],
    ):
        state, total = start(config, *arena("0....1")), 0.0
        for names in plan:
            state, step = advance(config, state, actions(names))
            total += float(union(step)[0])
        assert step.complete
        # the largest of two maps of 2 of the 6 cells, and their union of 4, grow to 6
        assert total == pytest.approx((4 + 2) / 80 - 0.1 * (len(plan) - 1))


def test_q_counts_only_since_the_last_merge():
    config = ArenaConfig(height=1, width=12, num_agents=2, obstacle_density=0)
    state = start(config, *arena("0....1......"))
    state, _ = advance(config, state, actions("talk talk"))
    state, _ = advance(config, state, actions("E stay"))  # robot 0 discovers one cell
    _, step = advance(config, state, actions("talk talk"))
    assert step.received.tolist() == [0, 1]
    assert_rewards(case2, step, [0.0, (0.8 + 0 / 12) * 1 / 12])
    state, _ = advance(config, state, actions("stay E"))  # robot 1 discovers one cell too
    _, step = advance(config, state, actions("talk talk"))
    assert step.received.tolist() == [1, 1]
    assert_rewards(case2, step, [(0.8 + 1 / 12) * 1 / 12] * 2)


# ---------------------------------------------------------------- names


@pytest.mark.parametrize("name", ["case1", "case2", "case2-lone-idle", "team", "progress", "union"])
def test_a_reward_has_a_name(name):
    assert resolve(name) is REWARDS[name]


def test_a_callable_is_its_own_reward():
    def own(step):
        return step.gain

    assert resolve(own) is own


def test_an_unknown_name_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match=r"'case3'.*case1.*case2.*case2-lone-idle.*team"):
        resolve("case3")

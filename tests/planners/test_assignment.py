"""How frontiers are shared out."""

from __future__ import annotations

import pytest
import torch

from marl_explore.core.grid import STAY
from marl_explore.planners import FrontierAssignment, UtilityCost, hungarian, never
from marl_explore.planners.assignment import DETOUR, Auction
from tests.helpers.situations import knowing, names, on_board

STRATEGIES = {
    "utility": UtilityCost(),
    "sequential": UtilityCost(by_number=True),
    "hungarian": hungarian,
}


def auction(distances, frontier, me, present=None, width=None):
    distance = torch.tensor(distances, dtype=torch.float32).unsqueeze(0)
    robots, cells = distance.shape[1:]
    return Auction(
        me=torch.tensor([me]),
        present=torch.tensor([present or [True] * robots]),
        frontier=torch.tensor([frontier], dtype=torch.bool),
        distance=distance,
        width=width or cells,
    )


@pytest.mark.parametrize("assign", STRATEGIES.values(), ids=STRATEGIES)
def test_two_robots_take_the_frontier_nearer_to_each(assign):
    distances = [[1, 2, 3, 4, 5, 6, 7, 8, 9], [9, 8, 7, 6, 5, 4, 3, 2, 1]]
    ends = [1, 0, 0, 0, 0, 0, 0, 0, 1]
    assert assign(auction(distances, ends, me=0)).tolist() == [0]
    assert assign(auction(distances, ends, me=1)).tolist() == [8]


@pytest.mark.parametrize("assign", STRATEGIES.values(), ids=STRATEGIES)
def test_robots_out_of_range_do_not_count(assign):
    distances = [[1, 2, 3, 4, 5, 6, 7, 8, 9], [1, 1, 1, 1, 1, 1, 1, 1, 1]]
    ends = [1, 0, 0, 0, 0, 0, 0, 0, 1]
    assert assign(auction(distances, ends, me=0, present=[True, False])).tolist() == [0]


def test_the_nearer_robot_takes_a_frontier_and_the_other_goes_elsewhere():
    """Robot 1 is nearer to both; robot 0, which would choose first by number, gets the far one."""
    distances = [[3, 0, 0, 0, 0, 0, 0, 0, 9], [1, 0, 0, 0, 0, 0, 0, 0, 5]]
    ends = [1, 0, 0, 0, 0, 0, 0, 0, 1]
    assert UtilityCost()(auction(distances, ends, me=1)).tolist() == [0]
    assert UtilityCost()(auction(distances, ends, me=0)).tolist() == [8]
    by_number = UtilityCost(by_number=True)
    assert by_number(auction(distances, ends, me=0)).tolist() == [0]
    assert by_number(auction(distances, ends, me=1)).tolist() == [8]


def test_the_hungarian_method_minimises_the_sum():
    """Greedily robot 0 would take cell 0 (1) and leave 9 to robot 1; 2 + 2 is less."""
    distances = [[1, 2], [2, 9]]
    assert hungarian(auction(distances, [1, 1], me=0)).tolist() == [1]
    assert hungarian(auction(distances, [1, 1], me=1)).tolist() == [0]


def test_with_more_robots_than_frontiers_the_rest_goes_along():
    distances = [[1, 5], [1, 5], [1, 5]]
    chosen = {hungarian(auction(distances, [1, 0], me=me)).item() for me in range(3)}
    assert chosen == {0}


def test_frontiers_beside_a_chosen_one_lose_utility():
    """Cell 1 is nearer to robot 1 than cell 6, but robot 0 goes to cell 0 beside it."""
    distances = [[1, 9, 9, 9, 9, 9, 9], [9, 2, 9, 9, 9, 9, 4]]
    frontier = [1, 1, 0, 0, 0, 0, 1]
    assert UtilityCost(cost=0.1)(auction(distances, frontier, me=1)).tolist() == [6]
    assert UtilityCost(cost=0.1, reach=0)(auction(distances, frontier, me=1)).tolist() == [1]


def test_distances_are_those_of_known_paths_and_otherwise_straight_with_a_detour():
    """Robot 1 stands on the one frontier; the way between the robots is unknown."""
    _env, td = on_board("0.....1", 1, 7)
    auctions = []

    def watched(auction):
        auctions.append(auction)
        return hungarian(auction)

    planner = FrontierAssignment(never, watched)
    planner.plan(knowing(td, "..??...", "..??..."))
    apart = auctions[0].distance.long()
    assert apart[0, 0, :2].tolist() == [0, 1]
    assert apart[0, 1].tolist() == [6 + DETOUR, 5 + DETOUR, 4 + DETOUR, 3 + DETOUR, 2, 1, 0]


@pytest.mark.parametrize("assign", STRATEGIES.values(), ids=STRATEGIES)
def test_robots_walk_round_each_other_and_stay_when_all_is_known(assign):
    _env, td = on_board("....\n.01.\n....", 3, 4)
    planner = FrontierAssignment(never, assign)
    known = "....\n....\n...."
    assert planner.plan(knowing(td, known, known)).tolist() == [[STAY, STAY]]
    # robot 0 wants to the east; robot 1, beside it, is in the straight way
    moves = names(planner.plan(knowing(td, "....\n....\n...?", known)))
    assert moves == ["SE", "stay"]

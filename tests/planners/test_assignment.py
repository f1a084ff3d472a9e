"""How frontiers are shared out."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.optimize import linear_sum_assignment

from marl_explore import ArenaConfig, ExplorationEnv
from marl_explore.config.constants import DETOUR_CELLS as DETOUR
from marl_explore.core.grid import STAY
from marl_explore.planners import FrontierAssignment, PairTimer, UtilityCost, hungarian, never
from marl_explore.planners.assignment import Auction
from tests.helpers import oracle
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
        cell=torch.arange(cells).unsqueeze(0),
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
    assert auctions[0].cell.tolist() == [[1, 4]] * 2
    assert auctions[0].distance.tolist() == [
        [[1, 0], [5 + DETOUR, 2]],
        [[1, 4 + DETOUR], [0, 2]],
    ]
    assert auctions[0].frontier.tolist() == [[True, False], [False, True]]


@pytest.mark.parametrize("assign", STRATEGIES.values(), ids=STRATEGIES)
def test_robots_walk_round_each_other_and_stay_when_all_is_known(assign):
    _env, td = on_board("....\n.01.\n....", 3, 4)
    planner = FrontierAssignment(never, assign)
    known = "....\n....\n...."
    assert planner.plan(knowing(td, known, known)).tolist() == [[STAY, STAY]]
    # robot 0 wants to the east; robot 1, beside it, is in the straight way
    moves = names(planner.plan(knowing(td, "....\n....\n...?", known)))
    assert moves == ["SE", "stay"]


# ---------------------------------------------------------------------- in plain Python


def lengths(map_, start, taken=()):
    board = [list(row) for row in map_]
    for r, c in taken:
        board[r][c] = oracle.OCCUPIED
    free = [[value == oracle.FREE for value in row] for row in board]
    walls = [[value == oracle.OCCUPIED for value in row] for row in board]
    return board, oracle.distances(free, walls, start)


def apart(one, other):
    return max(abs(one[0] - other[0]), abs(one[1] - other[1]))


def best_pairs(me, members, goals, distance, strategy):
    """The goal of a robot by the definition of ``UtilityCost``."""
    utility = {goal: np.float32(1) for goal in goals}
    waiting, cost, own = list(members), np.float32(strategy.cost), None
    while waiting:
        value = {(j, g): utility[g] - cost * distance[j, g] for j in waiting for g in goals}
        ahead = waiting[:1] if strategy.by_number else waiting
        robot, goal = max(((j, g) for j in ahead for g in goals), key=lambda pair: value[pair])
        own = goal if robot == me else own
        waiting.remove(robot)
        for other in goals:
            share = np.float32(apart(goal, other)) / np.float32(strategy.reach + 1)
            utility[other] = utility[other] - max(np.float32(1) - share, np.float32(0))
    return own


def least_sum(me, members, goals, distance):
    """The goal of a robot by Kuhn's method; the nearest if there are too few."""
    cost = np.array([[distance[j, g] for g in goals] for j in members], dtype=np.float32)
    pairs = {members[j]: goals[g] for j, g in zip(*linear_sum_assignment(cost), strict=True)}
    return pairs.get(me) or min(goals, key=lambda goal: distance[me, goal])


def wanted_move(me, map_, positions, linked, strategy):
    """What ``FrontierAssignment`` wants one robot to do."""
    members = [j for j, known in enumerate(linked) if known]
    beside = [positions[j] for j in members if j != me and apart(positions[j], positions[me]) <= 1]
    board, own = lengths(map_, positions[me], beside)
    goals = [goal for goal in oracle.frontiers(map_) if own.get(goal, 0) > 0]
    if not goals:
        return STAY
    distance = {}
    for j in members:
        _, away = lengths(map_, positions[j])
        for goal in goals:
            length = away.get(goal, apart(positions[j], goal) + DETOUR)
            distance[j, goal] = np.float32(own[goal] if j == me else length)
    choose = least_sum if strategy is hungarian else best_pairs
    options = () if strategy is hungarian else (strategy,)
    goal = choose(me, members, goals, distance, *options)
    return first_move(board, positions[me], goal, own[goal])


def first_move(board, start, goal, length):
    """The lowest direction that begins a shortest path."""
    free = [[value == oracle.FREE for value in row] for row in board]
    walls = [[value == oracle.OCCUPIED for value in row] for row in board]
    for number, direction in enumerate(oracle.COMPASS):
        if oracle.may_move(free, walls, start, direction):
            after = oracle.distances(free, walls, oracle.shifted(start, direction), avoid=start)
            if after.get(goal) == length - 1:
                return number
    raise AssertionError("there is no path")


@pytest.mark.parametrize("assign", STRATEGIES.values(), ids=STRATEGIES)
@pytest.mark.parametrize("side", [9, 16])
def test_decisions_are_those_of_plain_python(assign, side):
    config = ArenaConfig(height=side, width=side + 1, num_agents=5, obstacle_density=0.2)
    env = ExplorationEnv(config, num_envs=2, stream="validation")
    planner = FrontierAssignment(PairTimer(5), assign)
    torch.manual_seed(0)
    history = env.rollout(25, planner)[:, ::4]
    for td in history.flatten(0, 1):
        maps, linked = td["agents", "map"].tolist(), td["agents", "linked"].tolist()
        positions = [tuple(p) for p in td["agents", "position"].tolist()]
        wanted = [wanted_move(i, maps[i], positions, linked[i], assign) for i in range(5)]
        assert planner.plan(td).tolist() == wanted

"""Cells that are the only way for others, and how robots leave them."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from marl_explore import ArenaConfig, ExplorationEnv
from marl_explore.config.constants import COMPASS, OCCUPIED, STAY
from marl_explore.core import ways as team_ways
from marl_explore.core.motion import random_allowed
from marl_explore.planners import hindrances
from marl_explore.policies.observations import robot_observation
from marl_explore.robot.ways import (
    Room,
    is_crowded,
    is_only_way,
    make_room,
    roomy,
    step_aside,
)
from marl_explore.transforms.memory import CROWD_KEYS, CROWDED, RememberTeam
from tests.helpers.boards import arena


def map_of(board):
    obstacles, positions = arena(board)
    return obstacles.numpy().astype(np.int8), [tuple(cell) for cell in positions.tolist()]


@pytest.mark.parametrize(
    ("board", "only"),
    [
        ("#####\n..0..\n#####", True),  # a corridor
        ("#####\n#0...\n#####", False),  # its end
        (".....\n..0..\n.....", False),
        ("..#..\n..0..\n..#..", True),  # a door
        (".....\n#.0.#\n#####", False),  # beside a wall
        ("#.#\n.0.\n#.#", True),  # a crossing
        ("#.#\n.0#\n###", True),  # a bend: robots do not cut its corner
        ("..#\n.0#\n###", False),  # the same with room to pass
        ("#.#\n#0#\n###", False),  # a dead end
        (".##\n#0#\n###", False),  # a closed corner leads nowhere
    ],
)
def test_the_only_way_is_what_others_cannot_go_around(board, only):
    grid, (cell,) = map_of(board)
    assert is_only_way(grid, cell) is only


def test_it_is_what_cuts_the_cells_around_apart():
    """Against a flood of the eight cells around, over all of their patterns."""
    for pattern in range(256):
        ring = [pattern >> number & 1 for number in range(8)]
        grid = np.zeros((3, 3), np.int8)
        for (up, side), code in zip(COMPASS, ring, strict=True):
            grid[1 + up, 1 + side] = code
        assert is_only_way(grid, (1, 1)) is (groups_around(grid) > 1), grid


def groups_around(grid):
    """Groups of the free cells beside the middle, by straight moves that do not use it."""
    left = {(r, c) for r in range(3) for c in range(3) if grid[r, c] == 0} - {(1, 1)}
    groups = 0
    while left:
        group, front = set(), [left.pop()]
        while front:
            row, column = front.pop()
            group.add((row, column))
            beside = {(row + 1, column), (row - 1, column), (row, column + 1), (row, column - 1)}
            front += beside & left
            left -= beside
        groups += any((row + column) % 2 for row, column in group)
    return groups


def walk(board, held=()):
    grid, (cell,) = map_of(board)
    path = [cell]
    while (move := step_aside(grid, path[-1], held)) != STAY and len(path) < 20:
        up, side = COMPASS[move]
        path.append((path[-1][0] + up, path[-1][1] + side))
        assert grid[path[-1]] != OCCUPIED
    return path


def test_a_robot_leaves_a_corridor_by_the_nearer_end():
    board = "...####\n..0...#\n...####"
    assert walk(board) == [(1, 2), (1, 1)] or walk(board)[-1][1] <= 2
    assert walk("#######\n#..0..#\n#######") in ([(1, 3), (1, 2), (1, 1)], [(1, 3), (1, 4), (1, 5)])


def test_it_stays_where_there_is_room():
    assert walk("...\n.0.\n...") == [(1, 1)]


def test_cells_of_others_are_no_place_to_go():
    assert walk("#######\n#..0..#\n#######", held=[(1, 1)])[-1] == (1, 5)
    assert walk("#####\n#.0.#\n#####", held=[(1, 1), (1, 3)]) == [(1, 2)]


@pytest.mark.parametrize("period", [1, (1, 2, 3) * 3])
@pytest.mark.parametrize("metres", [0.0, 0.3, 3.2])
def test_crowded_is_who_has_a_strange_robot_beside_it(metres, period):
    """In torch and numpy, against the arenas themselves: robots know walls beside them."""
    seen = set()
    for now, _ in episodes_in_a_crowd(metres, period):
        found = team_ways.crowded(*(now[key] for key in CROWD_KEYS)).tolist()
        for batch, robot in itertools.product(range(6), range(9)):
            strange = is_beside_a_stranger(now, batch, robot)
            assert found[batch][robot] == strange
            assert is_crowded(robot_observation(now, batch, robot)) == strange
            seen.add(strange)
    assert seen == ({False} if metres > 1 else {False, True})


@pytest.mark.parametrize("period", [1, (1, 2, 3) * 3])
def test_who_was_crowded_makes_room_until_there_is_room(period):
    """In torch, for policies and for planners, and in numpy, against a loop."""
    memory, planners = RememberTeam(move_period=period), hindrances.Room()
    pairs = list(itertools.product(range(6), range(9)))
    rooms, expected, last = (
        {pair: Room() for pair in pairs},
        dict.fromkeys(pairs, False),
        dict.fromkeys(pairs),
    )
    waited, on_the_way = 0, 0
    for now, begins in episodes_in_a_crowd(0.3, period):
        remembered = memory(now.copy())[CROWDED]
        wanted = planners.wanted(now)
        for pair in pairs:
            place = tuple(now["agents", "position"][pair].tolist())
            rooms_known = squares(now["agents", "map"][pair].numpy())
            done = place in rooms_known if rooms_known else place != last[pair]
            before = expected[pair] and not done and not begins
            beside = is_beside_a_stranger(now, *pair)
            waited += before and not beside
            on_the_way += before and place != last[pair]
            expected[pair], last[pair] = beside or before, place
            assert remembered[pair] == wanted[pair] == expected[pair]
            assert rooms[pair].is_wanted(robot_observation(now, *pair)) == expected[pair]
    assert waited > 10
    assert on_the_way > 10


def squares(grid):
    """All cells of squares of two by two free cells."""
    free = {tuple(cell) for cell in np.argwhere(grid == 0).tolist()}
    corners = [(r, c) for r, c in free if {(r + 1, c), (r, c + 1), (r + 1, c + 1)} <= free]
    return {(r + i, c + j) for r, c in corners for i in (0, 1) for j in (0, 1)}


def test_rooms_are_squares_of_free_cells_and_nobodys_only_way():
    random = np.random.default_rng(0)
    grids = random.choice([-1, 0, 0, 0, 1], (300, 6, 7)).astype(np.int8)
    grids[::2][grids[::2] < 0] = OCCUPIED
    found = team_ways.roomy(torch.from_numpy(grids))
    for grid, cells in zip(grids, found.numpy(), strict=True):
        assert {tuple(cell) for cell in np.argwhere(cells).tolist()} == squares(grid)
        assert np.array_equal(roomy(grid), cells)
        for cell in np.argwhere(cells).tolist():
            assert are_joined_around(grid, tuple(cell)) or (grid < 0).any()
    assert 0.2 < found.float().mean() < 0.6


def are_joined_around(grid, middle):
    """Whether the cells to which a robot in a cell can move are joined by moves past it."""
    row, column = middle
    ring = {(row + up, column + side) for up, side in COMPASS}
    left = set(moves_from(grid, middle))
    front = [left.pop()]
    reached = set(front)
    while front:
        after = {cell for old in front for cell in moves_from(grid, old)} & ring
        front = list(after - reached)
        reached |= after
    return left <= reached


def moves_from(grid, cell):
    """Free cells to which a robot can move, with the moves."""
    (row, column), found = cell, {}
    for move, (up, side) in enumerate(COMPASS):
        corners = (row + up, column), (row, column + side)
        shut = up and side and all(is_obstacle(grid, corner) for corner in corners)
        target = row + up, column + side
        inside = 0 <= target[0] < grid.shape[0] and 0 <= target[1] < grid.shape[1]
        if inside and grid[target] == 0 and not shut:
            found[target] = move
    return found


def test_the_way_to_room_is_a_shortest_one():
    """In torch and numpy, against a breadth-first search."""
    random = np.random.default_rng(1)
    grids = random.choice([-1, 0, 0, 1], (400, 7, 8)).astype(np.int8)
    cells = np.stack([random.choice(np.argwhere(grid == 0)) for grid in grids])
    crowd = random.random(len(grids)) < 0.8
    wanted = np.where(random.random(len(grids)) < 0.8, STAY, 3)
    moves = team_ways.make_room(*map(torch.from_numpy, (wanted, crowd, grids, cells))).tolist()
    for row, (grid, cell) in enumerate(zip(grids, cells.tolist(), strict=True)):
        expected = first_move_to_room(grid, tuple(cell))
        seen = SimpleNamespace(map=grid, position=tuple(cell))
        assert make_room(seen) == expected
        goes = crowd[row] and wanted[row] == STAY
        assert moves[row] == (expected if goes else wanted[row])
    assert len(set(moves)) == STAY + 1


def first_move_to_room(grid, start):
    """The lowest first move of all shortest paths to the nearest cells with room."""
    rooms = squares(grid)
    if start in rooms:
        return STAY
    firsts, front = {start: set()}, [start]
    while front:
        after = {}
        for old in front:
            for cell, move in moves_from(grid, old).items():
                if cell not in firsts:
                    after.setdefault(cell, set()).update(firsts[old] or {move})
        reached = [moves for cell, moves in after.items() if cell in rooms]
        if reached:
            return min(set.union(*reached))
        firsts |= after
        front = list(after)
    return STAY


def is_obstacle(grid, cell):
    """Whether it is one on the map, or outside."""
    row, column = cell
    inside = 0 <= row < grid.shape[0] and 0 <= column < grid.shape[1]
    return not inside or grid[cell] == OCCUPIED


def episodes_in_a_crowd(metres, period):
    """Steps of two episodes of robots that go and stay at random, and whether one begins."""
    config = ArenaConfig(
        8,
        8,
        num_agents=9,
        communication_range=metres,
        obstacle_density=0.25,
        move_period=period,
    )
    env = ExplorationEnv(config, num_envs=6, max_steps=40)
    for _ in range(2):
        now = env.reset()
        for step in range(15):
            yield now, step == 0
            action = random_allowed(now["agents", "action_mask"][..., : STAY + 1])
            now = env.step(now.set(("agents", "action"), action))["next"]


def is_beside_a_stranger(now, batch, robot):
    """Whether a robot stands beside one to which it has no link, and could be reached by it."""
    walls, linked = now["obstacles"][batch], now["agents", "linked"][batch, robot]
    places = now["agents", "position"][batch].tolist()
    row, column = places[robot]
    return any(
        max(abs(r - row), abs(c - column)) == 1
        and not linked[other]
        and not (walls[r, column] and walls[row, c])
        for other, (r, c) in enumerate(places)
    )

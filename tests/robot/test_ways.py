"""Cells that are the only way for others, and how robots leave them."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from marl_explore import ArenaConfig, ExplorationEnv
from marl_explore.config.constants import COMPASS, OCCUPIED, STAY
from marl_explore.core.motion import crowded, random_allowed
from marl_explore.policies.observations import robot_observation
from marl_explore.robot.ways import is_crowded, is_only_way, step_aside
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


@pytest.mark.parametrize("metres", [0.0, 0.3, 3.2])
def test_crowded_is_who_has_a_strange_robot_beside_it(metres):
    """In torch and numpy, against the arenas themselves: robots know walls beside them."""
    config = ArenaConfig(8, 8, num_agents=9, communication_range=metres, obstacle_density=0.25)
    env = ExplorationEnv(config, num_envs=6, max_steps=40)
    now, seen = env.reset(), set()
    for _ in range(20):
        agents = now["agents"]
        keys = ("map", "position", "linked", "action_mask")
        found = crowded(*(agents[key] for key in keys)).tolist()
        place, linked, walls = agents["position"].tolist(), agents["linked"], now["obstacles"]
        for batch, robot in itertools.product(range(6), range(9)):
            row, column = place[batch][robot]
            strange = any(
                max(abs(r - row), abs(c - column)) == 1
                and not linked[batch, robot, other]
                and not (walls[batch, r, column] and walls[batch, row, c])
                for other, (r, c) in enumerate(place[batch])
            )
            assert found[batch][robot] == strange
            assert is_crowded(robot_observation(now, batch, robot)) == strange
            seen.add(strange)
        action = random_allowed(agents["action_mask"][..., : STAY + 1])
        now = env.step(now.set(("agents", "action"), action))["next"]
    assert seen == ({False} if metres > 1 else {False, True})

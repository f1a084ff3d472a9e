"""Cells that are the only way for others, and how robots leave them."""

from __future__ import annotations

import numpy as np
import pytest

from marl_explore.config.constants import COMPASS, OCCUPIED, STAY
from marl_explore.robot.ways import is_only_way, step_aside
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

"""Who goes where, on drawn boards; and that any order of the agreed ways holds no cell twice."""

from __future__ import annotations

import random

from hypothesis import given
from hypothesis import strategies as st

from marl_explore.config.constants import COMPASS
from marl_explore.robot.agreement import agree, target
from marl_explore.robot.messages import Intent
from tests.helpers.boards import actions, arena
from tests.helpers.strategies import repeatable


def ways(board, names):
    obstacles, positions = arena(board)
    return agree(intents(obstacles.tolist(), positions.tolist(), actions(names).tolist()))


def intents(obstacles, cells, chosen):
    """Robots that know all obstacles, and mean moves to free cells."""

    def free(row, column):
        inside = 0 <= row < len(obstacles) and 0 <= column < len(obstacles[0])
        return inside and not obstacles[row][column]

    told = {}
    for robot, ((row, column), action) in enumerate(zip(cells, chosen, strict=True)):
        up, side = COMPASS[action] if action < 8 else (0, 0)
        sides = free(row + up, column), free(row, column + side)
        if not free(row + up, column + side) or (up and side and not any(sides)):
            action = 8
        told[robot] = Intent(robot, 0, (row, column), action, *sides)
    return told


def cells(board, names):
    return [way.cells for _, way in sorted(ways(board, names).items())]


def test_straight_moves_are_one_leg_and_diagonals_two():
    assert cells("...\n.0.\n...", "N") == [((0, 1),)]
    assert cells("...\n.0.\n...", "NE") == [((0, 1), (0, 2))]
    assert cells(".#.\n.0.\n...", "NE") == [((1, 2), (0, 2))]
    assert cells("...\n.0.\n...", "talk") == [()]


def test_contenders_crossers_and_moves_to_held_cells_are_refused():
    assert cells("0.1", "E W") == [(), ()]
    assert cells("01", "E W") == [(), ()]
    assert cells("01.", "E E") == [(), ((0, 2),)]
    assert cells("01\n..", "SE SW") == [(), ()]


def test_beside_a_diagonal_the_free_side_is_taken():
    # robot 1 stands north of robot 0
    assert cells("1.\n0.", "NE stay") == [((1, 1), (0, 1)), ()]
    assert cells("1.\n0#", "NE stay") == [(), ()]


def test_who_needs_a_cell_that_another_leaves_goes_after_it():
    assert cells(".1.\n.0#", "NE N") == [(), ()]  # robot 1 would leave the arena, so it stays
    told = ways("...\n.1.\n.0#", "NE N")
    assert told[0].cells == ((1, 1), (1, 2))
    assert told[0].after == {1}
    assert told[1].after == set()


def test_who_passes_where_another_ends_goes_before_it():
    told = ways(".1.\n0..\n#..", "SE S")
    assert told[0].cells == ((1, 1), (2, 1))
    assert told[1].cells == ((1, 1),)
    assert (told[0].after, told[1].after) == (set(), {0})


def test_two_diagonals_by_one_cell_go_one_after_the_other():
    told = ways(".1#\n0..\n#..", "SE SE")
    assert told[0].cells == ((1, 1), (2, 1))
    assert told[1].cells == ((1, 1), (1, 2))
    assert (told[0].after, told[1].after) == (set(), {0})


@repeatable(max_examples=300)
@given(seed=st.integers(0, 2**32 - 1))
def test_agreed_ways_never_hold_a_cell_twice_in_any_order(seed):
    """Robots start as soon as they may, in random order, and take their legs one by one."""
    chance = random.Random(seed)
    height, width = chance.randint(2, 6), chance.randint(2, 6)
    places = [(r, c) for r in range(height) for c in range(width)]
    walls = set(chance.sample(places, len(places) // 5))
    obstacles = [[(r, c) in walls for c in range(width)] for r in range(height)]
    free = [place for place in places if place not in walls]
    robots = chance.sample(free, min(len(free), chance.randint(1, 8)))
    told = intents(obstacles, robots, [chance.randrange(10) for _ in robots])
    agreed = agree(told)

    at = dict(enumerate(robots))
    legs = {robot: list(way.cells) for robot, way in agreed.items()}
    left = [robot for robot in legs if legs[robot]]
    arrived = set()
    while left:
        ready = [r for r in left if agreed[r].after <= arrived]
        assert ready, "robots wait for each other"
        robot = chance.choice(ready)
        step = legs[robot].pop(0)
        row, column = step[0] - at[robot][0], step[1] - at[robot][1]
        assert abs(row) + abs(column) == 1
        assert not obstacles[step[0]][step[1]]
        assert step not in [cell for other, cell in at.items() if other != robot]
        at[robot] = step
        if not legs[robot]:
            left.remove(robot)
            arrived.add(robot)
    for robot, way in agreed.items():
        assert at[robot] == (target(told[robot]) if way.cells else robots[robot])

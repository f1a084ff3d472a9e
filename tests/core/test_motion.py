"""Which moves are refused, and which actions are offered: a drawn board per clause."""

from __future__ import annotations

import math

import pytest
import torch

from marl_explore.config.shapes import Sight
from marl_explore.core.links import within_range
from marl_explore.core.motion import action_mask, dangerous_moves, move, open_moves
from marl_explore.core.sensing import bordered, surroundings
from tests.helpers.boards import ACTIONS, actions, arena


def around(obstacles, position):
    return surroundings(bordered(obstacles, 1), position, Sight.square(1))


def refused_moves(obstacles, position, action):
    """``dangerous_moves`` of robots that may all communicate."""
    reach = torch.ones(len(position), 2, dtype=torch.bool)
    mask = action_mask(open_moves(around(obstacles, position)), reach)
    return dangerous_moves(mask, position, action)


def check(before, names, after, refused=frozenset()):
    """All act at once on the board ``before``; hold the board after it and who was refused."""
    obstacles, position = arena(before)
    _, expected = arena(after)
    action = actions(names)
    dangerous = refused_moves(obstacles, position, action)
    assert set(dangerous.nonzero().flatten().tolist()) == set(refused)
    assert move(position, action, dangerous).tolist() == expected.tolist()


# ---------------------------------------------------------------- one robot


@pytest.mark.parametrize(
    ("name", "row", "column"),
    [
        ("N", 0, 1),
        ("NE", 0, 2),
        ("E", 1, 2),
        ("SE", 2, 2),
        ("S", 2, 1),
        ("SW", 2, 0),
        ("W", 1, 0),
        ("NW", 0, 0),
        ("stay", 1, 1),
        ("talk", 1, 1),
    ],
)
def test_each_action_leads_to_its_cell(name, row, column):
    obstacles, position = arena("""
        ...
        .0.
        ...
    """)
    dangerous = refused_moves(obstacles, position, actions(name))
    assert dangerous.tolist() == [False]
    assert move(position, actions(name), dangerous).tolist() == [[row, column]]


@pytest.mark.parametrize("name", ACTIONS[:8])
def test_a_move_out_of_the_arena_is_refused(name):
    check("0", name, "0", refused={0})


@pytest.mark.parametrize("name", ["NW", "N", "NE", "W", "SW"])
def test_a_move_beyond_a_corner_is_refused(name):
    """The cell one column or row further must not wrap round to the other side."""
    board = """
        0..
        ...
        ...
    """
    check(board, name, board, refused={0})


@pytest.mark.parametrize("name", ["NE", "E", "SE", "S", "SW"])
def test_a_move_beyond_the_opposite_corner_is_refused(name):
    board = """
        ...
        ...
        ..0
    """
    check(board, name, board, refused={0})


@pytest.mark.parametrize("name", ACTIONS[:8])
def test_a_move_into_an_obstacle_is_refused(name):
    board = """
        ###
        #0#
        ###
    """
    check(board, name, board, refused={0})


@pytest.mark.parametrize("name", ["NE", "SE", "SW", "NW"])
def test_a_diagonal_between_two_obstacles_is_refused(name):
    board = """
        .#.
        #0#
        .#.
    """
    check(board, name, board, refused={0})


@pytest.mark.parametrize(
    ("name", "before", "after"),
    [
        ("NE", ".#.\n.0.\n...", ".#0\n...\n..."),
        ("NE", "...\n.0#\n...", "..0\n..#\n..."),
        ("SE", "...\n.0#\n...", "...\n..#\n..0"),
        ("SE", "...\n.0.\n.#.", "...\n...\n.#0"),
        ("SW", "...\n.0.\n.#.", "...\n...\n0#."),
        ("SW", "...\n#0.\n...", "...\n#..\n0.."),
        ("NW", "...\n#0.\n...", "0..\n#..\n..."),
        ("NW", ".#.\n.0.\n...", "0#.\n...\n..."),
    ],
)
def test_a_diagonal_beside_one_obstacle_is_fine(name, before, after):
    check(before, name, after)


def test_robots_do_not_close_a_diagonal():
    check("01\n2.", "SE stay stay", ".1\n20")
    check("0#\n1.", "SE stay", ".#\n10")


@pytest.mark.parametrize("name", ["stay", "talk"])
def test_staying_and_communicating_are_never_dangerous(name):
    check("###\n#0#\n###", name, "###\n#0#\n###")


# ---------------------------------------------------------------- cells held by robots


@pytest.mark.parametrize("name", ["stay", "talk"])
def test_a_move_into_a_resting_robot_is_refused_and_that_robot_is_not_blamed(name):
    check("01", f"E {name}", "01", refused={0})


def test_a_move_into_a_robot_is_refused_even_if_that_robot_leaves():
    check("01.", "E E", "0.1", refused={0})
    check("01.", "E W", "01.", refused={0, 1})


def test_a_train_of_robots_only_moves_its_head():
    check("012.", "E E E", "01.2", refused={0, 1})


def test_robots_cannot_swap():
    check("01", "E W", "01", refused={0, 1})
    check("0.\n.1", "SE NW", "0.\n.1", refused={0, 1})


def test_robots_cannot_rotate():
    check("01\n.2", "E S NW", "01\n.2", refused={0, 1, 2})


# ---------------------------------------------------------------- contended cells


@pytest.mark.parametrize(
    ("board", "names"),
    [
        ("0.1", "E W"),
        ("0\n.\n1", "S N"),
        ("0.\n1.", "E NE"),
        ("0..\n...\n..1", "SE NW"),
        ("0..\n...\n.1.", "SE N"),
    ],
)
def test_two_robots_with_the_same_target_are_both_refused(board, names):
    check(board, names, board, refused={0, 1})


def test_three_robots_with_the_same_target_are_all_refused():
    board = """
        .0.
        1.2
        ...
    """
    check(board, "S E W", board, refused={0, 1, 2})


def test_others_move_while_two_contend():
    check("0.1\n2..", "E W E", "0.1\n.2.", refused={0, 1})


def test_a_contender_that_is_refused_for_another_reason_still_contends():
    squeezed = """
        0#.
        #.1
    """
    check(squeezed, "SE W", squeezed, refused={0, 1})
    crossed = """
        01.
        ..2
    """
    check(crossed, "SE SW W", crossed, refused={0, 1, 2})


def test_both_contenders_for_an_obstacle_or_a_held_cell_are_refused():
    check("0#1", "E W", "0#1", refused={0, 1})
    check("021", "E W stay", "021", refused={0, 1})


def test_a_cell_is_not_freed_when_its_contenders_are_refused():
    """Robot 2 follows robot 0, who leaves no cell because robot 1 wants the same."""
    check("20.1", "E W E", "20.1", refused={0, 1, 2})


def test_a_robot_that_stays_or_communicates_is_no_contender():
    check("0..1", "E stay", ".0.1")
    check("0..1", "E talk", ".0.1")


# ---------------------------------------------------------------- crossings


@pytest.mark.parametrize(
    ("board", "names"),
    [
        ("01\n..", "SE SW"),
        ("..\n01", "NE NW"),
        ("0.\n1.", "SE NE"),
        (".0\n.1", "SW NW"),
    ],
)
def test_crossing_diagonals_are_both_refused(board, names):
    check(board, names, board, refused={0, 1})


def test_crossing_a_mover_that_is_refused_for_another_reason_is_refused():
    into_obstacle = """
        01
        .#
    """
    check(into_obstacle, "SE SW", into_obstacle, refused={0, 1})
    into_robot = """
        01
        .2
    """
    check(into_robot, "SE SW stay", into_robot, refused={0, 1})
    contended = """
        01
        ..
        2.
    """
    check(contended, "SE SW NE", contended, refused={0, 1, 2})


def test_moves_side_by_side_do_not_cross():
    check("01.\n...", "SE SE", "...\n.01")
    check("0.\n1.", "E E", ".0\n.1")
    check("01.\n...", "S SE", "...\n0.1")


def test_a_diagonal_past_a_robot_that_stays_is_no_crossing():
    check("01\n..", "SE stay", ".1\n.0")
    check("01\n..", "SE talk", ".1\n.0")


# ---------------------------------------------------------------- the action mask


def offered(board, range_cells):
    """Names of the actions that the mask allows, one string a robot."""
    obstacles, position = arena(board)
    mask = action_mask(open_moves(around(obstacles, position)), within_range(position, range_cells))
    return [
        " ".join(name for name, allowed in zip(ACTIONS, row, strict=True) if allowed)
        for row in mask.tolist()
    ]


def test_in_the_open_every_action_is_offered():
    board = """
        ....1
        .0...
        .....
    """
    assert offered(board, math.inf)[0] == " ".join(ACTIONS)


def test_the_mask_hides_moves_whose_danger_is_visible():
    board = """
        #0.
        .#1
    """
    # robot 0: SE is held, S and W are obstacles, SW lies between them, the north is outside
    # robot 1: NW is held, W is an obstacle, the rest is outside
    assert offered(board, 0) == ["E stay", "N stay"]


def test_the_mask_does_not_foresee_what_others_choose():
    assert offered("0.1", 0) == ["E stay", "W stay"]
    # both diagonals are offered, though choosing both would cross
    assert offered("01\n..", 0) == ["SE S stay", "S SW stay"]


def test_robots_mask_their_cells_but_not_the_diagonal_between_them():
    assert offered("01\n2.", 0)[0] == "SE stay"


def test_communicating_is_offered_when_another_robot_is_in_range():
    board = "0.1...2"
    assert [names.endswith("talk") for names in offered(board, 2)] == [True, True, False]
    assert [names.endswith("talk") for names in offered(board, 4)] == [True, True, True]
    assert [names.endswith("talk") for names in offered(board, 1)] == [False, False, False]


def test_a_robot_alone_can_never_communicate():
    assert offered("0", math.inf) == ["stay"]

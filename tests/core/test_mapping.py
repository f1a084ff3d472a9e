"""Sensing, merging, and which cells there are to map, on drawn boards."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given

from marl_explore.config.shapes import Sight
from marl_explore.core.grid import OCCUPIED
from marl_explore.core.mapping import (
    blank_maps,
    connected,
    draw,
    known_cells,
    known_mask,
    known_targets,
    merge,
    reachable_cells,
    target_cells,
)
from marl_explore.core.sensing import bordered, field_of_view, sense, surroundings
from tests.helpers import oracle
from tests.helpers.boards import arena, map_cells
from tests.helpers.strategies import repeatable, scenarios


def around(obstacles, position, radius=1, occlusion=False):
    sight = replace(Sight.square(radius), line_of_sight=occlusion)
    return surroundings(bordered(obstacles, radius), position, sight)


def view(board, radius=1, occlusion=False, robot=0):
    """What a robot's sensor reads, a string of 0 and 1 a row."""
    values = field_of_view(around(*arena(board), radius, occlusion))[robot]
    return ["".join(str(int(value)) for value in row) for row in values.tolist()]


def sensed(board, radius=1, occlusion=False):
    """The maps of all robots after sensing once."""
    obstacles, position = arena(board)
    blank = blank_maps(position, *obstacles.shape)
    everything = torch.ones_like(obstacles)
    view = around(obstacles, position, radius, occlusion)
    grid, discovered, targets = sense(blank, view, position, everything)
    assert (1 + discovered).tolist() == known_cells(known_mask(grid)).tolist()
    assert targets.equal(discovered)
    return grid


def marked(cells):
    """A drawing of a bool grid, x where it is True."""
    return ["".join("x" if cell else "." for cell in row) for row in cells.tolist()]


# ---------------------------------------------------------------- field of view


def test_obstacles_and_other_robots_read_1_and_the_own_cell_0():
    board = """
        .....
        .#1..
        ..0.#
        .2...
    """
    assert view(board) == ["110", "000", "100"]
    assert view(board, robot=1) == ["000", "100", "010"]


def test_the_outside_reads_1():
    assert view("0..\n...\n...") == ["111", "100", "100"]
    assert view("...\n...\n..0") == ["001", "001", "111"]
    assert view("0") == ["111", "101", "111"]


def test_a_wider_field_of_view_is_north_up_and_row_by_row():
    board = """
        #......
        .....1.
        .......
        ...0...
        .#.....
        .......
    """
    assert view(board, radius=2) == ["00001", "00000", "00000", "10000", "00000"]
    assert view(board, radius=3)[0] == "1000000"
    assert view(board, radius=3)[1] == "0000010"
    assert view(board, radius=3)[6] == "1111111"


def test_two_obstacles_hide_the_diagonal_cell_behind_them():
    board = """
        .#.
        #0.
        .#.
    """
    assert view(board) == ["010", "100", "010"]
    assert view(board, occlusion=True) == ["110", "100", "110"]


@pytest.mark.parametrize(
    ("board", "seen"),
    [
        (".#.\n.0#\n...", ["011", "001", "000"]),
        ("...\n.0#\n.#.", ["000", "001", "011"]),
        ("...\n#0.\n.#.", ["000", "100", "110"]),
        (".#.\n#0.\n...", ["110", "100", "000"]),
    ],
    ids=["NE", "SE", "SW", "NW"],
)
def test_each_corner_is_hidden_by_its_own_two_sides(board, seen):
    assert view(board, occlusion=True) == seen


def test_robots_and_the_outside_hide_nothing():
    beside_robots = """
        .1.
        20.
        .#.
    """
    assert view(beside_robots, occlusion=True) == ["010", "100", "010"]
    # west is outside and north an obstacle, but no cell inside lies behind both
    assert view("#.\n0.\n..", occlusion=True) == view("#.\n0.\n..") == ["110", "100", "100"]


# ---------------------------------------------------------------- sensing


def test_sensing_writes_obstacles_and_free_cells_but_no_robots():
    maps = sensed("""
        #....
        .01..
        ..#..
        .....
    """)
    assert maps[0].equal(
        map_cells("""
        #..??
        ...??
        ..#??
        ?????
    """)
    )
    assert maps[1].equal(
        map_cells("""
        ?...?
        ?...?
        ?.#.?
        ?????
    """)
    )


def test_a_wider_sensor_writes_a_wider_square_cut_at_the_border():
    (map_,) = sensed(
        """
        ......
        .0..#.
        ...#..
        ......
        ......
    """,
        radius=2,
    )
    assert map_.equal(
        map_cells("""
        ....??
        ....??
        ...#??
        ....??
        ??????
    """)
    )


def test_sensing_keeps_what_was_known():
    obstacles, position = arena("0....")
    before = map_cells(".??.?").unsqueeze(0)
    target = torch.tensor([[True, False, True, True, True]])
    after = sense(before, around(obstacles, position), position, target)
    assert after.map.equal(map_cells("..?.?").unsqueeze(0))
    assert after.discovered.tolist() == [1]
    assert after.targets.tolist() == [0]
    assert sense(before, around(obstacles, position), position, ~target).targets.tolist() == [1]
    assert before.equal(map_cells(".??.?").unsqueeze(0))


def test_a_hidden_cell_stays_unknown_in_the_map():
    board = """
        .#.
        #0.
        .#.
    """
    seen = map_cells("""
        ?#.
        #..
        ?#.
    """)
    assert sensed(board, occlusion=True).equal(seen.unsqueeze(0))


def test_hiding_does_not_erase_what_was_known():
    obstacles, position = arena(".#\n#0")
    before = map_cells(".?\n?.").unsqueeze(0)
    after = sense(before, around(obstacles, position, occlusion=True), position, obstacles)
    assert after.map.equal(map_cells(".#\n#.").unsqueeze(0))
    assert after.discovered.tolist() == [2]


# ---------------------------------------------------------------- merging


def merged_maps(maps, group, obstacles):
    known = merge(known_mask(maps).flatten(1), torch.tensor(group))
    return draw(known.view(maps.shape), obstacles)


def test_members_of_a_network_get_the_union_and_others_keep_theirs():
    maps = torch.stack([map_cells("#.???"), map_cells("??.??"), map_cells("????#")])
    merged = merged_maps(maps, [1, 1, 2], map_cells("#...#") == OCCUPIED)
    assert merged.equal(torch.stack([map_cells("#..??"), map_cells("#..??"), map_cells("????#")]))


def test_networks_do_not_mix_their_maps():
    maps = torch.stack([map_cells(board) for board in (".???", "?.??", "??.?", "???#")])
    expected = torch.stack([map_cells(board) for board in (".?.?", "?.?#", ".?.?", "?.?#")])
    assert merged_maps(maps, [0, 1, 0, 1], map_cells("...#") == OCCUPIED).equal(expected)


def test_without_a_network_nothing_changes():
    maps = torch.stack([map_cells("#.???"), map_cells("??.??")])
    assert merged_maps(maps, [0, 1], map_cells("#....") == OCCUPIED).equal(maps)


def test_known_cells_counts_free_and_occupied_ones():
    assert known_cells(known_mask(map_cells("??.\n#.?"))).item() == 3
    assert known_cells(known_mask(map_cells("???"))).item() == 0


# ---------------------------------------------------------------- cells to map


def test_reachable_cells_follow_the_diagonal_rule():
    board = """
        0#..
        #...
        ....
    """
    assert marked(reachable_cells(*arena(board))) == ["x...", "....", "...."]
    gap = """
        0.#.
        #...
        ....
    """
    assert marked(reachable_cells(*arena(gap))) == ["xx.x", ".xxx", "xxxx"]


def test_robots_do_not_block_one_another():
    assert marked(reachable_cells(*arena("0.1..#."))) == ["xxxxx.."]


def test_target_cells_are_the_reachable_ones_and_their_4_neighbours():
    board = """
        0.#.
        ..#.
        ####
        ....
    """
    # the obstacle in the third column of row 2 touches the room only by its corner
    assert marked(target_cells(*arena(board))) == ["xxx.", "xxx.", "xx..", "...."]
    turned = """
        ....
        .###
        .#0.
    """
    assert marked(target_cells(*arena(turned))) == ["....", "..xx", ".xxx"]


def test_what_any_robot_can_reach_is_a_target():
    assert marked(target_cells(*arena("0.#.1"))) == ["xxxxx"]
    assert marked(target_cells(*arena("0.##.1.#."))) == ["xxxxxxxx."]


def test_known_targets_counts_no_cells_beyond_the_targets():
    obstacles, position = arena("0.##.")
    target = target_cells(obstacles, position)  # the first three cells
    maps = torch.stack([map_cells("..?#."), map_cells("..#??")])
    assert known_targets(known_mask(maps), target).tolist() == [2, 3]


@pytest.mark.parametrize(
    ("board", "joined"),
    [
        ("...\n...", True),
        (".#.\n.#.", False),
        (".#\n#.", False),  # the only way is between two obstacles
        (".#\n..", True),
        ("##\n##", True),  # nothing is cut off from nothing
        ("#.\n##", True),
        (".#.", False),
    ],
)
def test_connected_means_that_legal_moves_join_all_free_cells(board, joined):
    obstacles, _ = arena(board)
    assert connected(obstacles).item() is joined


@repeatable(max_examples=60)
@given(scenario=scenarios(max_side=9, max_steps=1))
def test_connected_agrees_with_the_reference(scenario):
    expected = [oracle.connected(obstacles) for obstacles in scenario.obstacles.tolist()]
    assert connected(scenario.obstacles).tolist() == expected

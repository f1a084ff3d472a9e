"""The oracle of the wider world, held against boards worked out by hand and the paper's oracle."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from itertools import count

import pytest
import torch

from marl_explore.core import hashing
from tests.helpers import oracle
from tests.helpers import world_oracle as slow
from tests.helpers.boards import ACTIONS, arena, known_map, map_cells
from tests.helpers.world_oracle import Settings, World

EAST, STAY, TALK = (ACTIONS.index(name) for name in ("E", "stay", "talk"))
DISC_2 = {"cell_size": 1.0, "sensing_shape": "disc", "sensing_range": 2.0}


def drawn(board):
    """Obstacles and positions of a drawn arena, as lists."""
    obstacles, positions = arena(board)
    return obstacles.tolist(), [tuple(cell) for cell in positions.tolist()]


def settings_for(board, **changes):
    """Settings of a drawn arena: cells of 1 m, a 3 x 3 field of view, endless radio."""
    obstacles, positions = drawn(board)
    plain = {"cell_size": 1.0, "sensing_range": 2.2, "communication_range": math.inf}
    size = {"height": len(obstacles), "width": len(obstacles[0]), "num_agents": len(positions)}
    return Settings(**{**size, **plain, **changes})


def world_on(board, *, key=1, alive=None, walkers=None, **changes):
    """A drawn arena at its start; ``walkers`` are cells."""
    if walkers is not None:
        changes["num_walkers"] = len(walkers)
    return World(settings_for(board, **changes), *drawn(board), key, alive=alive, walkers=walkers)


def play(world, *steps):
    """The frame after the steps, each a line of actions by name."""
    for names in steps:
        world.step([ACTIONS.index(name) for name in names.split()])
    return world.frame


def failed(world, robot):
    """The same arena, in which a robot has failed since the last step."""
    alive = [lives and i != robot for i, lives in enumerate(world.state.alive)]
    linked = slow.without(world.state.linked, alive)
    world.state = replace(world.state, alive=alive, linked=linked)
    world.frame = slow.frame(world.settings, world.state, None)
    return world


def allowed(frame, robot):
    """The names of the actions that a robot's mask allows."""
    return {name for name, may in zip(ACTIONS, frame.masks[robot], strict=True) if may}


def pairs(linked):
    """Pairs (i, j), i < j, of a symmetric matrix that is True on its diagonal."""
    robots = range(len(linked))
    assert all(linked[i][i] for i in robots)
    assert all(linked[i][j] == linked[j][i] for i in robots for j in robots)
    return {(i, j) for i in robots for j in robots if i < j and linked[i][j]}


def random_board(generator, height, width, share):
    return [[generator.random() < share for _ in range(width)] for _ in range(height)]


def flipped(grid, rows, columns, swap):
    """A grid under one of the eight symmetries of the square."""
    grid = grid[::-1] if rows else grid
    grid = [row[::-1] for row in grid] if columns else grid
    return [list(column) for column in zip(*grid, strict=True)] if swap else grid


SYMMETRIES = [(r, c, s) for r in (False, True) for c in (False, True) for s in (False, True)]


# ---------------------------------------------------------------- draws


def test_combine_and_keys_of_names_are_those_of_the_package():
    generator = random.Random(1)
    for length in range(1, 6):
        parts = [generator.randrange(-(2**63), 2**63) for _ in range(length)]
        assert slow.combine(*parts) == int(hashing.combine(*parts))
    for name in ("failure", "message", "shadow", "walker-start", "walker", "test"):
        assert slow.name_key(name) == hashing.text_key(name)
    for episode in range(3):
        package = hashing.combine(hashing.stream_seed("train", 2**64 - 1), 11, episode)
        assert slow.draw_key("train", 2**64 - 1, 11, episode) == int(package)


def test_a_draw_is_the_upper_53_bits_of_the_hash_of_a_batch():
    keys = torch.tensor([-5, 0, 2**62, -(2**63)])
    batch = hashing.combine(keys, hashing.text_key("message"), 0, 3, 17)
    for key, value in zip(keys.tolist(), batch.tolist(), strict=True):
        assert slow.uniform(key, "message", 0, 3, 17) == (value % 2**64 // 2**11) / 2**53


def test_draws_are_frozen_and_lie_in_the_unit_interval():
    assert slow.draw_key("test", 3, 5, 2) == -9097462408543735693
    assert slow.uniform(7, "failure", 0, 0) == pytest.approx(0.1737617789)
    draws = [slow.uniform(7, "failure", i, t) for i in range(4) for t in range(500)]
    assert 0 <= min(draws) < 0.01
    assert 0.99 < max(draws) < 1
    assert sum(draws) / len(draws) == pytest.approx(0.5, abs=0.02)


def test_events_of_probability_0_never_happen_and_of_1_always():
    assert not any(slow.happens(0.0, key, "failure", 0, 0) for key in range(300))
    assert all(slow.happens(1.0, key, "failure", 0, 0) for key in range(300))


def test_box_and_muller_by_hand():
    assert slow.standard_normal(0.0, 0.3) == 0  # the logarithm of 1
    assert slow.standard_normal(1 - math.exp(-2), 0.0) == pytest.approx(2)
    assert slow.standard_normal(1 - math.exp(-1 / 2), 0.5) == pytest.approx(-1)
    assert slow.standard_normal(0.5, 0.25) == pytest.approx(0)  # a quarter turn


def test_shadowing_of_one_pair():
    """u0 = 0.96432790 and u1 = 0.71744610 give sqrt(6.66671) cos(4.50785) = -0.52445."""
    config = Settings(shadowing_db=4.0)
    assert slow.uniform(7, "shadow", 0, 1, 0) == pytest.approx(0.96432790)
    assert slow.uniform(7, "shadow", 0, 1, 1) == pytest.approx(0.71744610)
    assert slow.shadowing(config, 7, 0, 1) == pytest.approx(4 * -0.5244549)
    assert slow.shadowing(config, 7, 1, 0) == slow.shadowing(config, 7, 0, 1)
    assert slow.shadowing(config, 7, 1, 2) == pytest.approx(4 * 0.4417738)
    assert slow.shadowing(Settings(), 7, 1, 2) == 0


# ---------------------------------------------------------------- shapes


@pytest.mark.parametrize(
    ("shape", "range_m", "cells", "most"),
    [
        ("square", 1.1, 9, 5),  # k = 1
        ("square", 1.8, 25, 9),  # k = 2
        ("disc", 0.71, 9, 5),  # the smallest one: sqrt(2) cells, without (0, 2)
        ("disc", 1.1, 13, 5),  # 3 x 3 and the four cells two steps away
        ("disc", 1.5, 29, 9),  # rows of 1, 5, 5, 7, 5, 5, 1; a diagonal move beats the 7 of E
    ],
)
def test_cells_of_shapes_and_most_discoveries(shape, range_m, cells, most):
    config = Settings(sensing_shape=shape, sensing_range=range_m)
    assert len(slow.shape(config, 0)) == cells
    assert slow.max_discovery(config, 0) == most


def test_a_disc_has_the_tolerance_of_real_distances():
    config = Settings(cell_size=0.1, sensing_shape="disc", sensing_range=0.3)  # 0.3 / 0.1 < 3
    assert slow.radius(config, 0) == 3
    assert (0, 3) in slow.shape(config, 0)


def test_robots_share_the_largest_window_and_see_their_own_shape():
    frame = world_on("0......1", sensing_range=(2.2, 3.6)).frame  # k = 1 and k = 2
    assert frame.fov[0] == [
        [1, 1, 1, 1, 1],
        [1, 1, 1, 1, 1],
        [1, 1, 0, 0, 1],
        [1, 1, 1, 1, 1],
        [1, 1, 1, 1, 1],
    ]
    assert frame.fov[1][2] == [0, 0, 0, 1, 1]
    assert frame.maps[0] == map_cells("..??????").tolist()
    assert frame.maps[1] == map_cells("?????...").tolist()


def test_what_a_robot_finds_is_judged_by_its_own_most_discoveries():
    world = world_on("0............1", sensing_range=(2.2, 3.6))
    assert play(world, "E W").rewards["case2"] == [1 / 5, 1 / 9]


def test_a_tuple_needs_an_entry_for_every_robot():
    with pytest.raises(ValueError, match="move_period"):
        world_on("0..1", move_period=(1, 2, 3))


# ---------------------------------------------------------------- sight


@pytest.mark.parametrize(
    ("offset", "expected"),
    [
        ((0, 1), {(0, 0)}),
        ((1, 1), {(0, 0)}),
        ((0, 2), {(0, 1)}),
        ((1, 2), {(0, 1), (1, 1)}),  # (1/2, 1)
        ((-1, 2), {(0, 1), (-1, 1)}),
        ((2, 2), {(1, 1)}),
        ((1, 3), {(1, 2)}),  # (2/3, 2)
        ((2, 3), {(1, 2)}),  # (4/3, 2)
        ((1, 4), {(1, 3)}),  # (3/4, 3)
        ((-2, -4), {(-1, -3), (-2, -3)}),  # (-3/2, -3)
        ((4, 3), {(3, 2)}),  # (3, 9/4)
        ((3, -6), {(2, -5), (3, -5)}),  # (5/2, -5)
        ((6, 2), {(5, 2)}),  # (5, 5/3)
    ],
)
def test_parents(offset, expected):
    assert set(slow.parents(offset)) == expected
    assert len(slow.parents(offset)) == len(expected)


def picture(board, k):
    """The board as it is seen from ``0``, unseen cells as ``?``."""
    obstacles, (center,) = drawn(board)
    seen = slow.in_sight(obstacles, center, k)
    return [
        "".join(s if (r, c) in seen else "?" for c, s in enumerate(line))
        for r, line in enumerate(board.split())
    ]


@pytest.mark.parametrize(
    ("board", "seen"),
    [
        # straight behind an obstacle; (0, 1) is seen by way of (1, 1)
        ("..... ..#.. ..0..", "..?.. ..#.. ..0.."),
        # through a door: the two corners lie behind the wall
        ("..... ##.## ..0..", "?...? ##.## ..0.."),
        # (0, 1) would be seen by way of (1, 2), but for two obstacles that touch by a corner
        ("..#.. .#... ..0..", "??#.. .#... ..0.."),
        ("..... .#... #0...", "??... ?#... #0..."),
        ("... .0# .#.", "... .0# .#?"),
        # a wall hides all that is behind it
        ("..... ..... ##### ..0..", "????? ????? ##### ..0.."),
        # all around; of such a ring the corners are hidden too
        ("..... .###. .#0#. .###. .....", "????? ??#?? ?#0#? ??#?? ?????"),
        # along a wall: (0, 2) is seen by way of (0, 1), and (0, 3) by way of (0, 2)
        (".... 0#..", ".... 0#??"),
        (".#.. 0#..", ".#?? 0#??"),
        # (0, 3) has one parent, (0, 2), so (1, 2) hides nothing but (1, 3)
        (".... 0.#.", ".... 0.#?"),
        ("..#. 0...", "..#? 0..."),
    ],
)
def test_sight_by_hand(board, seen):
    assert picture(board, 3) == seen.split()


def test_two_parents_are_an_or():
    """(1, 2) is seen by way of (0, 1) or (1, 1)."""
    assert picture("0#. ...", 2) == ["0#?", "..."]
    assert picture("0.. .#.", 2) == ["0..", ".#."]
    assert picture("0#. .#.", 2) == ["0#?", ".#?"]


def test_sight_has_the_symmetries_of_the_square():
    generator = random.Random(2)
    for _ in range(60):
        board = random_board(generator, 9, 9, generator.choice((0.1, 0.25, 0.4)))
        board[4][4] = False
        seen = slow.in_sight(board, (4, 4), 4)
        grid = [[(r, c) in seen for c in range(9)] for r in range(9)]
        for symmetry in SYMMETRIES:
            mirrored = slow.in_sight(flipped(board, *symmetry), (4, 4), 4)
            expected = flipped(grid, *symmetry)
            assert [[(r, c) in mirrored for c in range(9)] for r in range(9)] == expected


def test_a_seen_obstacle_hides_what_is_straight_behind_it():
    generator = random.Random(3)
    for _ in range(200):
        board = random_board(generator, 9, 9, 0.2)
        board[4][4] = False
        seen = slow.in_sight(board, (4, 4), 4)
        for dr, dc in oracle.COMPASS:
            line = [(4 + n * dr, 4 + n * dc) for n in range(1, 5)]
            walls = [n for n, (r, c) in enumerate(line) if board[r][c]]
            if walls:
                assert not any(cell in seen for cell in line[walls[0] + 1 :])


def test_more_obstacles_never_show_more():
    generator = random.Random(4)
    for _ in range(150):
        board = random_board(generator, 9, 9, 0.2)
        board[4][4] = False
        more = [[cell or generator.random() < 0.1 for cell in row] for row in board]
        more[4][4] = False
        assert slow.in_sight(more, (4, 4), 4) <= slow.in_sight(board, (4, 4), 4)
    empty = random_board(generator, 9, 9, 0)
    assert len(slow.in_sight(empty, (4, 4), 4)) == 81
    assert len(slow.in_sight(empty, (0, 1), 4)) == 5 * 6


def test_sight_depends_on_the_rectangle_from_centre_to_cell_alone():
    generator = random.Random(5)
    for _ in range(150):
        board = random_board(generator, 9, 9, 0.3)
        board[4][4] = False
        cell = generator.randrange(9), generator.randrange(9)
        rows, columns = (range(min(4, x), max(4, x) + 1) for x in cell)
        other = random_board(generator, 9, 9, 0.5)
        for r in rows:
            for c in columns:
                other[r][c] = board[r][c]
        seen = cell in slow.in_sight(board, (4, 4), 4)
        assert seen == (cell in slow.in_sight(other, (4, 4), 4))


def test_sight_agrees_with_the_rule_of_occlusion():
    generator = random.Random(6)
    rules = oracle.Rules(height=6, width=7, num_agents=1, occlusion=True)
    hidden = 0
    for _ in range(150):
        board = random_board(generator, 6, 7, 0.4)
        for position in [(r, c) for r in range(6) for c in range(7) if not board[r][c]]:
            seen = slow.in_sight(board, position, 1)
            for offset in oracle.view_offsets(rules):
                cell = oracle.shifted(position, offset)
                is_hidden = oracle.hidden(rules, board, position, offset)
                hidden += is_hidden and oracle.inside(board, cell)
                assert (cell in seen) == (oracle.inside(board, cell) and not is_hidden)
    assert hidden > 500


def test_unseen_cells_read_1_and_stay_unknown():
    board = """
        .....
        ..#..
        ..0..
    """
    frame = world_on(board, **DISC_2, line_of_sight=True).frame
    assert frame.fov[0] == [
        [1, 1, 1, 1, 1],  # (0, 2) is hidden, the others lie outside the disc
        [1, 0, 1, 0, 1],
        [0, 0, 0, 0, 0],
        [1, 1, 1, 1, 1],
        [1, 1, 1, 1, 1],
    ]
    known = """
        ?????
        ?.#.?
        .....
    """
    assert frame.maps[0] == map_cells(known).tolist()
    through = world_on(board, **DISC_2).frame
    assert through.fov[0][0] == [1, 1, 0, 1, 1]
    assert through.maps[0][0] == [-1, -1, 0, -1, -1]


def test_robots_and_walkers_hide_nothing():
    frame = world_on("01..", **DISC_2, line_of_sight=True).frame
    assert frame.maps[0] == map_cells("...?").tolist()
    assert frame.fov[0][2] == [1, 1, 0, 1, 0]
    frame = world_on("0...", **DISC_2, line_of_sight=True, walkers=[(0, 1)]).frame
    assert frame.maps[0] == map_cells("...?").tolist()
    assert frame.fov[0][2] == [1, 1, 0, 1, 0]


# ---------------------------------------------------------------- expected gain


@pytest.mark.parametrize(
    ("board", "cell", "changes", "expected"),
    [
        ("@..??", (0, 2), {}, 1 / 9),
        ("@..??", (0, 3), {}, 2 / 9),
        ("@.???", (0, 1), DISC_2, 2 / 13),
        ("@.#??", (0, 1), DISC_2, 1 / 13),
        ("@.#??", (0, 1), {**DISC_2, "line_of_sight": True}, 0),
        ("@.???", (0, 1), {**DISC_2, "line_of_sight": True}, 2 / 13),  # as if free
        ("@??", (0, 1), {}, 2 / 9),  # outside counts nowhere
    ],
)
def test_expected_gain_by_hand(board, cell, changes, expected):
    grid, _ = known_map(board)
    config = Settings(height=1, width=len(board), num_agents=1, **changes)
    assert slow.expected_gain(config, 0, grid.tolist(), cell) == pytest.approx(expected)


def test_expected_gain_is_for_the_own_shape():
    grid, _ = known_map("@..????")
    config = Settings(height=1, width=7, num_agents=2, sensing_range=(1.1, 1.8))
    shares = [slow.expected_gain(config, robot, grid.tolist(), (0, 2)) for robot in (0, 1)]
    assert shares == [1 / 9, 2 / 25]


def test_a_move_finds_what_is_expected_if_unknown_cells_are_free_and_else_no_more():
    generator = random.Random(7)
    config = Settings(height=8, width=8, num_agents=1, **DISC_2, line_of_sight=True)
    for _ in range(60):
        board = random_board(generator, 8, 8, 0.25)
        board[3][3] = board[3][4] = False
        for _ in range(2):
            world = World(config, board, [(3, 3)], 1)
            known = world.frame.maps[0]
            hidden = [(r, c) for r in range(8) for c in range(8) if known[r][c] == oracle.UNKNOWN]
            expected = slow.expected_discovery(config, 0, known, (3, 4))
            found = world.step([EAST]).discovered[0]
            assert found <= expected
            if not any(board[r][c] for r, c in hidden):
                assert found == expected
            for r, c in hidden:  # the second time all unknown cells are free
                board[r][c] = False


# ---------------------------------------------------------------- links


@pytest.mark.parametrize(
    ("board", "walls"),
    [
        ("01", 0),
        ("0..1", 0),
        ("0.#.1", 1),
        ("0###1", 3),
        ("0# #1", 0),  # radio passes between two diagonal obstacles
        ("0.. .#. ..1", 1),
        ("0#. #.# .#1", 0),
        ("0# ## #1", 1),  # the point (1, 1/2): both cells are obstacles
        ("0# .# .1", 0),
        ("0. #. .1", 0),
        ("0#. .#1", 1),  # the same lying down
        ("0#. ..1", 0),
        ("0#.. ..#1", 2),  # (1/3, 1) and (2/3, 2)
        ("0.#. .#.1", 0),
        ("0#... ..#.. ...#1", 1),  # (1, 2); at (1/2, 1) and (3/2, 3) one of two cells is free
    ],
)
def test_walls_between_two_robots_by_hand(board, walls):
    obstacles, (start, end) = drawn(board)
    assert slow.walls_between(obstacles, start, end) == walls
    assert slow.walls_between(obstacles, end, start) == walls


def test_walls_between_have_the_symmetries_of_the_square():
    generator = random.Random(8)
    for _ in range(300):
        board = random_board(generator, 8, 8, 0.4)
        start, end = ((generator.randrange(8), generator.randrange(8)) for _ in range(2))
        walls = slow.walls_between(board, start, end)
        assert slow.walls_between(board, end, start) == walls
        for rows, columns, swap in SYMMETRIES:
            mirrored = [
                (7 - r if rows else r, 7 - c if columns else c)[:: -1 if swap else 1]
                for r, c in (start, end)
            ]
            assert slow.walls_between(flipped(board, rows, columns, swap), *mirrored) == walls


@pytest.mark.parametrize(
    ("exponent", "table"),
    [
        # 10^(2 - 0.6 w): 100, 25.1, 6.3, 1.58, 0.40
        (2.0, [100, 25, 6, 1, 0, 0]),
        # 10^(2 - 0.48 w): 100, 33.1, 10.96, 3.6, 1.2, 0.40
        (2.5, [100, 33, 10, 3, 1, 0]),
    ],
)
def test_the_squared_reach_over_walls_by_hand(exponent, table):
    """R = 10 cells and 6 dB a wall."""
    config = Settings(communication_range=5.0, wall_loss_db=6.0, path_loss_exponent=exponent)
    assert [slow.reach_squared(config, 0, 1, walls, 0.0) for walls in range(6)] == table
    # a shadow of 6 dB is worth a wall, one of -6 dB takes a wall away
    assert [slow.reach_squared(config, 0, 1, walls, 6.0) for walls in range(5)] == table[1:]
    assert [slow.reach_squared(config, 0, 1, walls, -6.0) for walls in range(1, 6)] == table[:-1]


def test_walls_shorten_the_reach():
    config = {"communication_range": 10.0, "wall_loss_db": 6.0}
    assert pairs(world_on("0.#..1", **config).frame.linked) == {(0, 1)}  # 5 of 5.01 cells
    assert pairs(world_on("0.#...1", **config).frame.linked) == set()
    assert pairs(world_on("0.....1", **config).frame.linked) == {(0, 1)}
    assert pairs(world_on("0##.1", **config).frame.linked) == set()  # 4 of 2.51 cells


def test_an_infinite_loss_cuts_at_one_wall_and_at_any_range():
    board = "0#1..2"
    for cells in (10.0, math.inf):
        config = {"communication_range": cells, "wall_loss_db": math.inf}
        assert pairs(world_on(board, **config).frame.linked) == {(1, 2)}


def test_an_infinite_range_passes_any_finite_loss():
    config = {"wall_loss_db": 1e300, "shadowing_db": 50.0}
    assert pairs(world_on("0##1", **config).frame.linked) == {(0, 1)}


@pytest.mark.parametrize("shadow", [0.0, 1e9])
def test_a_range_of_zero_links_nobody(shadow):
    for key in range(20):
        frame = world_on("01", key=key, communication_range=0.0, shadowing_db=shadow).frame
        assert pairs(frame.linked) == set()
        assert allowed(frame, 0) == {"stay"}


def test_the_shorter_of_two_ranges_counts():
    config = {"communication_range": (2.0, 4.0, 4.0)}
    assert pairs(world_on("0...1...2", **config).frame.linked) == {(1, 2)}
    assert pairs(world_on("0.1.2....", **config).frame.linked) == {(0, 1), (1, 2)}


def test_without_walls_links_are_as_before():
    generator = random.Random(9)
    for cells in (0.0, 1.0, math.sqrt(2), 2.0, math.sqrt(5), 6.4, 0.3 / 0.1, math.inf):
        config = Settings(num_agents=8, cell_size=1.0, communication_range=cells)
        rules = oracle.Rules(12, 12, 8, communication_cells=cells)
        blank = random_board(generator, 12, 12, 0)
        spots = [(r, c) for r in range(12) for c in range(12)]
        for _ in range(10):
            state = oracle.reset(rules, blank, generator.sample(spots, 8))
            linked = slow.links(config, blank, state.positions, [True] * 8, 1)
            assert linked == oracle.in_range(rules, state)


def test_shadowing_changes_the_reach_of_a_pair_for_the_whole_episode():
    """X = -2.0978 dB reaches 10 x 10^(2.0978 / 20) = 12.73 cells with n = 2."""
    config = {"communication_range": 10.0, "shadowing_db": 4.0}
    twelve, thirteen = "0...........1...", "0............1.."
    assert pairs(world_on(twelve, key=7, **config).frame.linked) == {(0, 1)}
    assert pairs(world_on(thirteen, key=7, **config).frame.linked) == set()
    assert pairs(world_on(twelve, key=7, communication_range=10.0).frame.linked) == set()
    world = world_on(twelve, key=7, **config)
    links = [pairs(play(world, f"stay {move}").linked) for move in ("E", "W", "E", "W")]
    assert links == [set(), {(0, 1)}, set(), {(0, 1)}]


def test_radio_follows_the_robots_after_their_moves():
    world = world_on("0..1", communication_range=2.0)
    assert allowed(world.frame, 0) == {"E", "stay"}
    frame = play(world, "talk W")  # a masked action; they are in range when links count
    assert pairs(frame.linked) == {(0, 1)}
    assert allowed(frame, 0) == {"E", "stay", "talk"}
    assert frame.merged == [False, False]
    world = world_on("0...1.2", communication_range=2.0)
    assert play(world, "stay talk talk").merged == [False, True, True]


# ---------------------------------------------------------------- message loss


def key_losing(lost, kept, rate, t=0):
    """A draw key with which some messages are lost at time t and others are not."""
    return next(
        key
        for key in count()
        if all(slow.happens(rate, key, "message", *pair, t) for pair in lost)
        and not any(slow.happens(rate, key, "message", *pair, t) for pair in kept)
    )


CHAIN = "0...1...2"


def test_a_lost_message_breaks_a_chain():
    key = key_losing(lost=[(0, 1)], kept=[(1, 2)], rate=0.5)
    config = {"communication_range": 4.0, "message_loss": 0.5}
    world = world_on(CHAIN, key=key, **config)
    frame = play(world, "talk talk talk")
    assert frame.merged == [False, True, True]
    assert frame.received == [0, 2, 3]
    assert frame.rewards["case2"][0] == 0  # a lone communicator
    assert frame.rewards["case2-lone-idle"][0] == -1
    assert pairs(frame.linked) == {(0, 1), (1, 2)}  # loss does not show
    assert all("talk" in allowed(frame, robot) for robot in range(3))
    assert frame.unshared == [[0, 2, 2], [3, 0, 0], [2, 0, 0]]
    assert play(world_on(CHAIN, key=key, communication_range=4.0), "talk talk talk").received == [
        5,
        4,
        5,
    ]


def test_relays_carry_what_one_link_loses():
    key = key_losing(lost=[(0, 1)], kept=[(0, 2), (1, 2)], rate=0.3)
    assert play(world_on(CHAIN, key=key, message_loss=0.3), "talk talk talk").merged == [True] * 3


def test_losses_are_drawn_anew_in_every_step():
    world = world_on("0.......1", key=5, message_loss=0.5)
    merged = [play(world, "talk talk").merged for _ in range(40)]
    drops = [slow.happens(0.5, 5, "message", 0, 1, t) for t in range(40)]
    assert merged == [[not lost] * 2 for lost in drops]
    assert 5 < sum(drops) < 35


def test_all_messages_may_be_lost():
    world = world_on("01", message_loss=1.0)
    for _ in range(5):
        frame = play(world, "talk talk")
        assert frame.merged == [False, False]
        assert pairs(frame.linked) == {(0, 1)}


# ---------------------------------------------------------------- moves out of turn


def test_a_robot_moves_only_in_its_period():
    world = world_on("0....... 1.......", move_period=(1, 3))
    columns = [[c for _, c in play(world, "E E").positions] for _ in range(6)]
    assert columns == [[1, 1], [2, 1], [3, 1], [4, 2], [5, 2], [6, 2]]


def test_a_mask_out_of_turn_allows_no_moves():
    world = world_on("0.... 1....", move_period=(1, 2))
    assert allowed(world.frame, 1) == {"NE", "E", "stay", "talk"}
    frame = play(world, "E E")  # at time 1 the second robot is out of turn
    assert allowed(frame, 0) == {"W", "E", "SW", "SE", "stay", "talk"}
    assert allowed(frame, 1) == {"stay", "talk"}


def test_a_move_out_of_turn_is_no_danger_and_no_contender():
    world = world_on("0.1", move_period=(1, 2))
    play(world, "stay stay")
    frame = play(world, "E W")
    assert frame.positions == [(0, 1), (0, 2)]
    assert frame.dangerous == [False, False]
    frame = play(world_on("0.1", move_period=(1, 2)), "E W")  # in turn both are refused
    assert frame.dangerous == [True, True]
    outside = world_on("0.1", move_period=(1, 2))
    assert play(outside, "stay stay", "stay E").dangerous == [False, False]


def test_a_move_out_of_turn_does_not_cross():
    world = world_on("0. 1.", move_period=(1, 2))
    frame = play(world, "stay stay", "SE NE")
    assert frame.positions == [(1, 1), (1, 0)]
    assert frame.dangerous == [False, False]
    assert play(world_on("0. 1."), "SE NE").dangerous == [True, True]


def test_a_move_out_of_turn_is_not_idle_but_staying_is():
    world = world_on("0....1", move_period=2)
    play(world, "stay stay")
    assert play(world, "E stay").rewards["case2"] == [0, -1]


def test_a_robot_out_of_turn_talks():
    world = world_on("0....1", move_period=2)
    assert play(world, "stay stay", "talk talk").merged == [True, True]


# ---------------------------------------------------------------- failures


def key_failing(fails, robots, rate=0.5, t=0):
    """A draw key with which just these robots fail at time t."""
    return next(
        key
        for key in count()
        if [slow.happens(rate, key, "failure", i, t) for i in range(robots)]
        == [i in fails for i in range(robots)]
    )


def test_a_robot_that_fails_has_moved_sensed_and_merged_before():
    key = key_failing({1}, robots=3)
    world = world_on("0.......1.......2", key=key, failure_rate=0.5)
    frame = play(world, "talk talk stay")
    assert frame.alive == [True, False, True]
    assert frame.merged == [True, True, False]
    assert frame.received == [3, 2, 0]
    assert frame.rewards["case1"] == [3, 0, 0]
    assert frame.rewards["case2"][:2] == [(0.8 + 2 / 17) * 3 / 17, 0]
    assert pairs(frame.linked) == {(0, 2)}
    assert allowed(frame, 1) == {"stay"}
    assert frame.fov[1] == [[1, 1, 1], [1, 0, 1], [1, 1, 1]]
    world = world_on("0.......1.......2", key=key, failure_rate=0.5)
    frame = play(world, "stay E stay")
    assert frame.positions[1] == (0, 9)
    assert frame.discovered == [0, 1, 0]
    assert not frame.alive[1]


def test_a_failed_robot_blocks_and_does_nothing_more():
    world = failed(world_on("0.1.2"), 1)
    before = world.frame
    frame = play(world, "E W stay")
    assert frame.positions == [(0, 1), (0, 2), (0, 4)]
    assert frame.dangerous == [False, False, False]
    assert "E" not in allowed(frame, 0)
    assert frame.fov[0][1] == [0, 0, 1]
    assert frame.maps[0] == map_cells("...??").tolist()  # free in maps, like any robot
    frame = play(world, "E talk stay")
    assert frame.dangerous == [True, False, False]
    frame = play(world, "talk talk talk")
    assert frame.merged == [True, False, True]
    assert frame.maps[1] == before.maps[1]
    assert frame.discovered[1] == frame.received[1] == 0
    assert frame.rewards["case1"][1] == frame.rewards["case2"][1] == frame.rewards["team"][1] == 0


def test_a_failed_robot_is_no_contender():
    world = failed(world_on("0.1"), 1)
    assert play(world, "E W").positions == [(0, 1), (0, 2)]


def test_counters_of_pairs_go_on_without_a_failed_robot():
    world = world_on("0...1...")
    play(world, "talk talk")
    failed(world, 1)
    frame = play(world, "E E")
    assert frame.unshared == [[0, 1], [0, 0]]
    assert frame.steps_since_merge == [[0, 1], [1, 0]]
    frame = play(world, "E E", "talk talk")
    assert frame.unshared == [[0, 1], [0, 0]]
    assert frame.steps_since_merge == [[0, 3], [3, 0]]


def test_a_failed_robot_closes_no_diagonal():
    world = failed(world_on("0# 1."), 1)
    assert allowed(world.frame, 0) == {"SE", "stay"}
    assert play(world, "SE stay").positions[0] == (1, 1)


def test_growth_and_dangers_are_over_the_survivors():
    """Maps of 2, 2 and 3 cells, the largest that of the failed robot."""
    board = "0....2...1"
    world = failed(world_on(board), 2)
    frame = play(world, "E E stay")  # robot 1 leaves the arena; robot 0 knows 3 cells
    team = 1 / 40 - 0.1 - 0.25 / 2
    assert frame.rewards["team"] == pytest.approx([team, team, 0])
    assert frame.team_rewards["team"] == pytest.approx(team)
    progress = team + (0.5 - 1) / 80
    assert frame.rewards["progress"] == pytest.approx([progress, progress, 0])
    assert frame.team_rewards["case1"] == pytest.approx((1 - 100) / 2)
    assert play(world_on(board), "E E stay").rewards["team"][0] == pytest.approx(-0.1 - 0.25 / 3)


def test_the_growth_of_a_step_leaves_out_who_fails_in_it():
    key = key_failing({1}, robots=2)
    board = "0......1.."
    frame = play(world_on(board, key=key, failure_rate=0.5), "E E")
    assert frame.rewards["team"] == pytest.approx([1 / 40 - 0.1, 0])
    # a refused move of the failing robot is not counted either
    frame = play(world_on("0.......1", key=key, failure_rate=0.5), "stay E")
    assert frame.dangerous == [False, True]
    assert frame.team_rewards["team"] == pytest.approx(-0.1)
    assert frame.team_rewards["case1"] == 0


def test_what_a_failed_robot_knew_alone_is_lost():
    world = world_on("0....2...1")
    assert world.frame.coverages == pytest.approx(
        {"largest": 0.3, "union": 0.7, "mean": 7 / 30, "smallest": 0.2}
    )
    assert failed(world, 2).frame.coverages == pytest.approx(
        {"largest": 0.2, "union": 0.4, "mean": 0.2, "smallest": 0.2}
    )


def test_every_robot_complete_means_every_living_one():
    world = world_on("0..1")
    frame = play(world, "E stay", "E stay")
    assert (frame.some_complete, frame.every_complete) == (True, False)
    assert failed(world, 1).frame.every_complete
    frame = failed(world, 0).frame
    assert not frame.some_complete
    assert not frame.every_complete


def test_with_none_left_the_episode_is_over():
    world = world_on("0..1", failure_rate=1.0)
    assert not world.frame.terminated
    frame = play(world, "talk talk")
    assert frame.maps == [map_cells("....").tolist()] * 2  # known to both, and lost
    assert frame.terminated
    assert frame.merged == [True, True]
    assert set(frame.coverages.values()) == {0}
    assert (frame.some_complete, frame.every_complete, frame.finishable) == (False, False, False)
    assert all(values == [0, 0] for values in frame.rewards.values())
    assert set(frame.team_rewards.values()) == {0}
    assert pairs(frame.linked) == set()
    again = play(world, "E talk")
    assert again.positions == frame.positions
    assert again.terminated
    assert again.discovered == [0, 0]


def test_a_failure_is_drawn_per_robot_and_step():
    world = world_on("0...1...2", key=3, failure_rate=0.05)
    for t in range(40):
        lived = world.frame.alive
        frame = play(world, "stay stay stay")
        drawn = [slow.happens(0.05, 3, "failure", i, t) for i in range(3)]
        alive = [was and not fails for was, fails in zip(lived, drawn, strict=True)]
        assert frame.alive == alive
    assert not all(frame.alive)


def test_a_robot_given_as_failed_has_sensed_nothing():
    world = world_on("0...1", alive=[True, False])
    frame = world.frame
    assert frame.maps[1] == map_cells("?????").tolist()
    assert frame.discovered == [2, 0]
    assert frame.unshared == [[0, 2], [0, 0]]
    assert frame.coverages["largest"] == 2 / 5  # targets count all robots
    assert pairs(frame.linked) == set()
    frame = play(world, "E stay")
    assert frame.maps[1] == map_cells("?????").tolist()
    assert frame.discovered == [1, 0]


@pytest.mark.parametrize(
    ("board", "walkers", "expected"),
    [
        ("0..1...", [], False),  # the corridor is closed
        ("0..1.", [], False),
        ("0..1", [], True),  # a cell beside a reachable one is reached
        ("0..1... .......", [], True),
        ("0......  ...1...", [(0, 3)], True),  # walkers go away
        ("0.# #1.", [], True),  # a failed robot closes no diagonal
    ],
)
def test_a_failed_robot_may_make_completion_impossible(board, walkers, expected):
    world = world_on(board, walkers=walkers)
    assert world.frame.finishable
    assert failed(world, 1).frame.finishable == expected


def test_known_targets_need_not_be_reached():
    world = world_on("0..1...")
    play(world, "stay E", "stay E", "talk talk")
    assert failed(world, 1).frame.finishable
    unshared = world_on("0..1...")
    play(unshared, "stay E", "stay W")
    assert not failed(unshared, 1).frame.finishable


def test_coverage_ends_an_episode():
    world = world_on("0.........", terminate_at_coverage=0.4)
    assert [play(world, "E").terminated for _ in range(4)] == [False, True, True, True]
    assert not world_on("0.", terminate_at_coverage=1.0).frame.terminated  # never at the start


# ---------------------------------------------------------------- walkers


STILL, NORTH_STEP, EAST_STEP, SOUTH_STEP, WEST_STEP = range(5)


def key_walking(*choices, t=0):
    """A draw key with which walker w draws ``choices[w]`` of stay, N, E, S, W at time t."""
    return next(
        key
        for key in count()
        if all(
            math.floor(5 * slow.uniform(key, "walker", w, t)) == choice
            for w, choice in enumerate(choices)
        )
    )


@pytest.mark.parametrize(
    ("board", "walker", "choice", "move", "goes_to"),
    [
        ("0.. ... ...", (1, 1), STILL, "stay", (1, 1)),
        ("0.. ... ...", (1, 1), NORTH_STEP, "stay", (0, 1)),
        ("0.. ... ...", (1, 1), EAST_STEP, "stay", (1, 2)),
        ("0.. ... ...", (1, 1), SOUTH_STEP, "stay", (2, 1)),
        ("0.. ... ...", (1, 1), WEST_STEP, "stay", (1, 0)),
        ("0.. ... ...", (2, 1), SOUTH_STEP, "stay", (2, 1)),  # outside
        ("0.. .#. ...", (2, 1), NORTH_STEP, "stay", (2, 1)),  # an obstacle
        ("0.. ... ...", (0, 1), WEST_STEP, "stay", (0, 1)),  # a robot
        ("0.. ... ...", (0, 1), WEST_STEP, "S", (0, 0)),  # the robot has left
        ("0.. ... ...", (1, 1), WEST_STEP, "S", (1, 1)),  # the robot has come
    ],
)
def test_where_a_walker_goes(board, walker, choice, move, goes_to):
    world = world_on(board, key=key_walking(choice), walkers=[walker])
    frame = play(world, move)
    assert frame.walkers == [goes_to]
    assert frame.dangerous == [False]


def test_two_walkers_that_want_one_cell_both_stay():
    key = key_walking(EAST_STEP, WEST_STEP)
    frame = play(world_on("0.... .....", key=key, walkers=[(1, 1), (1, 3)]), "stay")
    assert frame.walkers == [(1, 1), (1, 3)]


def test_no_walker_goes_where_another_was():
    key = key_walking(EAST_STEP, EAST_STEP)
    frame = play(world_on("0.... .....", key=key, walkers=[(1, 1), (1, 2)]), "stay")
    assert frame.walkers == [(1, 1), (1, 3)]


def test_walkers_stay_clear_of_failed_robots():
    world = failed(world_on("0.", key=key_walking(WEST_STEP), walkers=[(0, 1)]), 0)
    assert play(world, "E").walkers == [(0, 1)]


def test_a_walker_blocks_a_robot_even_if_it_leaves():
    world = world_on("0...", key=key_walking(EAST_STEP), walkers=[(0, 1)])
    assert allowed(world.frame, 0) == {"stay"}
    assert world.frame.fov[0][1] == [1, 0, 1]
    assert world.frame.maps[0] == map_cells("..??").tolist()
    frame = play(world, "E")
    assert frame.dangerous == [True]
    assert frame.positions == [(0, 0)]
    assert frame.walkers == [(0, 2)]
    assert allowed(frame, 0) == {"E", "stay"}
    assert frame.fov[0][1] == [1, 0, 0]


def test_a_walker_is_no_contender_and_closes_no_diagonal():
    world = world_on("0#. ...", key=key_walking(EAST_STEP), walkers=[(1, 0)])
    assert allowed(world.frame, 0) == {"SE", "stay"}
    frame = play(world, "SE")  # the walker wants the same cell
    assert frame.positions == [(1, 1)]
    assert frame.dangerous == [False]
    assert frame.walkers == [(1, 0)]


def test_walkers_do_not_change_reach_links_or_targets():
    config = {"wall_loss_db": math.inf, "line_of_sight": True}
    frame = world_on("0.1", walkers=[(0, 1)], **config).frame
    assert pairs(frame.linked) == {(0, 1)}
    assert frame.finishable
    assert frame.coverages["largest"] == 2 / 3


def test_walkers_start_on_free_cells_with_the_smallest_keys():
    board = "0.#. .1.. ...."
    starts = world_on(board, key=4, num_walkers=9).frame.walkers
    free = {(r, c) for r in range(3) for c in range(4)} - {(0, 0), (0, 2), (1, 1)}
    assert set(starts) == free
    keys = hashing.combine(4, hashing.text_key("walker-start"), torch.arange(12)).tolist()
    assert [keys[4 * r + c] for r, c in starts] == sorted(keys[4 * r + c] for r, c in free)
    assert world_on(board, key=4, num_walkers=3).frame.walkers == starts[:3]
    assert world_on(board, key=5, num_walkers=9).frame.walkers != starts
    with pytest.raises(ValueError, match="num_walkers=10"):
        world_on(board, key=4, num_walkers=10)


# ---------------------------------------------------------------- whole episodes


EVERYTHING = Settings(
    height=8,
    width=9,
    num_agents=4,
    cell_size=1.0,
    sensing_range=(1.5, 1.5, 3.0, 2.0),
    sensing_shape="disc",
    line_of_sight=True,
    communication_range=(3.0, 3.0, 6.0, 6.0),
    wall_loss_db=6.0,
    path_loss_exponent=2.5,
    shadowing_db=4.0,
    message_loss=0.2,
    move_period=(1, 2, 1, 3),
    failure_rate=0.03,
    num_walkers=3,
)


def random_arena(generator, config):
    share = generator.choice((0.0, 0.1, 0.3))
    board = random_board(generator, config.height, config.width, share)
    cells = [(r, c) for r in range(config.height) for c in range(config.width)]
    positions = generator.sample(cells, config.num_agents)
    for r, c in positions:
        board[r][c] = False
    return board, positions


def random_actions(generator, robots, steps):
    """Actions of every step; a third of them communicate, so that there are networks."""
    choices = [*range(10), TALK, TALK, TALK, TALK]
    return [[generator.choice(choices) for _ in range(robots)] for _ in range(steps)]


def test_an_episode_does_not_depend_on_those_beside_it():
    generator = random.Random(10)
    arenas = [random_arena(generator, EVERYTHING) for _ in range(4)]
    keys = [slow.draw_key("test", 0, index, 0) for index in range(4)]
    steps = [random_actions(generator, 4, 12) for _ in arenas]

    alone = []
    for (board, positions), key, actions in zip(arenas, keys, steps, strict=True):
        world = World(EVERYTHING, board, positions, key)
        alone.append([world.frame, *(world.step(chosen) for chosen in actions)])

    order = [2, 0, 3, 1]
    worlds = [World(EVERYTHING, *arenas[index], keys[index]) for index in order]
    batch = [[world.frame] for world in worlds]
    for t in range(12):
        for row, index in enumerate(order):
            batch[row].append(worlds[row].step(steps[index][t]))
    assert [batch[order.index(index)] for index in range(4)] == alone


def test_invariants_of_random_episodes():
    generator = random.Random(11)
    ended = received = deaths = 0
    for index in range(12):
        board, positions = random_arena(generator, EVERYTHING)
        world = World(EVERYTHING, board, positions, slow.draw_key("test", 0, index, 0))
        for actions in random_actions(generator, 4, 25):
            before = world.frame
            frame = world.step(actions)
            taken = [*frame.positions, *frame.walkers]
            assert len(set(taken)) == len(taken)
            assert not any(board[r][c] for r, c in taken)
            pairs(frame.linked)  # symmetric, and True on the diagonal
            for i, alive in enumerate(before.alive):
                if alive:
                    assert (
                        before.masks[i][actions[i]]
                        or actions[i] == TALK
                        or (frame.positions[i] == before.positions[i])
                    )
                else:
                    assert frame.maps[i] == before.maps[i]
                    assert frame.positions[i] == before.positions[i]
                    assert not frame.alive[i]
                    assert not frame.merged[i]
                    assert frame.linked[i] == [i == j for j in range(4)]
                for known, now in zip(before.maps[i], frame.maps[i], strict=True):
                    assert all(v in (oracle.UNKNOWN, w) for v, w in zip(known, now, strict=True))
            assert frame.terminated == (not any(frame.alive))
            ended += frame.terminated
            received += sum(frame.received)
            deaths += sum(before.alive) - sum(frame.alive)
    assert ended
    assert received
    assert deaths > 10


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"line_of_sight": True},  # the rule of occlusion
        {"sensing_range": 1.8, "communication_range": 1.5},  # k = 2
        {"sensing_range": 2.6, "communication_range": math.inf},  # k = 3
        {"communication_range": 0.0},
    ],
)
def test_at_the_defaults_episodes_are_those_of_the_paper(changes):
    generator = random.Random(str(changes))
    merges = refused = completed = 0
    for _ in range(10):
        robots = generator.choice((1, 2, 4, 5))
        size = {"height": generator.choice((4, 5, 9)), "width": generator.choice((4, 6, 10))}
        config = Settings(**size, num_agents=robots, **changes)
        rules = oracle.Rules(
            **size,
            num_agents=robots,
            fov_radius=oracle.fov_radius(config.sensing_range, config.cell_size),
            communication_cells=config.communication_range / config.cell_size,
            occlusion=config.line_of_sight,
        )
        board, positions = random_arena(generator, config)
        world = World(config, board, positions, generator.randrange(2**63))
        state = oracle.reset(rules, board, positions)
        targets = oracle.target_cells(board, positions)
        assert_same(rules, world.frame, state, targets)
        for actions in random_actions(generator, robots, 20):
            frame = world.step(actions)
            state, did = oracle.step(rules, state, actions)
            assert_same(rules, frame, state, targets)
            for name in ("dangerous", "merged", "discovered", "received", "rewards"):
                assert getattr(frame, name) == getattr(did, name), name
            for name, values in did.rewards.items():
                assert frame.team_rewards[name] == pytest.approx(sum(values) / robots)
            merges += sum(frame.merged)
            refused += sum(frame.dangerous)
            completed += frame.some_complete
    assert refused
    if changes.get("communication_range") != 0:
        assert merges
        assert completed


def assert_same(rules, frame, state, targets):
    """A frame holds what the paper's oracle says of a state."""
    robots = range(rules.num_agents)
    assert frame.positions == state.positions
    assert frame.maps == state.maps
    assert frame.unshared == state.unshared
    assert frame.steps_since_merge == state.steps_since_merge
    assert frame.linked == oracle.in_range(rules, state)
    assert frame.masks == oracle.action_mask(rules, state)
    assert frame.fov == [oracle.field_of_view(rules, state, robot) for robot in robots]
    assert all(frame.alive)
    assert not frame.walkers
    assert not frame.terminated
    assert frame.finishable
    known = [oracle.known_targets(map_, targets) for map_ in state.maps]
    total = sum(row.count(True) for row in targets)
    assert frame.coverages["largest"] == max(known) / total
    assert frame.coverages["smallest"] == min(known) / total
    assert frame.some_complete == (max(known) == total)
    assert frame.every_complete == (min(known) == total)

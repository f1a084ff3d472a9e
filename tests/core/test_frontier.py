"""The feature table of frontiers: against the oracle on maps of all kinds, and by hand."""

from __future__ import annotations

import statistics

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from marl_explore.core.frontier import NORMALIZATIONS, frontier_mask, nearest_frontier
from marl_explore.core.world import advance, start
from tests.helpers import oracle
from tests.helpers.boards import ACTIONS, known_map, map_cells
from tests.helpers.implementations import feature_table
from tests.helpers.strategies import island_maps, repeatable, scenarios


def assert_table(table, expected):
    torch.testing.assert_close(table, torch.tensor(expected), rtol=1e-5, atol=1e-6)


def assert_agrees(maps, positions, normalize, levels=None):
    """Tables of maps [M, H, W] and positions [M, 2] against the oracle's."""
    expected = [
        oracle.feature_table(map_, position, normalize)
        for map_, position in zip(maps.tolist(), positions.tolist(), strict=True)
    ]
    assert_table(feature_table(maps, positions, normalize, levels), expected)


def raw(board, levels=None):
    """The directions of a drawn map that have trajectories: {name: [number, mean, deviation]}."""
    table = feature_table(*known_map(board), None, levels).tolist()
    return {ACTIONS[d]: row for d, row in enumerate(table) if row != [0, 0, 0]}


# ---------------------------------------------------------------- against the oracle


@pytest.mark.parametrize("normalize", NORMALIZATIONS)
@repeatable(max_examples=40)
@given(scenario=scenarios())
def test_tables_of_real_episodes_agree_with_the_reference(normalize, scenario):
    state = start(scenario.config, scenario.obstacles, scenario.positions)
    for action in scenario.actions:
        state, _ = advance(scenario.config, state, action)
    assert_agrees(state.map.flatten(0, 1), state.position.flatten(0, 1), normalize)


@pytest.mark.parametrize("normalize", NORMALIZATIONS)
@repeatable(max_examples=80)
@given(boards=island_maps())
def test_tables_of_arbitrary_maps_agree_with_the_reference(normalize, boards):
    maps, positions = zip(*map(known_map, boards), strict=True)
    assert_agrees(torch.stack(maps), torch.stack(positions), normalize)


@repeatable(max_examples=60)
@given(boards=island_maps())
def test_the_frontier_mask_agrees_with_the_reference(boards):
    for board in boards:
        map_, _ = known_map(board)
        cells = [tuple(cell) for cell in frontier_mask(map_).nonzero().tolist()]
        assert cells == oracle.frontiers(map_.tolist())


@pytest.mark.parametrize("normalize", NORMALIZATIONS)
@pytest.mark.parametrize("board", ["@...?", "?.@..", "@", "?@?.?", "@.#.?", "@\n.\n.\n?\n."])
def test_arenas_one_cell_wide_agree_with_the_reference(board, normalize):
    map_, position = known_map(board)
    assert_agrees(map_.unsqueeze(0), position.unsqueeze(0), normalize)


@repeatable(max_examples=30)
@given(boards=island_maps(max_side=10), extra=st.integers(0, 5))
def test_enough_levels_give_the_same_table_as_no_limit(boards, extra):
    for board in boards:
        map_, position = known_map(board)
        trajectories = oracle.trajectories(map_.tolist(), position.tolist())
        levels = max((length for _, length in trajectories), default=0) + extra
        unlimited = feature_table(map_, position, None)
        assert feature_table(map_, position, None, levels).equal(unlimited)


@repeatable(max_examples=30)
@given(boards=island_maps(max_side=10), levels=st.integers(1, 8))
def test_trajectories_longer_than_the_levels_are_ignored(boards, levels):
    for board in boards:
        map_, position = known_map(board)
        number = [0] * 8
        for direction, length in oracle.trajectories(map_.tolist(), position.tolist()):
            number[direction] += length <= levels
        assert feature_table(map_, position, None, levels)[:, 0].tolist() == number


@repeatable(max_examples=60)
@given(boards=island_maps())
def test_the_nearest_frontier_agrees_with_the_reference(boards):
    maps, positions = map(torch.stack, zip(*map(known_map, boards), strict=True))
    found = [
        oracle.trajectories(map_, position)
        for map_, position in zip(maps.tolist(), positions.tolist(), strict=True)
    ]
    nearest = [min(((n, d) for d, n in paths), default=(0, 0)) for paths in found]
    direction, length = nearest_frontier(maps, positions)
    assert list(zip(length.tolist(), direction.tolist(), strict=True)) == nearest


def test_more_batch_dimensions_give_the_same_as_one():
    boards = ["@..?", "?.@.", "@?..", "?..@", "..@?", ".@#?"]
    maps, positions = map(torch.stack, zip(*map(known_map, boards), strict=True))
    flat = feature_table(maps, positions)
    folded = feature_table(maps.view(2, 3, 1, 4), positions.view(2, 3, 2))
    assert folded.equal(flat.view(2, 3, 8, 3))
    nearest_flat = torch.stack(nearest_frontier(maps, positions))
    nearest = nearest_frontier(maps.view(2, 3, 1, 4), positions.view(2, 3, 2))
    assert torch.stack(nearest).equal(nearest_flat.view(2, 2, 3))


def test_a_single_map_needs_no_batch_dimension():
    map_, position = known_map("?..@.?")
    batched = map_.unsqueeze(0), position.unsqueeze(0)
    assert feature_table(map_, position).equal(feature_table(*batched)[0])
    single, several = nearest_frontier(map_, position), nearest_frontier(*batched)
    assert torch.stack(single).equal(torch.stack(several)[:, 0])


def test_the_inputs_stay_as_they_were():
    map_, position = known_map("?..@\n?...")
    copies = map_.clone(), position.clone()
    feature_table(map_, position)
    assert map_.equal(copies[0])
    assert position.equal(copies[1])


# ---------------------------------------------------------------- frontiers


def test_a_frontier_is_a_free_cell_with_an_unknown_cell_at_its_side():
    mask = frontier_mask(
        map_cells("""
            ?...
            ....
            ..#?
            ....
        """)
    )
    assert mask.int().tolist() == [[0, 1, 0, 0], [1, 0, 0, 1], [0, 0, 0, 0], [0, 0, 0, 1]]


def test_the_outside_is_not_unknown():
    assert not frontier_mask(map_cells("...\n...")).any()


# ---------------------------------------------------------------- which direction a path has


@pytest.mark.parametrize(
    ("name", "board"),
    [
        ("N", "?.?\n?@?\n???"),
        ("NE", "??.\n?@?\n???"),
        ("E", "???\n?@.\n???"),
        ("SE", "???\n?@?\n??."),
        ("S", "???\n?@?\n?.?"),
        ("SW", "???\n?@?\n.??"),
        ("W", "???\n.@?\n???"),
        ("NW", ".??\n?@?\n???"),
    ],
)
def test_a_neighbouring_frontier_lies_in_its_direction(name, board):
    assert raw(board) == {name: [1, 1, 0]}


def test_a_path_belongs_to_its_first_move():
    board = """
        ##.?
        @#.#
        .#.#
        ...#
    """
    # S, SE, NE and N, N: the frontier itself lies north-east
    assert raw(board) == {"S": [1, 5, 0]}


def test_of_two_shortest_paths_the_lowest_direction_counts():
    board = """
        @..
        ...
        ..?
    """
    # (1, 2) by E, SE or SE, E; (2, 1) by SE, S or S, SE
    assert raw(board) == {"E": [1, 2, 0], "SE": [1, 2, 0]}


def test_north_is_lower_than_north_west():
    board = """
        ?..
        ...
        ...
        ..@
    """
    # (0, 1) in 3 by N or NW first; (1, 0) in 2 by NW, NW only
    assert raw(board) == {"N": [1, 3, 0], "NW": [1, 2, 0]}


def test_a_tie_around_a_pillar_goes_to_the_lower_side():
    board = """
        ...?
        @#..
        ...?
    """
    # (0, 2) in 2 by NE, (2, 2) in 2 by SE, (1, 3) in 3 by either side
    assert raw(board) == {"NE": [2, 2.5, 0.5], "SE": [1, 2, 0]}


def test_a_longer_way_through_a_lower_direction_does_not_count():
    board = """
        ....
        .##.
        @..?
    """
    # (2, 2) in 2 by E; (1, 3) in 3 by E, E, NE
    assert raw(board) == {"E": [2, 2.5, 0.5]}


# ---------------------------------------------------------------- which paths there are


def test_a_diagonal_is_blocked_between_two_known_obstacles():
    assert raw("@#?\n#.?\n???") == {}


@pytest.mark.parametrize("board", ["@?\n?.", "@#\n?.", "@?\n#."])
def test_a_diagonal_is_open_beside_an_unknown_cell(board):
    assert raw(board) == {"SE": [1, 1, 0]}


def test_a_diagonal_further_on_is_blocked_alike():
    blocked = """
        @.#?
        ##.?
    """
    assert raw(blocked) == {}
    beside_unknown = """
        @.??
        ##.?
    """
    # (0, 1) in 1 and (1, 2) in 2, both by E
    assert raw(beside_unknown) == {"E": [2, 1.5, 0.5]}


def test_paths_do_not_lead_through_unknown_cells():
    assert raw("@?..?") == {}


def test_frontiers_of_an_island_count_once_it_is_joined():
    apart = """
        @..?..
        #####?
    """
    joined = """
        @.....
        #####?
    """
    assert raw(apart) == {"E": [1, 2, 0]}
    assert raw(joined) == {"E": [1, 5, 0]}


def test_the_own_cell_counts_nowhere_though_it_is_a_frontier():
    assert raw("@?") == {}
    assert raw("?@.?") == {"E": [1, 1, 0]}


def test_no_path_ends_where_it_began():
    """A walk that comes round to the robot's own frontier cell is no trajectory."""
    board = """
        ?@.
        #..
    """
    assert raw(board) == {}


def test_a_map_without_frontiers_gives_zeros():
    for normalize in NORMALIZATIONS:
        assert feature_table(*known_map("...\n.@.\n..."), normalize).eq(0).all()


@pytest.mark.parametrize(
    ("board", "name", "length"),
    [
        ("?..@.?", "E", 1),
        ("?.@..?", "W", 1),
        ("?..@..?", "E", 2),  # equally near: the lowest direction
        ("#.@.#", "N", 0),  # none: zeros
    ],
)
def test_the_nearest_frontier_by_hand(board, name, length):
    map_, position = known_map(board)
    direction, distance = nearest_frontier(map_.unsqueeze(0), position.unsqueeze(0))
    assert (direction.tolist(), distance.tolist()) == ([ACTIONS.index(name)], [length])


# ---------------------------------------------------------------- normalisation


TWO_WAYS = """
    #?##?###?
    ...@.....
"""
"""Frontiers in the south row: one at 2 to the west, two at 1 and 5 to the east."""


@pytest.mark.parametrize(
    ("normalize", "west", "east"),
    [
        (None, [1, 2, 0], [2, 3, 2]),
        ("relative", [1 / 3, 2 / 5, 0], [2 / 3, 3 / 5, 2 / 5]),  # the longest of all is 5
        ("proximity", [1 / 3, 1, 0], [2 / 3, 2 / 3, 2 / 5]),  # the nearest mean is 2
        ("absolute", [1 / 18, 2 / 11, 0], [2 / 18, 3 / 11, 2 / 11]),  # 2 x 9 cells
    ],
)
def test_each_normalisation_by_hand(normalize, west, east):
    expected = [[0.0] * 3 for _ in range(8)]
    expected[ACTIONS.index("W")], expected[ACTIONS.index("E")] = west, east
    assert_table(feature_table(*known_map(TWO_WAYS), normalize), expected)


def test_unknown_normalisations_are_refused():
    with pytest.raises(ValueError, match=r"'max'.*relative.*proximity.*absolute.*None"):
        feature_table(*known_map("@?"), "max")


# ---------------------------------------------------------------- long paths and limits


@pytest.mark.parametrize(
    ("levels", "expected"),
    [
        (1, {"E": [1, 1, 0]}),
        (2, {"W": [1, 2, 0], "E": [1, 1, 0]}),
        (4, {"W": [1, 2, 0], "E": [1, 1, 0]}),
        (5, {"W": [1, 2, 0], "E": [2, 3, 2]}),
        (50, {"W": [1, 2, 0], "E": [2, 3, 2]}),
    ],
)
def test_the_levels_are_the_longest_path_that_counts(levels, expected):
    assert raw(TWO_WAYS, levels) == expected


def snake(last_row):
    """One corridor winding through a 40 x 40 arena from the north-west to ``last_row``.

    Each turn is cut by two diagonals. The corridor's row 0 takes 38 moves, the 19 turns 2 each,
    and the rows between 37 each: row 38 begins after 38 + 18 * 37 + 38 = 742 moves.
    """
    gap_east, gap_west = "#" * 39 + ".", "." + "#" * 39
    rows = ["." * 40 if r % 2 == 0 else gap_east if r % 4 == 1 else gap_west for r in range(39)]
    return "@" + "\n".join([*rows, last_row])[1:]


def test_a_path_of_hundreds_of_cells_is_measured():
    assert raw(snake("?" + "#" * 39)) == {"E": [1, 742 + 38, 0]}


def test_many_long_paths_keep_their_small_deviation():
    # both cells at the east end of row 38 are 742 away, the others one more each
    lengths = [742, *range(742, 781)]
    expected = [40, statistics.mean(lengths), statistics.pstdev(lengths)]
    assert raw(snake("?" * 40)) == {"E": pytest.approx(expected, rel=1e-6)}


@pytest.mark.parametrize("normalize", NORMALIZATIONS)
def test_long_paths_agree_with_the_reference(normalize):
    map_, _ = known_map(snake("?" * 40))
    positions = torch.tensor([[0, 0], [18, 20], [38, 0]])
    assert_agrees(map_.expand(3, 40, 40), positions, normalize)

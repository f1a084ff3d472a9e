"""Shapes, line of sight and expected discoveries: the slow oracle of the wider world, and boards.

Every backend gives the same numbers.
"""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from marl_explore.config.shapes import Sight, most_discovered, shape_radius
from marl_explore.core import sight as rules
from marl_explore.core.native.choice import MISSING
from marl_explore.core.sight import shape_mask
from tests.helpers import world_oracle as oracle
from tests.helpers.strategies import repeatable

CPU = torch.device("cpu")
BACKENDS = ["torch", "auto", *(["native"] if MISSING["sight"] is None else [])]


def by_every_backend(function, *inputs):
    """What torch computes, once the other backends have been held against it."""
    results = {backend: function(*inputs, backend) for backend in BACKENDS}
    for backend, result in results.items():
        assert result.dtype == results["torch"].dtype, backend
        assert result.equal(results["torch"]), backend
    return results["torch"]


def line_of_sight(wall):
    return by_every_backend(rules.line_of_sight, wall)


def expected_discoveries(grid, which, cell, kind, sight):
    return by_every_backend(rules.expected_discoveries, grid, which, cell, kind, sight)


def generator(seed):
    return torch.Generator().manual_seed(seed)


def seen(board):
    """The cells that are seen from the centre of a window, as a drawing."""
    rows = board.split()
    wall = torch.tensor([[cell == "#" for cell in row] for row in rows])
    return ["".join("x" if cell else "." for cell in row) for row in line_of_sight(wall).tolist()]


def test_a_wall_is_seen_and_what_lies_behind_it_is_not():
    assert seen(""".....
                   .....
                   ...#.
                   .....
                   .....""") == ["xxxxx", "xxxxx", "xxxx.", "xxxxx", "xxxxx"]


def test_sight_does_not_pass_between_two_obstacles():
    assert seen(""".....
                   ..#..
                   ...#.
                   .....
                   .....""") == ["xx...", "xxx..", "xxxx.", "xxxxx", "xxxxx"]


def test_inside_walls_only_walls_are_seen():
    assert seen(""".....
                   .###.
                   .#.#.
                   .###.
                   .....""") == [".....", "..x..", ".xxx.", "..x..", "....."]


@repeatable(max_examples=200)
@given(st.data())
def test_line_of_sight_is_the_oracles(data):
    k = data.draw(st.integers(1, 6))
    side = 2 * k + 1
    share = data.draw(st.sampled_from([0.05, 0.2, 0.4]))
    seed = data.draw(st.integers(0, 2**31))
    wall = torch.rand(3, side, side, generator=generator(seed)) < share
    result = line_of_sight(wall)
    for board, found in zip(wall.tolist(), result.tolist(), strict=True):
        expected = oracle.in_sight(board, (k, k), k)
        assert {(r, c) for r in range(side) for c in range(side) if found[r][c]} == expected


def test_line_of_sight_is_symmetric_under_turns_and_mirrors():
    wall = torch.rand(64, 11, 11, generator=generator(0)) < 0.25
    for turns in range(4):
        turned = torch.rot90(wall, turns, (-2, -1))
        assert line_of_sight(turned).equal(torch.rot90(line_of_sight(wall), turns, (-2, -1)))
    assert line_of_sight(wall.mT).equal(line_of_sight(wall).mT)


@pytest.mark.parametrize("shape", ["square", "disc"])
@pytest.mark.parametrize("metres", [1.1, 1.5, 2.0, 2.13, 3.5, 4.0])
def test_shapes_are_the_oracles(shape, metres):
    settings = oracle.Settings(num_agents=1, sensing_range=metres, sensing_shape=shape)
    k = oracle.radius(settings, 0)
    cells = metres / settings.cell_size
    assert shape_radius(shape, cells) == k
    for window in (k, k + 2):
        mask = shape_mask(shape, cells, window, CPU)
        offsets = {(r - window, c - window) for r, c in mask.nonzero().tolist()}
        assert offsets == set(oracle.shape(settings, 0))
    assert most_discovered(shape, cells) == oracle.max_discovery(settings, 0)


# ------------------------------------------------------------------ expected discoveries


def maps(unknown, occupied, *shape, seed=0):
    """Random maps with these shares of unknown and occupied cells."""
    draw = torch.rand(shape, generator=generator(seed))
    return (draw > 1 - occupied).to(torch.int8) - (draw < unknown).to(torch.int8)


def queries(number, kinds, grid, seed=0):
    """Random maps, cells and kinds."""
    below = (len(grid), grid[0].numel(), kinds)
    return [torch.randint(0, high, (number,), generator=generator(seed)) for high in below]


def at_cell(grid, sight, row, column):
    """The expected discoveries at one cell of one map."""
    grid = torch.tensor(grid, dtype=torch.int8).unsqueeze(0)
    cell = torch.tensor([row * grid.shape[-1] + column])
    return expected_discoveries(grid, cell * 0, cell, cell * 0, sight).item()


@repeatable(max_examples=200)
@given(st.data())
def test_expected_discoveries_are_the_oracles(data):
    ranges = data.draw(
        st.lists(st.sampled_from([1.1, 1.5, 2.0, 2.13, 3.5]), min_size=1, max_size=3)
    )
    settings = oracle.Settings(
        num_agents=len(ranges),
        sensing_range=tuple(ranges),
        sensing_shape=data.draw(st.sampled_from(["square", "disc"])),
        line_of_sight=data.draw(st.booleans()),
    )
    size = [data.draw(st.integers(1, 12)) for _ in range(2)]
    unknown, occupied = data.draw(st.sampled_from([(0.9, 0.05), (0.5, 0.2), (0.2, 0.5)]))
    seed = data.draw(st.integers(0, 2**31))
    grid = maps(unknown, occupied, 3, *size, seed=seed)
    asked = queries(data.draw(st.integers(0, 40)), len(ranges), grid, seed)
    cells = tuple(metres / settings.cell_size for metres in ranges)
    sight = Sight(settings.sensing_shape, cells, settings.line_of_sight)
    found = expected_discoveries(grid, *asked, sight)
    boards = grid.tolist()
    assert found.tolist() == [
        oracle.expected_discovery(settings, robot, boards[which], divmod(cell, size[1]))
        for which, cell, robot in zip(*(entry.tolist() for entry in asked), strict=True)
    ]


@pytest.mark.parametrize("k", [1, 2, 7, 8, 31, 32, 40])
@pytest.mark.parametrize("shape", ["square", "disc"])
def test_backends_agree_for_every_radius(shape, k):
    side = 2 * k + 1
    for share in (0.02, 0.3):
        line_of_sight(torch.rand(20, side, side, generator=generator(k)) < share)
    one = Sight.square(k) if shape == "square" else Sight(shape, (float(k),))
    for hides in (False, True):
        ranges = (*one.ranges_cells, 1.5, 0.6 * k + 1)
        sight = Sight(shape, ranges, hides)
        assert sight.radius == max(k, sight.radii[2])
        grid = maps(0.6, 0.05, 5, 37, 50, seed=k)
        assert expected_discoveries(grid, *queries(70, 3, grid, k), sight).any()


@pytest.mark.parametrize("hides", [False, True])
@pytest.mark.parametrize(("value", "expected"), [(-1, 1), (0, 0), (1, 0)])
def test_a_map_of_one_cell(hides, value, expected):
    assert at_cell([[value]], Sight("disc", (7.0,), hides), 0, 0) == expected


@pytest.mark.parametrize("hides", [False, True])
def test_cells_outside_the_map_count_nowhere(hides):
    unknown, sight = [[-1] * 6 for _ in range(5)], Sight("square", (2.2,), hides)
    assert at_cell(unknown, sight, 2, 2) == 9
    assert [at_cell(unknown, sight, 0, 0), at_cell(unknown, sight, 4, 5)] == [4, 4]
    assert [at_cell(unknown, sight, 0, 2), at_cell(unknown, sight, 3, 5)] == [6, 6]


def test_a_known_map_has_nothing_to_discover():
    grid = maps(0, 0.3, 4, 9, 9)
    for hides in (False, True):
        sight = Sight("disc", (3.0,), hides)
        assert not expected_discoveries(grid, *queries(50, 1, grid), sight).any()


def test_from_inside_an_obstacle_only_it_is_seen():
    grid = [[-1, -1, -1], [-1, 1, -1], [-1, -1, -1]]
    assert at_cell(grid, Sight.square(1), 1, 1) == 8
    assert at_cell(grid, Sight("disc", (2.0,), True), 1, 1) == 0


def test_unknown_cells_hide_nothing_and_obstacles_do():
    grid = [[-1, -1, 0, -1, 1, -1, -1]]
    assert at_cell(grid, Sight("disc", (4.0,), True), 0, 2) == 3
    assert at_cell(grid, Sight("disc", (4.0,), False), 0, 2) == 5
    assert at_cell(grid, Sight("disc", (4.0,), True), 0, 0) == 3  # its own cell among them


def test_one_entry_stands_for_all_robots():
    grid = maps(0.5, 0.1, 3, 8, 8)
    which, cell, _ = queries(30, 1, grid)
    one = Sight("disc", (3.0,), line_of_sight=True)
    three = Sight("disc", (3.0,) * 3, line_of_sight=True)
    robot = torch.full_like(which, 2)
    expected = expected_discoveries(grid, which, cell, robot, three)
    assert expected_discoveries(grid, which, cell, robot * 0, one).equal(expected)


def test_chunks_change_nothing(monkeypatch):
    grid, sight = maps(0.5, 0.1, 3, 8, 8), Sight("disc", (3.0, 2.0), True)
    asked = queries(30, 2, grid)
    whole = expected_discoveries(grid, *asked, sight)
    for cells in (1, 50, 500):
        monkeypatch.setattr(rules, "CELLS_AT_ONCE", cells)
        assert expected_discoveries(grid, *asked, sight).equal(whole)


@pytest.mark.parametrize("hides", [False, True])
def test_no_queries(hides):
    nothing = torch.zeros(0, dtype=torch.int64)
    for number in (0, 2):
        grid = torch.zeros(number, 4, 4, dtype=torch.int8)
        sight = Sight("disc", (2.0,), hides)
        assert expected_discoveries(grid, nothing, nothing, nothing, sight).equal(nothing)
    assert line_of_sight(torch.zeros(0, 3, 5, 5, dtype=torch.bool)).shape == (0, 3, 5, 5)


def test_an_unknown_backend_is_refused():
    with pytest.raises(ValueError, match="backend='c' is not one of"):
        rules.line_of_sight(torch.zeros(3, 3, dtype=torch.bool), "c")

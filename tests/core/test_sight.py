"""Shapes and line of sight against the slow oracle of the wider world, and drawn boards."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from marl_explore.core.sight import line_of_sight, most_discovered, shape_mask, shape_radius
from tests.helpers import world_oracle as oracle
from tests.helpers.strategies import repeatable

CPU = torch.device("cpu")


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
    wall = torch.rand(3, side, side, generator=torch.Generator().manual_seed(seed)) < share
    result = line_of_sight(wall)
    for board, found in zip(wall.tolist(), result.tolist(), strict=True):
        expected = oracle.in_sight(board, (k, k), k)
        assert {(r, c) for r in range(side) for c in range(side) if found[r][c]} == expected


def test_line_of_sight_is_symmetric_under_turns_and_mirrors():
    wall = torch.rand(64, 11, 11, generator=torch.Generator().manual_seed(0)) < 0.25
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

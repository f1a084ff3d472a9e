"""Walls between robots and the reach of radio, against the slow oracle of the wider world."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from marl_explore.core.radio import (
    FARTHEST,
    NEVER_LINKED,
    most_squared,
    reach_table,
    walls_between,
    walls_near,
)
from tests.helpers import world_oracle as oracle
from tests.helpers.strategies import repeatable


@repeatable(max_examples=150)
@given(st.data())
def test_walls_between_are_the_oracles(data):
    height, width = data.draw(st.integers(1, 14)), data.draw(st.integers(2, 14))
    chance = torch.Generator().manual_seed(data.draw(st.integers(0, 2**31)))
    obstacles = torch.rand(2, height, width, generator=chance) < 0.4
    size = torch.tensor([height, width])
    start, end = ((torch.rand(2, 8, 2, generator=chance) * size).long() for _ in range(2))
    walls = walls_between(obstacles, start, end, max(height, width))
    assert walls.equal(walls_between(obstacles, end, start, max(height, width)))
    expected = [
        [oracle.walls_between(board, a, b) for a, b in zip(starts, ends, strict=True)]
        for board, starts, ends in zip(
            obstacles.tolist(), start.tolist(), end.tolist(), strict=True
        )
    ]
    assert walls.tolist() == expected


@repeatable(max_examples=300)
@given(
    metres=st.sampled_from([0.0, 0.5, 3.2, 8.0, math.inf]),
    wall_loss=st.sampled_from([0.0, 0.1, 6.0, 400.0, math.inf]),
    exponent=st.sampled_from([0.01, 2.0, 2.5]),
    walls=st.integers(0, 12),
    loss=st.sampled_from([0.0, -9.5, 4.25, -700.0]),
)
def test_the_reach_is_the_oracles(metres, wall_loss, exponent, walls, loss):
    settings = oracle.Settings(
        communication_range=metres, wall_loss_db=wall_loss, path_loss_exponent=exponent
    )
    expected = oracle.reach_squared(settings, 0, 1, walls, loss)
    cells = metres / settings.cell_size
    found = most_squared(cells, wall_loss, exponent, walls, loss)
    # robots are at least a cell apart: 0 and NEVER_LINKED link nobody
    assert max(found, 0) == min(expected, FARTHEST)


def test_the_table_ends_where_walls_alone_are_too_many():
    assert reach_table(16.0, 6.0, 2.5) == (256, 84, 28)
    assert reach_table(16.0, math.inf, 2.0) == (256,)
    assert reach_table(0.0, 6.0, 2.0) == (NEVER_LINKED,)
    assert len(reach_table(math.inf, 6.0, 2.0, most_walls=9)) == 10


@pytest.mark.parametrize(("range_cells", "limit"), [(6.4, 40), (0.0, -1), (math.inf, FARTHEST)])
def test_without_loss_the_reach_is_the_range(range_cells, limit):
    assert most_squared(range_cells, 0.0, 2.0, 0, 0.0) == limit
    assert most_squared(range_cells, 0.0, 2.0, 7, 0.0) == limit


@pytest.mark.parametrize("side", [1, 2, 5, 12, 80])
def test_walls_of_pairs_that_are_near_are_counted_as_those_of_all(side):
    """Short lines by a table, long ones as they come."""
    random = torch.Generator().manual_seed(side)
    obstacles = torch.rand(3, side, side + 1, generator=random) < 0.3
    start, end = (torch.randint(0, side, (3, 40, 2), generator=random) for _ in range(2))
    obstacles[torch.arange(3).unsqueeze(-1), start[..., 0], start[..., 1]] = False  # robots
    near = torch.rand(3, 40, generator=random) < 0.5
    walls = walls_between(obstacles, start, end, side)
    assert walls_near(obstacles, start, end, near).equal(walls * near)
    assert not walls_near(obstacles, start, end, torch.zeros_like(near)).any()

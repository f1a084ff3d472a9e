"""Shortest paths to listed cells: torch and C against the slow oracle."""

from __future__ import annotations

import pytest
import torch

from marl_explore.core import native
from marl_explore.core.frontier import paths_to
from tests.helpers import oracle

BACKENDS = ["torch"] + ([] if native.missing("paths") else ["native"])


def drawn(seed, maps=5, height=6, width=9, listed=12, searches=20):
    chance = torch.Generator().manual_seed(seed)

    def numbers(low, high, *shape):
        return torch.randint(low, high, shape, generator=chance)

    grid = numbers(-1, 2, maps, height, width).to(torch.int8)
    grid[numbers(0, 2, maps, height, width) == 1] = 0
    cells = numbers(0, height * width, maps, listed)
    which = numbers(0, maps, searches)
    return grid, cells, which, numbers(0, height * width, searches)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("seed", range(4))
def test_paths_are_the_oracles(backend, seed):
    grid, cells, which, starts = drawn(seed)
    move, length = paths_to(grid, cells, which, starts, backend)
    for i, (number, start) in enumerate(zip(which.tolist(), starts.tolist(), strict=True)):
        board = grid[number].tolist()
        free = [[cell == 0 for cell in row] for row in board]
        walls = [[cell == 1 for cell in row] for row in board]
        away = oracle.distances(free, walls, divmod(start, 9))
        wanted = [away.get(divmod(cell, 9), 0) for cell in cells[number].tolist()]
        assert length[i].tolist() == wanted
        assert move[i][length[i] == 0].eq(0).all()


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (33, 5), (20, 70)])
def test_backends_agree(size):
    if native.missing("paths"):
        pytest.skip("the C kernel was not built")
    given = drawn(1, 3, *size, listed=30, searches=40)
    for one, other in zip(paths_to(*given, "torch"), paths_to(*given, "native"), strict=True):
        assert one.equal(other)


@pytest.mark.skipif(native.missing("paths") is not None, reason="the C kernel was not built")
def test_the_kernel_refuses_what_it_cannot_answer():
    grid, cells, which, starts = drawn(0)
    with pytest.raises(ValueError, match="outside"):
        paths_to(grid, cells, which, starts + 54)
    with pytest.raises(ValueError, match="outside"):
        paths_to(grid, cells - 54, which, starts)
    with pytest.raises(ValueError, match="there is no such map"):
        paths_to(grid, cells, which + 5, starts)
    with pytest.raises(ValueError, match=r"grid is torch.int64"):
        paths_to(grid.long(), cells, which, starts)
    with pytest.raises(ValueError, match="backend='c'"):
        paths_to(grid, cells, which, starts, "c")

"""Cells that paths reach: torch and C beside a search in plain Python."""

from __future__ import annotations

from collections import deque

import pytest
import torch

from marl_explore.core.mapping import flooded
from marl_explore.core.native.paths import flooded as in_c

STEPS = [(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1) if (r, c) != (0, 0)]


def slow(starts, free, passable):
    """Of one grid [H, W], cell by cell."""
    height, width = free.shape
    reached = starts & free
    queue = deque(reached.nonzero().tolist())
    while queue:
        row, column = queue.popleft()
        for down, right in STEPS:
            r, c = row + down, column + right
            if not (0 <= r < height and 0 <= c < width) or reached[r, c] or not free[r, c]:
                continue
            if down and right and not passable[row, c] and not passable[r, column]:
                continue
            reached[r, c] = True
            queue.append((r, c))
    return reached


@pytest.mark.parametrize("backend", ["torch", "native"])
def test_it_is_what_a_search_finds(backend):
    chance = torch.Generator().manual_seed(0)
    for number in range(60):
        size = [int(torch.randint(1, 10, (), generator=chance)) for _ in range(3)]
        passable = torch.rand(size, generator=chance) > number / 90
        free = passable & (torch.rand(size, generator=chance) > 0.1)  # some are held by others
        starts = torch.rand(size, generator=chance) < 0.1
        found = flooded(starts, free, passable, backend)
        assert found.dtype == torch.bool
        for grid in range(size[0]):
            assert torch.equal(found[grid], slow(starts[grid], free[grid], passable[grid]))


@pytest.mark.parametrize("backend", ["torch", "native"])
@pytest.mark.parametrize("batch", [(), (0,), (2, 3)])
def test_any_batch(backend, batch):
    free = torch.ones(*batch, 4, 5, dtype=torch.bool)
    starts = torch.zeros_like(free)
    assert not flooded(starts, free, free, backend).any()
    starts[..., 1, 1] = True
    assert flooded(starts, free, free, backend).all()
    views = (x.transpose(-1, -2) for x in (starts, free, free))  # not contiguous
    assert flooded(*views, backend).shape == (*batch, 5, 4)


def test_the_operator_is_what_it_says_it_is():
    chance = torch.Generator().manual_seed(0)
    starts, free = (torch.rand(3, 4, 5, generator=chance) < share for share in (0.2, 0.7))
    for given in ((starts, free, free), [x.transpose(-1, -2) for x in (starts, free, free)]):
        torch.library.opcheck(torch.ops.marl_explore.flooded.default, tuple(given))


def test_a_wall_of_two_cells_closes_the_diagonal_between_them():
    free = torch.tensor([[True, False], [False, True]])
    starts = torch.tensor([[True, False], [False, False]])
    for backend in ("torch", "native"):
        assert torch.equal(flooded(starts, free, free, backend), starts)
        passable = torch.tensor([[True, True], [False, True]])  # somebody stands there
        assert torch.equal(flooded(starts, free, passable, backend), free)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"starts": torch.zeros(4, 5)}, "starts is torch.float32 of shape"),
        ({"free": torch.zeros(4, 4, dtype=torch.bool)}, "free is torch.bool of shape"),
        ({"passable": torch.zeros(1, 4, 5, dtype=torch.bool)}, "passable is torch.bool"),
    ],
)
def test_wrong_entries_are_refused(changes, message):
    given = dict.fromkeys(("starts", "free", "passable"), torch.zeros(4, 5, dtype=torch.bool))
    with pytest.raises(ValueError, match=message):
        in_c(**(given | changes))

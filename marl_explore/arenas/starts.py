"""Start cells of robots: scattered over the arena, or together around one cell."""

from __future__ import annotations

import torch
from torch import Tensor

from marl_explore.core.grid import with_robots
from marl_explore.core.hashing import mix
from marl_explore.core.wavefront import batch_last, flood, mask


def scattered(order: Tensor, free: Tensor, count: int) -> Tensor:
    """The free cells with the smallest random numbers.

    Args:
        order: random numbers of the cells, int64 [A, H W].
        free: cells where a robot may start, bool [A, H, W].
        count: robots N.

    Returns:
        Positions, int64 [A, N, 2].
    """
    order = order.masked_fill(~free.flatten(-2), torch.iinfo(torch.int64).max)
    cell = order.topk(count, largest=False).indices
    width = free.shape[-1]
    return torch.stack((cell // width, cell % width), -1)


def clustered(order: Tensor, free: Tensor, count: int) -> Tensor:
    """The free cells nearest by path to the one with the smallest number; ties are random.

    Which robot starts in which of these cells is random too. The free cells must be connected.

    Args:
        order: random numbers of the cells, int64 [A, H W].
        free: cells where a robot may start, bool [A, H, W].
        count: robots N.

    Returns:
        Positions, int64 [A, N, 2].
    """
    center = scattered(order, free, 1)
    distance = _path_levels(center, free, levels=count).flatten(-2)
    by_number = order.argsort(-1)
    by_distance = distance.gather(-1, by_number).argsort(dim=-1, stable=True)
    nearest = by_number.gather(-1, by_distance[:, :count])
    chosen = torch.zeros_like(order, dtype=torch.bool).scatter_(-1, nearest, True)
    # other random numbers, or the first robot would always be in the middle
    return scattered(mix(order), chosen.view(free.shape), count)


def _path_levels(center: Tensor, free: Tensor, levels: int) -> Tensor:
    """1 + length of the shortest path from the centers [A, 1, 2], int32 [A, H, W].

    Cells farther away than ``levels - 1`` moves get ``levels + 1``; in a connected arena the
    ``levels`` nearest cells are never among them.
    """
    here = with_robots(torch.zeros_like(free), center)
    passable = mask(batch_last(free, border=0))
    labels, level = flood(batch_last(here, border=0), passable, passable, levels=levels)
    level = level.masked_fill(labels == 0, levels + 1)
    return level[1:-1, 1:-1].permute(2, 0, 1)


START_RULES = {"scattered": scattered, "clustered": clustered}

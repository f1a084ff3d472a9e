"""Arenas with a fixed number of scattered obstacles at any density, from one draw."""

from __future__ import annotations

from dataclasses import dataclass
from heapq import heappop, heappush

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from marl_explore.arenas.components import largest_component
from marl_explore.arenas.generator import OBSTACLES, ArenaGenerator, Board, numbers
from marl_explore.arenas.uniform import scatter


@dataclass(frozen=True)
class UniformV2(ArenaGenerator):
    """The first draw of ``Uniform``, made connected (docs/environment.md, Arenas).

    Where some free cells are cut off, the largest part alone stays free, and the cell beside it
    with the largest number joins it until the arena has its number of obstacles.
    """

    def obstacles(self, keys: Tensor) -> Tensor:
        """Obstacles bool [A, H, W], exactly the configuration's number, free cells connected."""
        free_cells = self.config.num_cells - self.config.num_obstacles
        order = numbers(keys, OBSTACLES, 0, count=self.config.num_cells)
        free = largest_component(~scatter(order, self.config))
        rows = (free.flatten(-2).sum(-1) < free_cells).nonzero().squeeze(-1)
        for row in rows.tolist():
            first = order[row].argsort(descending=True).cpu().numpy()
            grown = _grow(free[row].cpu().numpy(), first, free_cells)
            free[row] = torch.from_numpy(grown).to(free.device)
        return ~free


def _grow(part: Board, first: NDArray[np.int64], size: int) -> Board:
    """A connected part of an arena, enlarged by the first of the cells beside it, time and again.

    Args:
        part: bool [H, W], at least one cell.
        first: all cells of the arena by rank, int64 [H W].
        size: cells of the enlarged part.

    Returns:
        bool [H, W].
    """
    rank = np.empty_like(first)
    rank[first] = np.arange(len(first))
    beside = ndimage.binary_dilation(part) & ~part  # by straight moves, as in ``components``
    # a border of cells that never join stands for the edges of the arena
    stride = part.shape[1] + 2
    ranks = np.pad(rank.reshape(part.shape), 1).ravel().tolist()
    outside = bytearray(np.pad(~(part | beside), 1).tobytes())
    row, column = np.divmod(first, part.shape[1])
    cells = ((row + 1) * stride + column + 1).tolist()
    waiting = np.sort(rank.reshape(part.shape)[beside]).tolist()  # a heap
    joined = []
    for _ in range(size - int(part.sum())):
        joined.append(heappop(waiting))
        cell = cells[joined[-1]]
        for near in (cell - stride, cell - 1, cell + 1, cell + stride):
            if outside[near]:
                outside[near] = False
                heappush(waiting, ranks[near])
    grown = part.copy()
    grown.ravel()[first[joined]] = True
    return grown

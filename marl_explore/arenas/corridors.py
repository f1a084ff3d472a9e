"""Long corridors with niches along them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from torch import Tensor

from marl_explore.arenas.generator import ArenaGenerator, Board, Draw, one_by_one

BAND = 8  # rows per corridor
WIDTH = 2  # of corridors and links (cells), so that two robots can pass
WIDEST_NICHE = 3


@dataclass(frozen=True)
class Corridors(ArenaGenerator):
    """Parallel corridors from side to side, niches along them, and links between neighbours."""

    def obstacles(self, keys: Tensor) -> Tensor:
        """Obstacles bool [A, H, W], free cells connected."""
        return one_by_one(self._board, keys, count=self.config.num_cells)

    def _board(self, draw: Draw) -> Board:
        board = np.ones((self.config.height, self.config.width), bool)
        view = board.T if draw() % 2 else board  # corridors run along the rows of the view
        bands = max(1, len(view) // BAND)
        edges = [band * len(view) // bands for band in range(bands + 1)]
        corridors = [_dig(view[top:bottom], draw) + top for top, bottom in pairwise(edges)]
        half = view.shape[1] // 2
        for upper, lower in pairwise(corridors):
            for start in (0, half):
                left = start + draw() % max(1, half - WIDTH + 1)
                view[upper:lower, left : left + WIDTH] = False
        return board


def _dig(band: Board, draw: Draw) -> int:
    """Dig a corridor with niches into a band, sparing its last row; returns its first row."""
    above = 1 + draw() % max(1, len(band) - WIDTH - 2)
    below = above + WIDTH
    band[above:below] = False
    for side in (band[:above][::-1], band[below:-1]):
        column = draw() % WIDEST_NICHE
        while column < band.shape[1]:
            width, depth = 1 + draw() % WIDEST_NICHE, draw() % (len(side) + 1)
            side[:depth, column : column + width] = False
            column += width + 1 + draw() % 2
    return above

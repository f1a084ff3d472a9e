"""Every implementation of the feature table, called as one: their numbers agree to the last bit."""

from __future__ import annotations

from functools import partial

import numpy as np
import torch

from marl_explore.core import frontier, native
from marl_explore.core.native import operator
from marl_explore.robot import frontier as robot

NAMED = {
    "torch, fixed number of levels": lambda maps, positions, normalize: frontier.feature_table(
        maps, positions, normalize, levels=maps.shape[-2:].numel()
    ),
}


def each(table):
    """A function of one map and cell, numpy, as one of batches of tensors."""

    def tables(maps, positions, normalize):
        grids = maps.reshape(-1, *maps.shape[-2:]).numpy()
        pairs = zip(grids, positions.reshape(-1, 2).tolist(), strict=True)
        found = [table(grid, tuple(cell), normalize) for grid, cell in pairs]
        return torch.from_numpy(np.stack(found)).view(*maps.shape[:-2], 8, 3)

    return tables


NAMED["numpy"] = each(robot.plain_table)
if native.missing() is None:
    NAMED["native, one map"] = each(robot.native_table)
    NAMED["native"] = operator.feature_table
    NAMED["native, by queue"] = partial(operator.feature_table, rows=False)


def feature_table(maps, positions, normalize="relative", levels=None):
    """``core.frontier.feature_table``, once all others have been held against it."""
    table = frontier.feature_table(maps, positions, normalize, levels)
    if levels is None:
        for name, implementation in NAMED.items():
            assert implementation(maps, positions, normalize).equal(table), name
    return table

"""Every implementation of the feature table, called as one: their numbers agree to the last bit."""

from __future__ import annotations

from functools import partial

from marl_explore import native
from marl_explore.core import frontier
from marl_explore.native import operator

NAMED = {
    "torch, fixed number of levels": lambda maps, positions, normalize: frontier.feature_table(
        maps, positions, normalize, levels=maps.shape[-2:].numel()
    ),
}
if native.missing() is None:
    NAMED["native"] = operator.feature_table
    NAMED["native, by queue"] = partial(operator.feature_table, rows=False)


def feature_table(maps, positions, normalize="relative", levels=None):
    """``core.frontier.feature_table``, once all others have been held against it."""
    table = frontier.feature_table(maps, positions, normalize, levels)
    if levels is None:
        for name, implementation in NAMED.items():
            assert implementation(maps, positions, normalize).equal(table), name
    return table

"""The native kernel that merges maps as a torch operator on whole batches."""

from __future__ import annotations

import torch
from torch import Tensor

from marl_explore.core import native
from marl_explore.core.native.threads import share_rows

CELLS_PER_THREAD = 2**20
"""Maps of fewer cells in all are merged before another thread has started."""

_MERGE = "marl_explore::merge"
torch.library.define(
    _MERGE,
    "(Tensor(a!) maps, Tensor linked, Tensor communicating, Tensor target)"
    " -> (Tensor, Tensor, Tensor)",
)


@torch.library.impl(_MERGE, "cpu")
def _merge(
    maps: Tensor, linked: Tensor, communicating: Tensor, target: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    team, height, width = maps.shape[-3:]
    arrays = [x.contiguous() for x in (linked, communicating, target)]
    network = torch.zeros_like(arrays[0])
    counts = torch.zeros(2, *communicating.shape, dtype=torch.int64)
    addresses = (x.data_ptr() for x in (*arrays, maps, network, counts[0], counts[1]))
    teams = native.Teams(*addresses, team, height * width)
    function = native.kernel("merge")

    def run(first: int, last: int) -> int:
        return function(teams, first, last)  # ctypes releases the GIL

    arenas = communicating.shape[:-1].numel()
    per_thread = max(1, CELLS_PER_THREAD // (team * height * width))
    native.check(share_rows(run, arenas, per_thread), height, width)
    return network, counts[0], counts[1]


@torch.library.register_fake(_MERGE)
def _(
    maps: Tensor, linked: Tensor, communicating: Tensor, target: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    counts = communicating.new_empty(2, *communicating.shape, dtype=torch.int64)
    return torch.empty_like(linked), counts[0], counts[1]


def merge(
    maps: Tensor, linked: Tensor, communicating: Tensor, target: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Merge the maps of robots that communicate, in place.

    Args:
        maps: contiguous, int8 [*B, N, H, W].
        linked: bool [*B, N, N].
        communicating: bool [*B, N].
        target: cells that are counted apart, bool [*B, H, W].

    Returns:
        Pairs in one network, bool [*B, N, N]; new cells, and new target cells, int64 [*B, N] each.
    """
    return torch.ops.marl_explore.merge.default(maps, linked, communicating, target)

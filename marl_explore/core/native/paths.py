"""The native kernel for shortest paths as a torch operator on whole batches."""

from __future__ import annotations

import torch
from torch import Tensor

from marl_explore.core import native
from marl_explore.core.native.threads import share_rows

CELLS_PER_THREAD = 2**17
"""Searches of maps of fewer cells in all finish before another thread has started."""

_OPERATOR = "marl_explore::paths_to"
torch.library.define(
    _OPERATOR, "(Tensor grid, Tensor cells, Tensor which, Tensor starts) -> (Tensor, Tensor)"
)


@torch.library.impl(_OPERATOR, "cpu")
def _paths_to(grid: Tensor, cells: Tensor, which: Tensor, starts: Tensor) -> tuple[Tensor, Tensor]:
    arrays = [x.contiguous() for x in (grid, cells, which, starts)]
    found = [which.new_empty(len(which), cells.shape[-1]) for _ in range(2)]
    addresses = [x.data_ptr() for x in (*arrays, *found)]
    height, width = grid.shape[-2:]
    queries = native.PathQueries(*addresses, *grid.shape, cells.shape[-1])
    function = native.kernel("paths")

    def run(first: int, last: int) -> int:
        return function(queries, first, last)

    searches = -(-CELLS_PER_THREAD // max(1, height * width))
    native.check(share_rows(run, len(which), searches), height, width)
    return found[0], found[1]


@torch.library.register_fake(_OPERATOR)
def _(grid: Tensor, cells: Tensor, which: Tensor, starts: Tensor) -> tuple[Tensor, Tensor]:
    shape = (len(which), cells.shape[-1])
    return which.new_empty(shape), which.new_empty(shape)


def paths_to(grid: Tensor, cells: Tensor, which: Tensor, starts: Tensor) -> tuple[Tensor, Tensor]:
    """``core.frontier.paths_to`` in C, equal in every entry, on the CPU.

    Raises:
        ValueError: for entries of another dtype, shape or device, for a cell outside its map, and
            for a map that there is not.
        RuntimeError: when the kernel cannot be used.
    """
    wanted = {
        "grid": (grid, torch.int8, grid.ndim == 3),
        "cells": (cells, torch.int64, cells.ndim == 2 and len(cells) == len(grid)),
        "which": (which, torch.int64, which.ndim == 1),
        "starts": (starts, torch.int64, starts.shape == which.shape),
    }
    for name, (entry, dtype, fits) in wanted.items():
        if not fits or entry.dtype != dtype or entry.device.type != "cpu":
            raise ValueError(
                f"{name} is {entry.dtype} of shape {tuple(entry.shape)} on {entry.device}; allowed "
                "are grid int8 [M, H, W], cells [M, F], which [Q] and starts [Q] int64 on the CPU"
            )
    return torch.ops.marl_explore.paths_to.default(grid, cells, which, starts)

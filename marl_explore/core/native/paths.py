"""The native kernels for paths as torch operators on whole batches."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from marl_explore.core import native
from marl_explore.core.native.threads import share_rows

CELLS_PER_THREAD = 2**17
"""Searches of maps of fewer cells in all finish before another thread has started."""

CELLS_FLOODED_PER_THREAD = 2**19
"""The same of floods."""

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


_FLOOD = "marl_explore::flooded"
torch.library.define(_FLOOD, "(Tensor starts, Tensor free, Tensor passable) -> Tensor")


@torch.library.impl(_FLOOD, "cpu")
def _flooded(starts: Tensor, free: Tensor, passable: Tensor) -> Tensor:
    arrays = [x.contiguous() for x in (starts, free, passable)]
    reached = torch.empty_like(arrays[0])
    *batch, height, width = starts.shape
    floods = native.Floods(*(x.data_ptr() for x in (*arrays, reached)), height, width)
    function = native.kernel("floods")

    def run(first: int, last: int) -> int:
        return function(floods, first, last)

    grids = -(-CELLS_FLOODED_PER_THREAD // max(1, height * width))
    native.check(share_rows(run, math.prod(batch), grids), height, width)
    return reached


@torch.library.register_fake(_FLOOD)
def _(starts: Tensor, free: Tensor, passable: Tensor) -> Tensor:
    return starts.new_empty(starts.shape)


def flooded(starts: Tensor, free: Tensor, passable: Tensor) -> Tensor:
    """``core.mapping.flooded`` in C, equal in every entry where all free cells are passable.

    Raises:
        ValueError: for entries of another dtype, shape or device.
        RuntimeError: when the kernel cannot be used.
    """
    for name, entry in {"starts": starts, "free": free, "passable": passable}.items():
        fits = entry.shape == starts.shape and entry.ndim >= 2
        if not fits or entry.dtype != torch.bool or entry.device.type != "cpu":
            raise ValueError(
                f"{name} is {entry.dtype} of shape {tuple(entry.shape)} on {entry.device}; allowed "
                "are starts, free and passable bool [*B, H, W] on the CPU"
            )
    return torch.ops.marl_explore.flooded.default(starts, free, passable)

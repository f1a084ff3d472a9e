"""The native kernels for sight as torch operators on whole batches."""

from __future__ import annotations

import torch
from torch import Tensor

from marl_explore.core import native
from marl_explore.core.native.threads import share_rows

CELLS_PER_THREAD = 2**19
"""Windows of fewer cells in all finish before another thread has started."""

_SIGHT, _DISCOVERIES = "marl_explore::line_of_sight", "marl_explore::expected_discoveries"
torch.library.define(_SIGHT, "(Tensor wall) -> Tensor")
torch.library.define(
    _DISCOVERIES,
    "(Tensor grid, Tensor which, Tensor cell, Tensor kind, Tensor masks, bool hides) -> Tensor",
)


@torch.library.impl(_SIGHT, "cpu")
def _line_of_sight(wall: Tensor) -> Tensor:
    wall = wall.contiguous()
    seen = torch.empty_like(wall)
    side = wall.shape[-1]
    function = native.kernel("sight")

    def run(first: int, last: int) -> int:
        start = first * side * side
        return function(  # ctypes releases the GIL
            wall.data_ptr() + start, last - first, side, seen.data_ptr() + start
        )

    windows = wall.shape[:-2].numel()
    native.check(share_rows(run, windows, windows_per_thread(side)), side, side)
    return seen


@torch.library.impl(_DISCOVERIES, "cpu")
def _expected_discoveries(
    grid: Tensor, which: Tensor, cell: Tensor, kind: Tensor, masks: Tensor, hides: bool
) -> Tensor:
    arrays = [x.contiguous() for x in (grid, which, cell, kind, masks)]
    found = which.new_empty(which.shape)
    addresses = [x.data_ptr() for x in (*arrays, found)]
    side, (height, width) = masks.shape[-1], grid.shape[-2:]
    queries = native.SightQueries(*addresses, *grid.shape, *masks.shape[:-1], hides)
    function = native.kernel("discoveries")

    def run(first: int, last: int) -> int:
        return function(queries, first, last)

    native.check(share_rows(run, len(which), windows_per_thread(side)), height, width)
    return found


def windows_per_thread(side: int) -> int:
    """A thread is worth starting for so many windows."""
    return -(-CELLS_PER_THREAD // side**2)


@torch.library.register_fake(_SIGHT)
def _(wall: Tensor) -> Tensor:
    return wall.new_empty(wall.shape)


@torch.library.register_fake(_DISCOVERIES)
def _(grid: Tensor, which: Tensor, *others: Tensor | bool) -> Tensor:
    return which.new_empty(which.shape)


@torch.library.register_vmap(_SIGHT)
def _(info: object, in_dims: tuple[int], wall: Tensor) -> tuple[Tensor, int]:
    return torch.ops.marl_explore.line_of_sight.default(wall.movedim(in_dims[0], 0)), 0


@torch.library.register_vmap(_DISCOVERIES)
def _(info: object, in_dims: tuple[int | None, ...], *inputs: Tensor | bool) -> tuple[Tensor, int]:
    size = info.batch_size  # type: ignore[attr-defined]
    entries = [
        [x] * size if dim is None or not isinstance(x, Tensor) else x.unbind(dim)
        for x, dim in zip(inputs, in_dims, strict=True)
    ]
    operator = torch.ops.marl_explore.expected_discoveries.default
    return torch.stack([operator(*entry) for entry in zip(*entries, strict=True)]), 0


def line_of_sight(wall: Tensor) -> Tensor:
    """``core.sight.line_of_sight`` in C, equal in every cell, on the CPU.

    Args:
        wall: bool [*B, 2k + 1, 2k + 1].

    Returns:
        bool of the same shape.

    Raises:
        ValueError: for another dtype, shape or device.
        RuntimeError: when the kernel cannot be used.
    """
    _require("wall", wall, torch.bool, "[..., 2k + 1, 2k + 1]", wall.ndim > 1 and _odd(wall))
    return torch.ops.marl_explore.line_of_sight.default(wall)


def expected_discoveries(
    grid: Tensor, which: Tensor, cell: Tensor, kind: Tensor, masks: Tensor, hides: bool
) -> Tensor:
    """``core.sight.expected_discoveries`` in C, equal in every entry, on the CPU.

    Args:
        grid: maps, int8 [M, H, W].
        which: the map of each query, int64 [Q].
        cell: the cell to look from, row * W + column, int64 [Q].
        kind: its mask, int64 [Q].
        masks: cells of the shapes of sensors in a window, bool [T, 2k + 1, 2k + 1].
        hides: whether obstacles hide what lies behind them.

    Returns:
        int64 [Q].

    Raises:
        ValueError: for entries of another dtype, shape or device, for a cell outside its map, and
            for a map or mask that there is not.
        RuntimeError: when the kernel cannot be used.
    """
    _require("grid", grid, torch.int8, "[M, H, W]", grid.ndim == 3)
    for name, entry in {"which": which, "cell": cell, "kind": kind}.items():
        _require(name, entry, torch.int64, f"[{which.numel()}]", entry.shape == (which.numel(),))
    _require("masks", masks, torch.bool, "[T, 2k + 1, 2k + 1]", masks.ndim == 3 and _odd(masks))
    return torch.ops.marl_explore.expected_discoveries.default(
        grid, which, cell, kind, masks, hides
    )


def _odd(windows: Tensor) -> bool:
    """Whether windows are squares with a centre."""
    side = windows.shape[-1]
    return windows.shape[-2] == side and side % 2 == 1


def _require(name: str, entry: Tensor, dtype: torch.dtype, shape: str, fits: bool) -> None:
    if not fits or entry.dtype != dtype or entry.device.type != "cpu":
        raise ValueError(
            f"{name} must be {dtype} {shape} on the CPU, got {entry.dtype} of shape "
            f"{tuple(entry.shape)} on {entry.device}"
        )

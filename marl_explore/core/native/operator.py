"""The native kernel as a torch operator on whole batches."""

from __future__ import annotations

import torch
from torch import Tensor

from marl_explore.config.constants import (
    NORMALIZATIONS,
    NUM_DIRECTIONS,
    NUM_FEATURES,
    Normalization,
)
from marl_explore.core import native
from marl_explore.core.native.threads import share_rows

ROBOTS_PER_THREAD = 512
"""Smaller batches finish before another thread has started."""

# defined without custom_op, whose wrapper takes longer than the tables of a few arenas
_OPERATOR = "marl_explore::frontier_table"
torch.library.define(_OPERATOR, "(Tensor grid, Tensor position, int mode, bool rows) -> Tensor")


@torch.library.impl(_OPERATOR, "cpu")
def _frontier_table(grid: Tensor, position: Tensor, mode: int, rows: bool) -> Tensor:
    height, width = grid.shape[-2:]
    size = (*grid.shape[:-2], NUM_DIRECTIONS, NUM_FEATURES)
    table = torch.empty(size, dtype=torch.float32)  # what C writes, whatever torch's default
    grid, position = grid.contiguous(), position.contiguous()
    robots = position.shape[:-1].numel()
    function = native.kernel()

    def run(first: int, last: int) -> int:
        return function(  # ctypes releases the GIL
            grid.data_ptr() + first * height * width,
            position.data_ptr() + first * 2 * position.element_size(),
            last - first,
            height,
            width,
            mode,
            rows,
            table.data_ptr() + first * NUM_DIRECTIONS * NUM_FEATURES * table.element_size(),
        )

    native.check(share_rows(run, robots, ROBOTS_PER_THREAD), height, width)
    return table


@torch.library.register_fake(_OPERATOR)
def _(grid: Tensor, position: Tensor, mode: int, rows: bool) -> Tensor:
    return grid.new_empty(*grid.shape[:-2], NUM_DIRECTIONS, NUM_FEATURES, dtype=torch.float32)


@torch.library.register_vmap(_OPERATOR)
def _(
    info: object,
    in_dims: tuple[int | None, ...],
    grid: Tensor,
    position: Tensor,
    mode: int,
    rows: bool,
) -> tuple[Tensor, int]:
    size = info.batch_size  # type: ignore[attr-defined]
    batched = [
        x.expand(size, *x.shape) if dim is None else x.movedim(dim, 0)
        for x, dim in zip((grid, position), in_dims, strict=False)
    ]
    return torch.ops.marl_explore.frontier_table.default(*batched, mode, rows), 0


def feature_table(
    grid: Tensor,
    position: Tensor,
    normalize: Normalization | None = "relative",
    rows: bool = True,
) -> Tensor:
    """``core.frontier.feature_table`` in C, bit-identical, on the CPU.

    Args:
        grid: maps, int8 [*B, H, W].
        position: int64 [*B, 2], inside the maps.
        normalize: "relative", "proximity", "absolute" or None.
        rows: whether small grids may be searched a row at a time, which is fast; False searches
            all grids with a queue, as with compilers without vector extensions.

    Returns:
        float32 [*B, 8, 3].

    Raises:
        ValueError: for an unknown normalisation, entries of another dtype, shape or device, or a
            position outside its map.
        RuntimeError: when the kernel cannot be used.
    """
    if normalize not in NORMALIZATIONS:
        raise ValueError(f"normalize={normalize!r} is not one of {NORMALIZATIONS}")
    if grid.dtype != torch.int8 or grid.device.type != "cpu":
        raise ValueError(f"grid must be int8 on the CPU, got {grid.dtype} on {grid.device}")
    if position.dtype != torch.int64 or position.shape != (*grid.shape[:-2], 2):
        raise ValueError(
            f"position must be int64 of shape {(*grid.shape[:-2], 2)}, got {position.dtype} of "
            f"shape {tuple(position.shape)}"
        )
    return torch.ops.marl_explore.frontier_table.default(
        grid, position, native.MODES[normalize], rows
    )

"""The native kernel for candidate goals as a torch operator on whole batches."""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor

from marl_explore.config.constants import GOAL_COLUMNS, MAX_FRONTIERS
from marl_explore.config.shapes import Sight
from marl_explore.core import native
from marl_explore.core.goals import GoalTable, Situation, unseen_in_sight
from marl_explore.core.grid import NUM_DIRECTIONS
from marl_explore.core.native.threads import share_rows

ROBOTS_PER_THREAD = 64
"""Smaller batches finish before another thread has started."""

_OPERATOR = "marl_explore::goal_table"
torch.library.define(
    _OPERATOR,
    "(Tensor grid, Tensor position, Tensor taken, Tensor allowed, Tensor seen_step, "
    "Tensor seen_cell, Tensor known_by, Tensor covered, Tensor heading, Tensor goal, "
    "Tensor? gains, int[] radii) -> (Tensor, Tensor, Tensor, Tensor)",
)


def _empty(grid: Tensor) -> GoalTable:
    """Tables for maps [*B, N, H, W], to be filled."""
    *batch, team = grid.shape[:-2]
    rows = (*batch, team, MAX_FRONTIERS)
    return GoalTable(
        grid.new_empty((*rows, len(GOAL_COLUMNS)), dtype=torch.int32),
        grid.new_empty((*rows, team, 2), dtype=torch.int32),
        grid.new_empty((*batch, team, team, 2), dtype=torch.int32),
        grid.new_empty((*batch, team), dtype=torch.bool),
    )


@torch.library.impl(_OPERATOR, "cpu")
def _goal_table(*inputs: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    *known, gains, radii = inputs
    arrays = [x.contiguous() for x in known]
    gains = None if gains is None else gains.contiguous()
    own = (ctypes.c_int64 * len(radii))(*radii)
    team, height, width = arrays[0].shape[-3:]
    robots = arrays[0].shape[:-2].numel()
    tables = _empty(arrays[0])
    addresses = (
        *(x.data_ptr() for x in arrays),
        ctypes.addressof(own),
        None if gains is None else gains.data_ptr(),
        *(x.data_ptr() for x in tables),
    )
    batch = native.GoalBatch(*addresses, team, height, width, len(own))
    function = native.kernel("goals")

    def run(first: int, last: int) -> int:
        return function(batch, first, last)  # ctypes releases the GIL

    native.check(share_rows(run, robots, ROBOTS_PER_THREAD), height, width)
    return tables


@torch.library.register_fake(_OPERATOR)
def _(grid: Tensor, *others: Tensor | list[int] | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return _empty(grid)


@torch.library.register_vmap(_OPERATOR)
def _(
    info: object, in_dims: tuple[int | None, ...], *inputs: Tensor | list[int] | None
) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
    size = info.batch_size  # type: ignore[attr-defined]

    def batched(x: Tensor | list[int] | None, dim: int | None) -> Tensor | list[int] | None:
        if not isinstance(x, Tensor):
            return x
        return x.expand(size, *x.shape) if dim is None else x.movedim(dim, 0)

    tables = torch.ops.marl_explore.goal_table.default(
        *(batched(x, dim) for x, dim in zip(inputs, in_dims, strict=True))
    )
    return tuple(tables), (0,) * len(tables)


def goal_table(situation: Situation, sight: Sight) -> GoalTable:
    """``core.goals.goal_table`` in C, equal in every entry, on the CPU.

    Args:
        situation: what each robot knows; positions, and cells where teammates were seen, are
            inside the maps.
        sight: of the robots; every k is at least 1.

    Raises:
        ValueError: for a k below 1, ranges of another number of robots, entries of another dtype,
            shape or device, or a cell outside the map.
        RuntimeError: when the kernel cannot be used.
    """
    if (smallest := min(sight.radii)) < 1:
        raise ValueError(f"radius={smallest} is not at least 1")
    grid, memory = situation.grid, situation.memory
    *batch, team, height, width = grid.shape
    if len(sight.radii) not in (1, team):
        raise ValueError(f"sight has {len(sight.radii)} ranges, and the team {team} robots")
    robots, bits = (*batch, team), (*batch, team, NUM_DIRECTIONS)
    pairs, cells, places = (*robots, team), (height, width), torch.int64
    inputs = {
        "grid": (grid, torch.int8, (*robots, *cells)),
        "position": (situation.position, places, (*robots, 2)),
        "taken": (situation.taken, torch.bool, bits),
        "allowed": (situation.allowed, torch.bool, bits),
        "seen.step": (memory.seen.step, places, pairs),
        "seen.cell": (memory.seen.cell, places, (*pairs, 2)),
        "known_by": (memory.known_by, torch.bool, (*pairs, *cells)),
        "covered": (memory.covered, torch.bool, (*robots, *cells)),
        "heading": (memory.heading, places, robots),
        "goal": (memory.goal, places, (*robots, 2)),
    }
    for name, (tensor, dtype, shape) in inputs.items():
        if tensor.device.type != "cpu" or tensor.dtype != dtype or tensor.shape != shape:
            raise ValueError(
                f"{name} must be {dtype} of shape {shape} on the CPU, got {tensor.dtype} of "
                f"shape {tuple(tensor.shape)} on {tensor.device}"
            )
    tensors = [tensor for tensor, _, _ in inputs.values()]
    operator = torch.ops.marl_explore.goal_table.default
    if sight.fills_windows:
        return GoalTable(*operator(*tensors, None, sight.radii))
    gains = unseen_in_sight(situation, situation.beside, sight, "native")
    table = GoalTable(*operator(*tensors, gains, sight.radii))
    row, column, size, near = (
        table.frontiers[..., GOAL_COLUMNS.index(name)]
        for name in ("row", "column", "merged_cells", "near_gain")
    )
    gains = unseen_in_sight(situation, row.long() * width + column, sight, "native")
    near.copy_(gains * (size > 0))
    return table

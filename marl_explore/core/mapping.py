"""Merging and measuring occupancy maps."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from marl_explore.config.constants import TOLERANCE
from marl_explore.core.grid import (
    FREE,
    NUM_DIRECTIONS,
    STAY,
    UNKNOWN,
    beside_any,
    flat_cell,
    with_robots,
)
from marl_explore.core.native import Backend
from marl_explore.core.native import paths as kernel
from marl_explore.core.native.choice import in_use
from marl_explore.core.wavefront import batch_last, flood, mask


def blank_maps(position: Tensor, height: int, width: int) -> Tensor:
    """Maps in which only the robots' own cells [*B, N, 2] are known, int8 [*B, N, H, W]."""
    shape = (*position.shape[:-1], height * width)
    grid = torch.full(shape, UNKNOWN, dtype=torch.int8, device=position.device)
    grid.scatter_(-1, flat_cell(position, width).unsqueeze(-1), FREE)
    return grid.unflatten(-1, (height, width))


def closed_diagonals(wall: Tensor) -> Tensor:
    """Diagonals between two walls [*B, N, 9], from the walls ``sensing.beside`` [*B, N, 9].

    Both are bool, or int8 of 0 and 1.
    """
    left, right = _sides(wall.device)
    return wall.index_select(-1, left) & wall.index_select(-1, right)


@lru_cache
def _sides(device: torch.device) -> tuple[Tensor, Tensor]:
    """The directions on either side of each diagonal, int64 [9]; else the own cell, not a wall."""
    left = [(d - 1) % NUM_DIRECTIONS if d % 2 else STAY for d in range(STAY + 1)]
    right = [(d + 1) % NUM_DIRECTIONS if d % 2 else STAY for d in range(STAY + 1)]
    return torch.tensor(left, device=device), torch.tensor(right, device=device)


# Where many cells are combined or counted, known cells are float masks: products and sums of floats
# are fast on every device, comparing and selecting cells is not. Sums are exact up to 2^24 cells.


def known_mask(grid: Tensor) -> Tensor:
    """1 at known cells, 0 elsewhere, float32; maps of any shape."""
    return (grid + 1).clamp_max_(1).float()


def merge(known: Tensor, group: Tensor) -> Tensor:
    """What robots know after those of each group have merged their maps.

    Args:
        known: ``known_mask`` of the maps, float32 [K, C].
        group: the row of one of its members, the same for all of a group, int64 [K].

    Returns:
        float32 [K, C] of 0 and 1.
    """
    place = group.unsqueeze(-1).expand_as(known)
    return known.scatter_reduce(0, place, known, "amax").index_select(0, group)


def union_of(grid: Tensor, alive: Tensor | None = None) -> Tensor:
    """The union of a team's maps [*B, N, H, W], int8 [*B, H, W].

    Args:
        grid: maps, int8 [*B, N, H, W].
        alive: robots whose maps count, bool [*B, N]; None: all.
    """
    if alive is not None:
        grid = grid.masked_fill(~alive[..., None, None], UNKNOWN)
    return grid.amax(-3)  # unknown is the lowest value, and known cells agree


def draw(known: Tensor, obstacles: Tensor) -> Tensor:
    """Maps with the true values of the known cells.

    Args:
        known: float32 [*B, N, H, W] of 0 and 1.
        obstacles: bool [*B, H, W].

    Returns:
        int8 [*B, N, H, W].
    """
    codes = obstacles.unsqueeze(-3).to(torch.int8) - UNKNOWN
    return known.to(torch.int8).mul_(codes).add_(UNKNOWN)


def known_cells(known: Tensor) -> Tensor:
    """Number of known cells |M|, int64 [*B], of a ``known_mask`` [*B, H, W]."""
    return known.flatten(-2).sum(-1).long()


def known_targets(known: Tensor, target: Tensor) -> Tensor:
    """Known target cells of each robot, int64 [*B, N].

    Args:
        known: ``known_mask`` of the maps, float32 [*B, N, H, W].
        target: bool [*B, H, W].
    """
    weights = target.flatten(-2).unsqueeze(-2).float()
    return (weights @ known.flatten(-2).transpose(-1, -2)).squeeze(-2).long()


def reachable_cells(obstacles: Tensor, position: Tensor) -> Tensor:
    """Free cells that some robot can reach by legal moves; robots do not block one another.

    Args:
        obstacles: bool [*B, H, W].
        position: int64 [*B, N, 2].

    Returns:
        bool [*B, H, W].
    """
    starts = with_robots(torch.zeros_like(obstacles), position)
    free = ~obstacles
    return flooded(starts, free, free)


def flooded(starts: Tensor, free: Tensor, passable: Tensor, backend: Backend = "auto") -> Tensor:
    """Free cells to which legal moves lead from some free start, all bool [*B, H, W].

    Args:
        starts: where paths begin.
        free: cells that they may enter, all of them passable.
        passable: two other cells close the diagonal between them.
        backend: "torch", "native" (C, CPU tensors only), or "auto" (native where possible).
    """
    if in_use("floods", backend, starts.device):
        return kernel.flooded(starts, free, passable)
    cells = (batch_last(x.reshape(-1, *x.shape[-2:]), border=0) for x in (starts, free, passable))
    first, free_last, passable_last = cells
    labels, _ = flood(first, mask(free_last), mask(passable_last))
    reached = (labels != 0)[1:-1, 1:-1].permute(2, 0, 1).contiguous()
    return reached.view(starts.shape)


def finishable(
    obstacles: Tensor, position: Tensor, alive: Tensor, grid: Tensor, target: Tensor
) -> Tensor:
    """Whether the living robots know all target cells or can still drive to them, bool [*B].

    They drive around robots that failed; walkers do not count. That they might see past one, or may
    never meet to share what they know, is not considered.

    Args:
        obstacles: bool [*B, H, W].
        position: int64 [*B, N, 2].
        alive: bool [*B, N].
        grid: maps, int8 [*B, N, H, W].
        target: bool [*B, H, W].
    """
    living, failed = (_held(position, robots, obstacles) for robots in (alive, ~alive))
    reached = flooded(living, ~obstacles & ~failed, ~obstacles)
    known = union_of(grid, alive) != UNKNOWN
    left = target & ~known & ~(reached | beside_any(reached))
    return ~left.flatten(-2).any(-1) & alive.any(-1)


def _held(position: Tensor, robots: Tensor, obstacles: Tensor) -> Tensor:
    """Cells of some robots bool [*B, N], bool [*B, H, W]."""
    cell = flat_cell(position, obstacles.shape[-1])
    held = torch.zeros_like(obstacles.flatten(-2), dtype=torch.int64)
    return held.scatter_add_(-1, cell, robots.long()).bool().view(obstacles.shape)


def target_cells(obstacles: Tensor, position: Tensor) -> Tensor:
    """Cells that are to be mapped: reachable cells and their 4-neighbours, bool [*B, H, W]."""
    reachable = reachable_cells(obstacles, position)
    return reachable | beside_any(reachable)


def connected(obstacles: Tensor) -> Tensor:
    """Whether legal moves connect all free cells, bool [*B], for obstacles [*B, H, W]."""
    free = ~obstacles.flatten(-2)
    first = free.to(torch.uint8).argmax(-1, keepdim=True)
    width = obstacles.shape[-1]
    start = torch.stack((first // width, first % width), -1)
    reachable = reachable_cells(obstacles, start).flatten(-2)
    return (reachable | ~free).all(-1)


def cells_of_share(share: float, cells: Tensor) -> Tensor:
    """Smallest number of whole cells that is a share of ``cells`` [*B], float64 [*B]."""
    # the tolerance keeps 0.9 * 110 from requiring one more cell
    return (share * cells.double() - TOLERANCE).ceil()

"""Frontiers, and the feature table of paths to them in the eight directions (FPR)."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from marl_explore.config.constants import NORMALIZATIONS as NORMALIZATIONS
from marl_explore.config.constants import Normalization as Normalization
from marl_explore.core.grid import (
    FREE,
    NUM_DIRECTIONS,
    OCCUPIED,
    UNKNOWN,
    beside_any,
    compass,
    flat_cell,
)
from marl_explore.core.native import Backend
from marl_explore.core.native import paths as kernel
from marl_explore.core.native.choice import in_use
from marl_explore.core.wavefront import batch_last, flood, mask


def frontier_mask(grid: Tensor) -> Tensor:
    """Known free cells with an unknown 4-neighbour, bool [*B, H, W], of maps [*B, H, W]."""
    return beside_any(grid == UNKNOWN) & (grid == FREE)


def feature_table(
    grid: Tensor,
    position: Tensor,
    normalize: Normalization | None = "relative",
    levels: int | None = None,
) -> Tensor:
    """Number and lengths of the paths to frontiers, by their first move (Algorithm 1).

    Per direction, the number of paths, their mean length and the population standard deviation of
    their lengths (cells), over the shortest paths from the robot to every frontier that it can
    reach through known free cells. Of several shortest paths the one with the lowest first
    direction counts.

    Args:
        grid: maps, int8 [*B, H, W], -1 unknown, 0 free, 1 occupied.
        position: int64 [*B, 2].
        normalize: "relative", "proximity", "absolute" or None (raw); see docs/environment.md, FPR.
        levels: maximum path length, searched without host synchronisation; None: all paths.

    Returns:
        float32 [*B, 8, 3].
    """
    if normalize not in NORMALIZATIONS:
        raise ValueError(f"normalize={normalize!r} is not one of {NORMALIZATIONS}")
    *batch, height, width = grid.shape
    grids = grid.reshape(-1, height, width)
    found = _trajectories(grids, position.reshape(-1, 2), levels)
    table = _normalized(_moments(found, len(grids)), normalize, height, width)
    return table.view(*batch, NUM_DIRECTIONS, 3)


def nearest_frontier(grid: Tensor, position: Tensor) -> tuple[Tensor, Tensor]:
    """First move of the shortest path to any frontier, and its length.

    Args:
        grid: maps, int8 [*B, H, W].
        position: int64 [*B, 2].

    Returns:
        Direction and length (cells), int64 [*B] each; both 0 where no frontier can be reached.
    """
    *batch, height, width = grid.shape
    found = _trajectories(grid.reshape(-1, height, width), position.reshape(-1, 2), levels=None)
    rank = found.length.long() * NUM_DIRECTIONS + found.direction
    nearest = torch.zeros(position.shape[:-1].numel(), dtype=torch.int64, device=grid.device)
    nearest.scatter_reduce_(0, found.robot, rank, "amin", include_self=False)
    nearest = nearest.view(batch)
    return nearest % NUM_DIRECTIONS, nearest // NUM_DIRECTIONS


def paths(grid: Tensor, position: Tensor) -> tuple[Tensor, Tensor]:
    """First move and length of the shortest path to every known free cell.

    Args:
        grid: maps, int8 [*B, H, W].
        position: int64 [*B, 2]; the robot's cell need not be known.

    Returns:
        Directions int64 and lengths int64 (cells), [*B, H, W] each; both 0 in the robot's own cell
        and in unreachable cells.
    """
    labels, length = first_moves(grid, position)
    return _lowest_bit(grid.device)[labels.int()], length


def paths_to(
    grid: Tensor, cells: Tensor, which: Tensor, starts: Tensor, backend: Backend = "auto"
) -> tuple[Tensor, Tensor]:
    """``paths`` to listed cells of each map, from any number of starts.

    Args:
        grid: maps, int8 [M, H, W].
        cells: the listed cells of every map, row * W + column, int64 [M, F].
        which: the map of each search, int64 [Q].
        starts: the cell that it starts from, int64 [Q].
        backend: "torch", "native" (C, CPU tensors only), or "auto" (native where possible). The
            results are equal.

    Returns:
        Directions and lengths (cells), int64 [Q, F] each; both 0 in the start and for cells without
        a path.

    Raises:
        ValueError: for an unknown backend; by the native one for entries of another dtype or shape,
            a cell outside its map, and a map that there is not.
        RuntimeError: when the native backend is requested and cannot be used.
    """
    if in_use("paths", backend, grid.device):
        return kernel.paths_to(grid, cells, which, starts)
    width, cell = grid.shape[-1], cells[which]
    direction, length = paths(grid[which], torch.stack((starts // width, starts % width), -1))
    return direction.flatten(1).gather(1, cell), length.flatten(1).gather(1, cell)


def first_moves(
    grid: Tensor, position: Tensor, closed: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """All first moves of the shortest paths to every known free cell, and their length.

    Args:
        grid: maps, int8 [*B, H, W].
        position: int64 [*B, 2]; the robot's cell need not be known.
        closed: cells that paths may not enter, bool [*B, H, W]; they close no diagonals.

    Returns:
        Sets of directions uint8 (bit d for direction d) and lengths int64 (cells), [*B, H, W] each;
        both 0 in the robot's own cell and in unreachable cells.
    """
    *batch, height, width = grid.shape
    barred = None if closed is None else closed.reshape(-1, height, width)
    labels, distance, _ = _search(
        grid.reshape(-1, height, width), position.reshape(-1, 2), None, barred
    )
    distance = distance.mul_(labels != 0)

    def cells(padded: Tensor) -> Tensor:
        return padded[1:-1, 1:-1].permute(2, 0, 1).reshape(*batch, height, width)

    return cells(labels), cells(distance).long()


class Trajectories(NamedTuple):
    """The shortest paths of a batch of robots to their frontiers; entries of length 0 are empty."""

    robot: Tensor
    """Row of the batch, int64 [F]."""
    direction: Tensor
    """First move, int64 [F]."""
    length: Tensor
    """Number of moves, float64 [F]."""


def _trajectories(grid: Tensor, position: Tensor, levels: int | None) -> Trajectories:
    """Paths to all reachable frontiers of maps [M, H, W] from positions [M, 2]."""
    labels, distance, frontier = _search(grid, position, levels)
    labels[1:-1, 1:-1] &= frontier
    # frontiers are few, so select them; finding their number takes a host synchronisation
    labels, distance = labels.flatten(), distance.flatten()
    if levels is None:
        cell = labels.nonzero().squeeze(-1)
    else:
        cell = torch.arange(len(labels), device=grid.device)
    found = labels[cell]
    length = distance[cell].double()
    if levels is not None:
        length *= found.clamp_max(1)
    return Trajectories(cell % len(grid), _lowest_bit(grid.device)[found.int()], length)


def _search(
    grid: Tensor, position: Tensor, levels: int | None, closed: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Labels and distances of ``flood`` from each robot, and a byte mask of the frontiers."""
    codes = batch_last(grid + 1, border=OCCUPIED + 1)
    known, passable = codes.clamp_max(1), mask((codes >> 1) ^ 1)  # codes are 0, 1 and 2 here
    free = mask(codes.bitwise_and_(1))
    if closed is not None:
        free &= mask(batch_last(~closed, border=0))
    labels, distance = flood(*_first_moves(position, free, passable), passable, levels)
    return labels, distance, free[1:-1, 1:-1] & _beside_unknown(known)


def _beside_unknown(known: Tensor) -> Tensor:
    """Byte mask [H, W, M] of cells with an unknown 4-neighbour, from known cells [H+2, W+2, M]."""
    beside = known[:-2, 1:-1] & known[2:, 1:-1]
    beside &= known[1:-1, :-2]
    beside &= known[1:-1, 2:]
    return beside.sub_(1)  # all neighbours known: 1 - 1 = 0; else 0 - 1 = 255 in byte arithmetic


class Moments(NamedTuple):
    """Sums over the path lengths of M robots: float64 [M, 8] each, and the longest path [M, 1]."""

    number: Tensor
    total: Tensor
    squares: Tensor
    longest: Tensor


def _moments(found: Trajectories, robots: int) -> Moments:
    """Number, sum and sum of squares of the path lengths of each robot and direction."""
    length = found.length
    powers = torch.stack(((length > 0).double(), length, length * length), -1)
    sums = powers.new_zeros(robots * NUM_DIRECTIONS, 3)
    sums.index_add_(0, found.robot * NUM_DIRECTIONS + found.direction, powers)
    longest = length.new_zeros(robots).scatter_reduce_(0, found.robot, length, "amax")
    number, total, squares = sums.view(robots, NUM_DIRECTIONS, 3).unbind(-1)
    return Moments(number, total, squares, longest.unsqueeze(-1))


def _first_moves(position: Tensor, free: Tensor, passable: Tensor) -> tuple[Tensor, Tensor]:
    """The first front, with each neighbour labelled by its direction's bit, and the free cells."""
    fresh, front = free.clone(), torch.zeros_like(free)
    row_stride, column_stride, _ = free.stride()
    start = flat_cell(position + 1, free.shape[1]) * column_stride
    start = start + torch.arange(len(position), device=free.device)
    fresh.view(-1)[start] = 0
    step_row, step_column = compass(free.device).T.unsqueeze(-1)
    up, side = start + step_row * row_stride, start + step_column * column_stride
    passable = passable.view(-1)
    open_beside = passable[up] | passable[side]
    front.view(-1)[up + step_column * column_stride] = open_beside & _bits(free.device)
    return front, fresh


@lru_cache
def _bits(device: torch.device) -> Tensor:
    """The label of each direction, uint8 [8, 1]."""
    return torch.tensor([[1 << d] for d in range(NUM_DIRECTIONS)], dtype=torch.uint8, device=device)


@lru_cache
def _lowest_bit(device: torch.device) -> Tensor:
    """Index of the lowest set bit of every byte, int64 [256] (0 for 0)."""
    return torch.tensor([(b & -b).bit_length() - 1 if b else 0 for b in range(256)], device=device)


def _normalized(
    moments: Moments, normalize: Normalization | None, height: int, width: int
) -> Tensor:
    """Feature table, float32 [M, 8, 3]."""
    count, total, squares, longest = moments
    some = count.clamp_min(1)
    mean = total / some
    deviation = (count * squares - total * total).sqrt() / some
    if normalize == "absolute":
        count = count / (height * width)
        mean, deviation = mean / (height + width), deviation / (height + width)
    elif normalize is not None:
        count = count / count.sum(-1, keepdim=True).clamp_min(1)
        deviation = deviation / longest.clamp_min(1)
        if normalize == "relative":
            mean = mean / longest.clamp_min(1)
        else:
            nearest = mean.masked_fill(mean == 0, torch.inf).amin(-1, keepdim=True)
            mean = torch.where(mean == 0, 0, nearest / mean)
    return torch.stack((count, mean, deviation), -1).float()

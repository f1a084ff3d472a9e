"""Shortest 8-connected paths for a whole batch of grids at once, by propagating label sets.

A label set is one uint8 per cell, eight labels of one bit each. OR-ing the sets of the neighbours
level by level gives every cell the union of the labels over all its shortest paths. The batch is
the last dimension in memory, so each level is a few vectorised byte operations.
"""

from __future__ import annotations

import torch
from torch import Tensor

ALL = 255
"""A byte mask that passes every label; 0 passes none."""


def batch_last(grids: Tensor, border: int) -> Tensor:
    """Grids [M, H, W] with the batch last and a border, uint8 [H+2, W+2, M]."""
    count, height, width = grids.shape
    shape = (height + 2, width + 2, count)
    padded = torch.full(shape, border, dtype=torch.uint8, device=grids.device)
    padded[1:-1, 1:-1] = grids.permute(1, 2, 0)
    return padded


def mask(bits: Tensor) -> Tensor:
    """Turn 0 and 1 into the byte masks 0 and ALL, in place."""
    return bits.mul_(ALL)


def flood(
    front: Tensor, fresh: Tensor, passable: Tensor, levels: int | None = None
) -> tuple[Tensor, Tensor]:
    """Propagate label sets along shortest 8-connected paths.

    A diagonal step is blocked only where both cells beside it are impassable.

    Args:
        front: uint8 [H+2, W+2, M], the labels at distance 1, zero elsewhere.
        fresh: uint8 [H+2, W+2, M], ALL where a path may go, 0 where it may not and on the border.
        passable: uint8 [H+2, W+2, M], ALL except in cells that block a diagonal.
        levels: maximum path length, reached without checking whether any cells are left (no host
            synchronisation); None: until none are left.

    Returns:
        labels uint8 and distances int32, both [H+2, W+2, M]; distances are valid only where there
        are labels.
    """
    front = front & fresh
    labels = front.clone()
    if not front.numel():
        return labels, torch.zeros_like(front, dtype=torch.int32)
    fresh = fresh & _closed(front)
    # number of levels before each cell was reached: a mask is -1 in byte arithmetic
    waited = torch.zeros_like(fresh).sub_(fresh)
    earlier: Tensor | int = 0
    sideways, upright = torch.zeros_like(front), torch.zeros_like(front)
    level = 1
    while levels is None or level < levels:
        level += 1
        _spread(front, passable, sideways, upright)
        front &= fresh
        if levels is None and level % 2 == 0 and not front.amax():
            break
        labels |= front
        fresh &= _closed(front)
        waited -= fresh
        if level % ALL == 0:  # a byte cannot count further
            earlier = waited.int() + earlier
            waited.zero_()
    return labels, (waited.int() + earlier).add_(1)


def nearest_distance(starts: Tensor, free: Tensor, passable: Tensor) -> Tensor:
    """Lengths of the shortest 8-connected paths from the nearest start, int32 [M, H, W].

    The distance of unreachable cells is the number of cells.

    Args:
        starts: where paths begin, bool [M, H, W].
        free: cells that paths may enter, bool [M, H, W].
        passable: bool [M, H, W]; a diagonal is closed between two cells that are not passable.
    """
    begin, fresh, beside = (mask(batch_last(x, border=0)) for x in (starts, free, passable))
    front, sideways, upright = begin.clone(), torch.zeros_like(begin), torch.zeros_like(begin)
    _spread(front, beside | begin, sideways, upright)  # a start may itself be impassable
    labels, distance = flood(front, fresh & ~begin, beside)
    far = starts.shape[-2] * starts.shape[-1]
    distance = distance.masked_fill_(labels == 0, far).masked_fill_(begin != 0, 0)
    return distance[1:-1, 1:-1].permute(2, 0, 1)


def _closed(front: Tensor) -> Tensor:
    """0 where there is any label, ALL elsewhere (1 - 1 = 0 and 0 - 1 = 255 in byte arithmetic)."""
    return front.clamp_max(1).sub_(1)


def _spread(front: Tensor, passable: Tensor, sideways: Tensor, upright: Tensor) -> None:
    """OR every cell with the labels of its eight neighbours, with the diagonal rule, in place.

    A diagonal is two straight half steps; one of their two orders must avoid impassable cells.
    ``sideways`` and ``upright`` are buffers, zero on the border.
    """
    inner = slice(1, -1)
    torch.bitwise_or(front[:, :-2], front[:, 2:], out=sideways[:, inner])
    sideways |= front
    sideways &= passable
    torch.bitwise_or(front[:-2], front[2:], out=upright[inner])
    upright &= passable
    torch.bitwise_or(sideways[:-2], sideways[2:], out=front[inner])
    front |= sideways
    front[:, inner] |= upright[:, :-2]
    front[:, inner] |= upright[:, 2:]


def path_distances(free: Tensor, target: Tensor, longest: int = ALL) -> Tensor:
    """Lengths of the shortest 8-connected paths from all cells to the targets, uint8 [M, H W, U].

    Args:
        free: cells that paths may use, bool [M, H, W]; a diagonal between two other cells is
            closed.
        target: different cells of each flattened grid, int64 [M, U].
        longest: length of longer paths and of unreachable cells, at most ALL.
    """
    count, height, width = free.shape
    targets = target.shape[1]
    size = -(-targets // 8)
    bits = 1 << torch.arange(8, dtype=torch.uint8, device=free.device)
    # one label per target, eight to a byte, all bytes of all grids side by side
    label = bits.repeat(size)[:targets].expand(count, -1)
    byte = torch.arange(targets, device=free.device) // 8
    own = free.new_zeros(count, height * width * size, dtype=torch.uint8)
    own.scatter_add_(1, target * size + byte, label)
    passable = mask(batch_last(free, border=0)).repeat_interleave(size, -1)
    reached = torch.zeros_like(passable)
    reached[1:-1, 1:-1] = own.view(count, height, width, size).permute(1, 2, 0, 3).flatten(-2)
    reached &= passable
    sideways, upright = torch.zeros_like(reached), torch.zeros_like(reached)
    digits = [torch.zeros_like(reached) for _ in range(longest.bit_length())]
    for level in range(1, longest):
        before = reached.clone()
        _spread(reached, passable, sideways, upright)
        reached &= passable
        new = before.bitwise_xor_(reached)
        if not new.any():
            break
        for place, digit in enumerate(digits):
            if level >> place & 1:
                digit |= new
    for place, digit in enumerate(digits):
        if longest >> place & 1:
            digit |= ~reached
    # distances of the eight labels of each byte
    distance = free.new_zeros(height, width, count, size, 8, dtype=torch.uint8)
    for place, digit in enumerate(digits):
        inner = digit[1:-1, 1:-1].reshape(height, width, count, size, 1)
        distance |= (inner & bits).clamp_max_(1) << place
    distance = distance.flatten(-2)[..., :targets].permute(2, 0, 1, 3)
    return distance.reshape(count, height * width, targets)

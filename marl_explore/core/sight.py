"""Sight: which cells around a place belong to a sensor's shape, and which of them walls hide.

Windows are squares of side 2k + 1 around a robot, row 0 north; offsets are (row, column).
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from marl_explore.config.shapes import Sight, half_widths, rings
from marl_explore.core.grid import FREE, OCCUPIED, UNKNOWN, square_steps
from marl_explore.core.native import Backend
from marl_explore.core.native import sight as kernel
from marl_explore.core.native.choice import in_use

CELLS_AT_ONCE = 4_000_000
"""Cells of windows that are looked at together, which bounds the memory that it takes."""


def shape_mask(shape: str, range_cells: float, radius: int, device: torch.device) -> Tensor:
    """Cells of a sensor's shape in a window of the same or a larger radius, bool [2k+1, 2k+1]."""
    return _mask(half_widths(shape, range_cells), radius, device)


@lru_cache
def _mask(reach: tuple[int, ...], radius: int, device: torch.device) -> Tensor:
    steps = [abs(step) for step in range(-radius, radius + 1)]
    widths = [reach[row] if row < len(reach) else -1 for row in steps]
    inside = [[column <= width for column in steps] for width in widths]
    return torch.tensor(inside, device=device)


def shapes(sight: Sight, device: torch.device) -> Tensor:
    """The cells of every robot's shape in the window of the team, bool [N or 1, 2k+1, 2k+1]."""
    reaches = tuple(half_widths(sight.shape, reach) for reach in sight.ranges_cells)
    return _masks(reaches, sight.radius, device)


@lru_cache
def _masks(reaches: tuple[tuple[int, ...], ...], radius: int, device: torch.device) -> Tensor:
    return torch.stack([_mask(reach, radius, device) for reach in reaches])


class _Ring(NamedTuple):
    """``config.shapes.Ring`` as tensors."""

    cell: Tensor
    """int64 [C]."""
    parent: Tensor
    """int64 [C, 2]."""
    side: Tensor
    """int64 [C, 2, 2]."""


@lru_cache
def _rings(radius: int, device: torch.device) -> list[_Ring]:
    return [
        _Ring(*(torch.tensor(entry, device=device) for entry in ring)) for ring in rings(radius)
    ]


def line_of_sight(wall: Tensor, backend: Backend = "auto") -> Tensor:
    """Cells of windows that are seen from the centre, bool [*B, 2k + 1, 2k + 1].

    From the inside out, a cell is seen if one of the one or two cells through which the straight
    line to it passes just before is seen and is no obstacle, and the step from there does not pass
    between two obstacles. So obstacles are seen, and what lies behind them is not.

    Args:
        wall: obstacles of each window, bool [*B, 2k + 1, 2k + 1]; no obstacle outside an arena.
        backend: "torch", "native" (C, CPU tensors only), or "auto" (native where possible). The
            results are equal.

    Raises:
        ValueError: for an unknown backend, and by the native one for another dtype or shape.
        RuntimeError: when the native backend is requested and cannot be used.
    """
    if in_use("sight", backend, wall.device):
        return kernel.line_of_sight(wall)
    side = wall.shape[-1]
    wall = wall.flatten(-2)
    seen = torch.zeros_like(wall)
    seen[..., side * side // 2] = True
    for ring in _rings(side // 2, wall.device):
        parent = ring.parent.flatten()
        passes = seen.index_select(-1, parent) & ~wall.index_select(-1, parent)
        beside = wall.index_select(-1, ring.side.flatten()).unflatten(-1, (-1, 2))
        passes &= ~(beside[..., 0] & beside[..., 1])
        seen[..., ring.cell] = passes.unflatten(-1, (-1, 2)).any(-1)
    return seen.unflatten(-1, (side, side))


def expected_discoveries(
    grid: Tensor,
    which: Tensor,
    cell: Tensor,
    kind: Tensor,
    sight: Sight,
    backend: Backend = "auto",
) -> Tensor:
    """Unknown cells that robots would see from cells of their maps (WORLD.md, Sight), int64 [Q].

    Cells of a robot's own shape inside the map; if obstacles end sight, those of them that would be
    seen if all unknown cells were free.

    Args:
        grid: maps, int8 [M, H, W].
        which: the map of each query, int64 [Q].
        cell: the cell to look from, row * W + column, int64 [Q].
        kind: the robot that looks, int64 [Q]; 0 if ``sight`` has one entry for all.
        sight: of the robots; k is its radius.
        backend: as for ``line_of_sight``.

    Raises:
        ValueError: for an unknown backend; by the native one for entries of another dtype or shape,
            a cell outside its map, and a map or robot that there is not.
        RuntimeError: when the native backend is requested and cannot be used.
    """
    masks = shapes(sight, grid.device)
    if in_use("discoveries", backend, grid.device):
        return kernel.expected_discoveries(grid, which, cell, kind, masks, sight.line_of_sight)
    radius, side = sight.radius, sight.side
    height, width = grid.shape[-2] + 2 * radius, grid.shape[-1] + 2 * radius
    bordered = torch.nn.functional.pad(grid, (radius,) * 4, value=FREE)
    row, column = cell // grid.shape[-1] + radius, cell % grid.shape[-1] + radius
    own = (which * height + row) * width + column
    steps = square_steps(radius, width, grid.device)
    size = max(1, CELLS_AT_ONCE // side**2)
    found = []
    for centre, robot in zip(own.split(size), kind.split(size), strict=True):
        window = bordered.take(centre.unsqueeze(-1) + steps).view(-1, side, side)
        expected = (window == UNKNOWN) & masks.index_select(0, robot)
        if sight.line_of_sight:
            expected &= line_of_sight(window == OCCUPIED, "torch")
        found.append(expected.sum((-2, -1)))
    return torch.cat(found)

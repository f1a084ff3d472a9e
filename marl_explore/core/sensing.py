"""Sensing: only this module knows the shape and range of the sensors.

It computes what is around each robot, what that writes into its map, and what it could expect to
see from other cells.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from marl_explore.config.shapes import Sight
from marl_explore.core.grid import (
    COMPASS,
    UNKNOWN,
    flat_cell,
    square_steps,
    straight_distances,
)
from marl_explore.core.native import Backend
from marl_explore.core.native import sensing as kernel
from marl_explore.core.native.choice import in_use
from marl_explore.core.sight import line_of_sight, shapes

OPEN, WALL, ROBOT, UNSEEN = 0, 1, 2, 4
"""Contents of a cell around a robot (int8, one bit each); UNSEEN is outside or hidden."""


def bordered(obstacles: Tensor, radius: int) -> Tensor:
    """Obstacles bool [*B, H, W] as WALL bits with a border of UNSEEN, int8 [*B, H + 2k, W + 2k]."""
    return torch.nn.functional.pad(obstacles.to(torch.int8), (radius,) * 4, value=UNSEEN)


def surroundings(
    walls: Tensor,
    position: Tensor,
    sight: Sight,
    walkers: Tensor | None = None,
    backend: Backend = "auto",
) -> Tensor:
    """Contents of the window around each robot; the own cell is OPEN.

    Args:
        walls: ``bordered`` obstacles, int8 [*B, H + 2k, W + 2k].
        position: int64 [*B, N, 2].
        sight: of the robots; k is its radius.
        walkers: cells of people, int64 [*B, W, 2]; they look like robots.
        backend: as for ``sight.line_of_sight``.

    Returns:
        int8 [*B, N, 2k + 1, 2k + 1], row 0 north; what a robot cannot see is UNSEEN.
    """
    radius, side, stride = sight.radius, sight.side, walls.shape[-1]
    corner = radius * (stride + 1)
    own = flat_cell(position, stride) + corner
    people = own[..., :0] if walkers is None else flat_cell(walkers, stride) + corner
    masks = shapes(sight, walls.device)
    if in_use("surroundings", backend, walls.device):
        return kernel.surroundings(walls, own, people, masks, sight.line_of_sight)
    occupied = walls.flatten(-2).scatter(-1, own, ROBOT).scatter_(-1, people, ROBOT)
    index = own.unsqueeze(-1) + square_steps(radius, stride, walls.device)
    view = occupied.gather(-1, index.flatten(-2)).view(*own.shape, side, side)
    view[..., radius, radius].fill_(OPEN)
    if sight.line_of_sight:
        masks = masks & line_of_sight(view == WALL, backend)
    return view.masked_fill_(~masks, UNSEEN)


def blinded(view: Tensor, alive: Tensor | None) -> Tensor:
    """``surroundings`` of which robots that failed see nothing but their own cell.

    Args:
        view: int8 [*B, N, 2k + 1, 2k + 1].
        alive: bool [*B, N]; None: all.
    """
    if alive is None:
        return view
    radius = view.shape[-1] // 2
    view = view.masked_fill(~alive[..., None, None], UNSEEN)
    view[..., radius, radius].fill_(OPEN)
    return view


def beside(view: Tensor) -> Tensor:
    """The targets of the eight moves, and the own cell, [*B, N, 9], from ``surroundings``."""
    return view.flatten(-2).index_select(-1, _places(view.shape[-1] // 2, view.device))


@lru_cache
def _places(radius: int, device: torch.device) -> Tensor:
    """Targets of the eight moves and of staying in a flattened square, int64 [9]."""
    side = 2 * radius + 1
    cells = [(radius + r) * side + radius + c for r, c in (*COMPASS, (0, 0))]
    return torch.tensor(cells, device=device)


@lru_cache
def cells_seen_from(height: int, width: int, radius: int, device: torch.device) -> Tensor:
    """Cells of the square around each cell of a flattened grid, int64 [H W, (2k + 1)^2].

    Cells outside the grid are replaced by the centre cell.
    """
    cell = torch.arange(height * width, device=device).unsqueeze(-1)
    steps = torch.arange(-radius, radius + 1, device=device)
    row = cell // width + steps.repeat_interleave(len(steps))
    column = cell % width + steps.repeat(len(steps))
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    return torch.where(inside, row * width + column, cell)


def field_of_view(view: Tensor) -> Tensor:
    """Each robot's field of view: obstacles, other robots and unseen cells are 1.

    Args:
        view: ``sensing.surroundings``, int8 [*B, N, 2k + 1, 2k + 1].

    Returns:
        float32 of the same shape; the own cell is 0.
    """
    return view.clamp_max(1).float()


class Sensed(NamedTuple):
    """Maps after sensing, and the cells that were new to each."""

    map: Tensor
    """int8 [*B, N, H, W], a new tensor."""
    discovered: Tensor
    """Number of new cells, int64 [*B, N]."""
    targets: Tensor
    """Number of target cells among them, int64 [*B, N]."""


def sense(
    grid: Tensor,
    view: Tensor,
    position: Tensor,
    target: Tensor,
    alive: Tensor | None = None,
    backend: Backend = "auto",
) -> Sensed:
    """Maps after each robot has sensed the cells around it.

    Args:
        grid: maps in which the robots' own cells are known, int8 [*B, N, H, W].
        view: ``sensing.surroundings``, int8 [*B, N, 2k + 1, 2k + 1].
        position: int64 [*B, N, 2].
        target: cells that are counted apart, bool [*B, H, W].
        alive: bool [*B, N]; maps of robots that failed stay as they are. None: all robots live.
        backend: as for ``sight.line_of_sight``.
    """
    if alive is None:
        alive = torch.ones(position.shape[:-1], dtype=torch.bool, device=grid.device)
    if in_use("sense", backend, grid.device):
        return Sensed(*kernel.sense(grid, view, position, alive, target))
    # cells that are not seen are replaced by the own cell, whose value stays
    height, width = grid.shape[-2:]
    own = flat_cell(position, width)
    cells = cells_seen_from(height, width, view.shape[-1] // 2, view.device)
    view = view.flatten(-2)
    unseen = (view == UNSEEN) | ~alive.unsqueeze(-1)
    cell = cells.index_select(0, own.flatten()).view(view.shape)
    cell = torch.where(unseen, own.unsqueeze(-1), cell)
    known = grid.flatten(-2)
    fresh = (known.gather(-1, cell) == UNKNOWN) & ~unseen
    value = torch.where(unseen, known.gather(-1, own.unsqueeze(-1)), view & WALL)
    chosen = target.flatten(-2).gather(-1, cell.flatten(-2)).view(cell.shape)
    return Sensed(
        known.scatter(-1, cell, value).view(grid.shape),
        fresh.sum(-1),
        (fresh & chosen).sum(-1),
    )


def unknown_around(grid: Tensor, radius: int) -> Tensor:
    """Unknown cells in the square around each cell, float32 [*B, H, W], of maps [*B, H, W]."""
    unknown = (grid == UNKNOWN).float().reshape(-1, 1, *grid.shape[-2:])
    side = 2 * radius + 1
    mean = torch.nn.functional.avg_pool2d(unknown, side, stride=1, padding=radius)
    return (mean * side**2).round().view(grid.shape)


def in_view(position: Tensor, height: int, width: int, radius: int) -> Tensor:
    """Cells of the square around positions int64 [*B, 2], bool [*B, H, W]."""
    return straight_distances(position, height, width) <= radius

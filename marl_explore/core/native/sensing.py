"""The native kernels for sensing as torch operators on whole batches."""

from __future__ import annotations

import torch
from torch import Tensor

from marl_explore.core import native
from marl_explore.core.native.sight import windows_per_thread
from marl_explore.core.native.threads import share_rows

_LOOK, _SENSE = "marl_explore::surroundings", "marl_explore::sense"
torch.library.define(
    _LOOK, "(Tensor walls, Tensor own, Tensor people, Tensor masks, bool hides) -> Tensor"
)
torch.library.define(
    _SENSE,
    "(Tensor grid, Tensor view, Tensor position, Tensor alive, Tensor target)"
    " -> (Tensor, Tensor, Tensor)",
)


@torch.library.impl(_LOOK, "cpu")
def _surroundings(walls: Tensor, own: Tensor, people: Tensor, masks: Tensor, hides: bool) -> Tensor:
    walls, own, people, masks = (x.contiguous() for x in (walls, own, people, masks))
    side, (height, width) = masks.shape[-1], walls.shape[-2:]
    view = walls.new_empty(*own.shape, side, side)
    addresses = (x.data_ptr() for x in (walls, own, people, masks, view))
    sizes = own.shape[-1], people.shape[-1], height * width, width, len(masks), side, hides
    looks = native.Looks(*addresses, *sizes)
    function = native.kernel("surroundings")

    def run(first: int, last: int) -> int:
        return function(looks, first, last)  # ctypes releases the GIL

    native.check(share_rows(run, own.numel(), windows_per_thread(side)), height, width)
    return view


@torch.library.impl(_SENSE, "cpu")
def _sense(
    grid: Tensor, view: Tensor, position: Tensor, alive: Tensor, target: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    team, height, width = grid.shape[-3:]
    maps = grid.clone(memory_format=torch.contiguous_format)
    arrays = [x.contiguous() for x in (view, position, alive, target)]
    found = position.new_empty(2, *position.shape[:-1])
    addresses = (x.data_ptr() for x in (*arrays, maps, found[0], found[1]))
    side = view.shape[-1]
    readings = native.Readings(*addresses, team, height, width, side)
    function = native.kernel("sense")

    def run(first: int, last: int) -> int:
        return function(readings, first, last)

    robots = position.shape[:-1].numel()
    native.check(share_rows(run, robots, windows_per_thread(side)), height, width)
    return maps, found[0], found[1]


@torch.library.register_fake(_LOOK)
def _(walls: Tensor, own: Tensor, people: Tensor, masks: Tensor, hides: bool) -> Tensor:
    return walls.new_empty(*own.shape, *masks.shape[-2:])


@torch.library.register_fake(_SENSE)
def _(
    grid: Tensor, view: Tensor, position: Tensor, *others: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    counts = position.new_empty(2, *position.shape[:-1])
    return torch.empty_like(grid), counts[0], counts[1]


def surroundings(walls: Tensor, own: Tensor, people: Tensor, masks: Tensor, hides: bool) -> Tensor:
    """What is around robots, int8 [*B, N, 2k + 1, 2k + 1], as ``core.sensing.surroundings``.

    Args:
        walls: obstacles with a border of k cells, int8 [*B, H + 2k, W + 2k].
        own: each robot's cell in it, int64 [*B, N].
        people: those of people, int64 [*B, W].
        masks: the shapes of sensors, bool [N or 1, 2k + 1, 2k + 1].
        hides: whether obstacles end sight.
    """
    return torch.ops.marl_explore.surroundings.default(walls, own, people, masks, hides)


def sense(
    grid: Tensor, view: Tensor, position: Tensor, alive: Tensor, target: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Maps after robots have sensed, and how many cells and targets were new to each.

    Args:
        grid: maps, int8 [*B, N, H, W].
        view: ``surroundings``, int8 [*B, N, 2k + 1, 2k + 1].
        position: int64 [*B, N, 2].
        alive: robots that sense, bool [*B, N].
        target: bool [*B, H, W].
    """
    return torch.ops.marl_explore.sense.default(grid, view, position, alive, target)

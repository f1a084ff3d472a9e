"""The native kernel for a whole step of the world, for arenas without hindrances."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from marl_explore.config.constants import NEVER, NUM_ACTIONS
from marl_explore.core import native
from marl_explore.core.native.threads import share_rows

CELLS_PER_THREAD = 2**19
"""Steps of arenas of fewer cells in all are done before another thread has started."""


class Stepped(NamedTuple):
    """After a step: entries of ``world.WorldState`` and ``rewards.StepRecord``."""

    position: Tensor
    dangerous: Tensor
    view: Tensor
    linked: Tensor
    network: Tensor
    pending: Tensor
    """``StepRecord.unshared``."""
    unshared: Tensor
    steps_since_merge: Tensor
    action_mask: Tensor
    discovered: Tensor
    received: Tensor
    known: Tensor
    missing: Tensor
    map: Tensor


def step(
    walls: Tensor,
    masks: Tensor,
    target: Tensor,
    action: Tensor,
    position: Tensor,
    action_mask: Tensor,
    unshared: Tensor,
    steps_since_merge: Tensor,
    known: Tensor,
    missing: Tensor,
    grid: Tensor,
    reach: int,
    hides: bool,
) -> Stepped:
    """``world.advance`` in C, equal in every entry, for batches of arenas on the CPU.

    All robots live, move when they want to, and hear each other within one range without losses;
    nobody walks about. Entries are those of ``WorldState`` before the step.

    Args:
        walls: int8 [*B, H + 2k, W + 2k].
        masks: the shapes of sensors, bool [N or 1, 2k + 1, 2k + 1], k > 0.
        target: bool [*B, H, W].
        action: int64 [*B, N].
        position: int64 [*B, N, 2].
        action_mask: bool [*B, N, 10].
        unshared: int64 [*B, N, N].
        steps_since_merge: int64 [*B, N, N].
        known: int64 [*B, N].
        missing: int64 [*B, N].
        grid: maps, int8 [*B, N, H, W].
        reach: largest squared distance of linked robots (cells).
        hides: whether obstacles end sight.

    Raises:
        ValueError: for an action that is none, or actions of another dtype or device.
    """
    if action.dtype != torch.int64 or action.device.type != "cpu":
        raise ValueError(f"action must be int64 on the CPU, got {action.dtype} on {action.device}")
    inputs = walls, masks, target, action, position, action_mask
    before = unshared, steps_since_merge, known, missing
    arrays = [x.contiguous() for x in (*inputs, *before)]
    maps = grid.clone(memory_format=torch.contiguous_format)
    team, height, width = grid.shape[-3:]
    side, robots, pairs = masks.shape[-1], action.shape, unshared.shape
    new = Stepped(
        position=torch.empty_like(arrays[4]),
        dangerous=action_mask.new_empty(robots),
        view=walls.new_empty(*robots, side, side),
        linked=action_mask.new_empty(pairs),
        network=action_mask.new_zeros(pairs),
        pending=action.new_empty(pairs),
        unshared=action.new_empty(pairs),
        steps_since_merge=action.new_empty(pairs),
        action_mask=action_mask.new_empty(*robots, NUM_ACTIONS),
        discovered=action.new_empty(robots),
        received=action.new_zeros(robots),
        known=action.new_empty(robots),
        missing=action.new_empty(robots),
        map=maps,
    )
    work = action.new_zeros(3, *robots)
    communicating = action_mask.new_empty(robots)
    addresses = [x.data_ptr() for x in (*arrays, maps, *new[:-1], *work, communicating)]
    sizes = team, height, width, len(masks), side, hides, reach, NEVER
    turn = native.Step(*addresses, *sizes)
    function = native.kernel("step")

    def run(first: int, last: int) -> int:
        return function(turn, first, last)  # ctypes releases the GIL

    arenas = robots[:-1].numel()
    per_thread = max(1, CELLS_PER_THREAD // (team * (height * width + side**2)))
    native.check(share_rows(run, arenas, per_thread), height, width)
    return new

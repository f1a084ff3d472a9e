"""The native kernel for joint plans."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from marl_explore.core import native
from marl_explore.core.native.threads import share_rows

_PER_THREAD = 64
"""Turns in fewer problems finish before another thread has started."""


class Search:
    """The turns of a search for joint plans (``planners.beam``), on the CPU.

    Turns write into two sets of arrays by turns, once there are as many plans as are kept.

    Args:
        plans: cell, before, first, unknown, code and seen of ``planners.beam.Plans``.
        problem: the arrays of ``BeamTurn`` from "occupied" to "hashes", in its order.
        width: how many plans are kept.

    Raises:
        RuntimeError: when the kernel cannot be used.
    """

    def __init__(
        self, plans: tuple[Tensor, ...], problem: tuple[Tensor | None, ...], width: int
    ) -> None:
        self.plans = [entry.clone(memory_format=torch.contiguous_format) for entry in plans]
        self._problem = [None if entry is None else entry.contiguous() for entry in problem]
        self._width = width
        self._values, self._keep = native.kernel("beam values"), native.kernel("beam plans")
        self._spare: _Slot | None = None
        self._slot: _Slot | None = None

    def begin_step(self) -> None:
        """The robots' cells are those before the step."""
        cell, before, *_ = self.plans
        before.copy_(cell)

    def take_turn(
        self, robot: int, is_first: bool, weight: float, of_distance: float, favour: float
    ) -> None:
        """The plans after a robot's turn.

        Args:
            robot: whose turn it is.
            is_first: whether its move is the first one of the plan.
            weight: of cells that are seen now.
            of_distance: of distances now.
            favour: ``planners.beam``'s bonus of moving.
        """
        slot = self._spare
        if slot is None or slot.before is not self.plans:
            last = None if self._slot is None else self._slot.before
            slot = _Slot(self.plans, self._problem, self._width, last)
        turn, problems = slot.turn, len(slot.value)
        turn.robot, turn.is_first = robot, is_first
        turn.weight, turn.of_distance, turn.favour = weight, of_distance, favour
        turn.of_order = favour / slot.value.shape[1]
        failed = share_rows(partial(self._values, turn), problems, _PER_THREAD)
        native.check(failed, 1, turn.cells)
        torch.topk(slot.value, turn.kept, out=(slot.best_value, slot.best))
        share_rows(partial(self._keep, turn), problems, _PER_THREAD)
        self.plans, self._slot, self._spare = slot.after, slot, self._slot


class _Slot:
    """The arrays of a turn from some plans to others, and their addresses."""

    def __init__(
        self,
        plans: list[Tensor],
        problem: list[Tensor | None],
        width: int,
        into: list[Tensor] | None,
    ) -> None:
        cell, before, first, unknown, code, seen = self.before = plans
        problems, number, robots = cell.shape
        moves = number * _MOVES
        kept = min(width, moves)
        self.value, self._seen = seen.new_empty(2, problems, moves).unbind()
        self._code = code.new_empty(problems, moves)
        self.best_value, self.best = (x.new_empty(problems, kept) for x in (seen, code))
        if into is None or into[0].shape[1] != kept or number != kept:
            into = [entry.new_empty(problems, kept, *entry.shape[2:]) for entry in plans]
        self.after = into
        arrays = (
            *(cell, before, unknown, code, seen),
            *problem,
            *(self.value, self._seen, self._code, first, self.best, self.best_value),
            *into,
        )
        addresses = (None if array is None else array.data_ptr() for array in arrays)
        target, window = problem[1], problem[7]
        assert target is not None
        assert window is not None
        sizes = (number, robots, unknown.shape[-1], target.shape[-1], window.shape[-1], 0, kept)
        self.turn = native.BeamTurn(*addresses, *sizes)


_MOVES = 9

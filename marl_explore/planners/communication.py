"""Communication rules of planners: from observations to a bool per robot [*B, N]."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from marl_explore.core.links import linked_others

CommunicationRule = Callable[[TensorDictBase], Tensor]
"""From the entries of an environment to who communicates: bool [*B, N]."""


def never(tensordict: TensorDictBase) -> Tensor:
    """No robot ever communicates."""
    return torch.zeros_like(tensordict.get(("agents", "merged")))


def others_linked(tensordict: TensorDictBase) -> Tensor:
    """Linked pairs of different robots, bool [*B, N, N]."""
    return linked_others(tensordict.get(("agents", "linked")))


@dataclass(frozen=True)
class PairTimer:
    """Communicate if the last merge with some linked robot was at least ``steps`` ago, or never.

    The rule is symmetric: both robots of a pair decide alike without a message.
    """

    steps: int

    def __call__(self, tensordict: TensorDictBase) -> Tensor:
        """Who communicates, bool [*B, N]."""
        overdue = tensordict.get(("agents", "steps_since_merge")) >= self.steps
        return (overdue & others_linked(tensordict)).any(-1)


@dataclass(frozen=True)
class SharedClock:
    """All robots that are linked to another one communicate at set times of a shared clock.

    Args:
        start: first of the regular times (steps).
        period: steps between regular times.
        early: additional earlier times (steps).
    """

    start: int
    period: int
    early: tuple[int, ...] = ()

    def __call__(self, tensordict: TensorDictBase) -> Tensor:
        """Who communicates, bool [*B, N]."""
        now = tensordict.get("step_count")
        due = (now >= self.start) & ((now - self.start) % self.period == 0)
        for time in self.early:
            due = due | (now == time)
        return due & others_linked(tensordict).any(-1)


@dataclass(frozen=True)
class GainThreshold:
    """Communicate if some linked robot lacks at least this many of the robot's own discoveries.

    A robot knows only its own unshared cells, so its partner may not communicate at the same time.
    """

    cells: int

    def __call__(self, tensordict: TensorDictBase) -> Tensor:
        """Who communicates, bool [*B, N]."""
        much = tensordict.get(("agents", "unshared")) >= self.cells
        return (much & others_linked(tensordict)).any(-1)

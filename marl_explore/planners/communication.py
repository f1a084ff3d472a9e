"""When a planner communicates: rules from observations to a bool per robot [*B, N]."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from marl_explore.core.radio import in_range

CommunicationRule = Callable[[TensorDictBase], Tensor]


def never(tensordict: TensorDictBase) -> Tensor:
    """No robot ever communicates."""
    return torch.zeros_like(tensordict.get(("agents", "merged")))


@dataclass(frozen=True)
class PairTimer:
    """Communicate beside a robot in range last merged with ``steps`` ago or more, or never.

    The rule is symmetric: both robots of a pair come to it without a message.
    """

    steps: int
    range_cells: float

    def __call__(self, tensordict: TensorDictBase) -> Tensor:
        """Who communicates, bool [*B, N]."""
        # a robot's counter with itself stays 0, so it never counts as its own partner
        overdue = tensordict.get(("agents", "steps_since_merge")) >= self.steps
        reach = in_range(tensordict.get(("agents", "position")), self.range_cells)
        return (overdue & reach).any(-1)

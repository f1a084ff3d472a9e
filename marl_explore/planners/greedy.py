"""Greedy planner on the feature table: the direction in which frontiers are nearest on average."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from marl_explore.core.grid import STAY
from marl_explore.planners.base import Planner
from marl_explore.transforms import FrontierReachability


class FPRGreedy(Planner):
    """Every robot moves in the direction with the smallest mean length in its frontier table."""

    sees = "its frontier table (FPR), positions of robots in range"

    def plan(self, tensordict: TensorDictBase) -> Tensor:
        """Direction of the nearest frontiers, or STAY where there are none, int64 [*B, N]."""
        agents = tensordict.get("agents")
        table = FrontierReachability(normalize=None).compute(
            agents.get("map"), agents.get("position")
        )
        number, length, _ = table.unbind(-1)
        direction = length.masked_fill(number == 0, torch.inf).argmin(-1)
        return torch.where((number > 0).any(-1), direction, STAY)

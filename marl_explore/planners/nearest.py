"""Nearest-frontier exploration (Yamauchi 1997)."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from marl_explore.core.frontier import nearest_frontier
from marl_explore.core.grid import STAY
from marl_explore.planners.base import Planner


class NearestFrontier(Planner):
    """Every robot walks to the nearest frontier of its own map, or stays if there is none."""

    def plan(self, tensordict: TensorDictBase) -> Tensor:
        """First move to the nearest frontier, int64 [*B, N]."""
        agents = tensordict.get("agents")
        direction, distance = nearest_frontier(agents.get("map"), agents.get("position"))
        return torch.where(distance > 0, direction, STAY)

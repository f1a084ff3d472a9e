"""Classical policies behind the interface of an actor: TensorDict in, action out, batched."""

from __future__ import annotations

from collections.abc import Callable

from tensordict.nn import TensorDictModuleBase

from marl_explore.config import ArenaConfig
from marl_explore.planners.communication import PairTimer, never
from marl_explore.planners.nearest import NearestFrontier
from marl_explore.planners.random import RandomWalk

PAIR_TIMER_STEPS = 6

PLANNERS: dict[str, Callable[[ArenaConfig], TensorDictModuleBase]] = {
    "random": lambda config: RandomWalk(),
    "nearest": lambda config: NearestFrontier(never),
    "nearest-timer": lambda config: NearestFrontier(
        PairTimer(PAIR_TIMER_STEPS, config.communication_cells)
    ),
}
"""Planners by name, each made for a configuration."""

__all__ = ["PLANNERS", "NearestFrontier", "PairTimer", "RandomWalk", "never"]

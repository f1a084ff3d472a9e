"""Classical planners with the interface of an actor: TensorDict in, action out, batched.

Their parameters were tuned on arenas of the stream "validation" (docs/planners.md).
"""

from __future__ import annotations

from collections.abc import Callable

from tensordict.nn import TensorDictModuleBase

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.constants import EXCHANGE_TIMER
from marl_explore.config.goals import GoalWeights as GoalWeights
from marl_explore.planners.assignment import FrontierAssignment, UtilityCost, hungarian
from marl_explore.planners.base import Planner
from marl_explore.planners.beam import BeamSearch
from marl_explore.planners.communication import GainThreshold, PairTimer, SharedClock, never
from marl_explore.planners.goal_utility import GoalUtility
from marl_explore.planners.greedy import FPRGreedy
from marl_explore.planners.hedac import HEDAC
from marl_explore.planners.nearest import NearestFrontier
from marl_explore.planners.random import RandomWalk
from marl_explore.planners.references import Central, Clairvoyant, counting_bound
from marl_explore.planners.rendezvous import Rendezvous

PLANNERS: dict[str, Callable[[ArenaConfig], TensorDictModuleBase]] = {
    "random": lambda config: RandomWalk(),
    "nearest": lambda config: NearestFrontier(never, config),
    "nearest-timer": lambda config: NearestFrontier(PairTimer(EXCHANGE_TIMER), config),
    "fpr-greedy": lambda config: FPRGreedy(PairTimer(5), config),
    "utility-cost": lambda config: FrontierAssignment(
        PairTimer(EXCHANGE_TIMER), UtilityCost(), config
    ),
    "sequential": lambda config: FrontierAssignment(
        PairTimer(5), UtilityCost(by_number=True), config
    ),
    "hungarian": lambda config: FrontierAssignment(PairTimer(5), hungarian, config),
    "hedac": lambda config: HEDAC(PairTimer(5), config),
    "rendezvous": lambda config: Rendezvous(config, SharedClock(14, 3, early=(8,)), memory_steps=3),
    "goal-utility": lambda config: GoalUtility(config.sight, config=config),
    "central": Central,
    "clairvoyant": Clairvoyant,
}
"""Constructors of planners by name, from a configuration; the last two are references."""

__all__ = [
    "HEDAC",
    "PLANNERS",
    "BeamSearch",
    "Central",
    "Clairvoyant",
    "FPRGreedy",
    "FrontierAssignment",
    "GainThreshold",
    "GoalUtility",
    "GoalWeights",
    "NearestFrontier",
    "PairTimer",
    "Planner",
    "RandomWalk",
    "Rendezvous",
    "SharedClock",
    "UtilityCost",
    "counting_bound",
    "hungarian",
    "never",
]

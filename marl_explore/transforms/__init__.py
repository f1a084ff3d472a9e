"""Features of maps and positions as TorchRL transforms: on an env, in a replay buffer, or alone."""

from marl_explore.transforms.frontier import FrontierReachability
from marl_explore.transforms.goals import GoalCandidates
from marl_explore.transforms.memory import RememberTeam
from marl_explore.transforms.neighbors import CommunicationNeighbors
from marl_explore.transforms.surroundings import Clock, LocalMap, StepGain
from marl_explore.transforms.team import FrontierTerritory, Teammates

__all__ = [
    "Clock",
    "CommunicationNeighbors",
    "FrontierReachability",
    "FrontierTerritory",
    "GoalCandidates",
    "LocalMap",
    "RememberTeam",
    "StepGain",
    "Teammates",
]

"""Features of maps and positions as TorchRL transforms: on an env, in a replay buffer, alone."""

from marl_explore.transforms.frontier import FrontierReachability
from marl_explore.transforms.neighbors import CommunicationNeighbors

__all__ = ["CommunicationNeighbors", "FrontierReachability"]

"""Multi-robot exploration with reinforcement learning, on TorchRL.

The public names are imported when they are first used, so that parts without torch stay light.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from marl_explore.arenas import list_suites
    from marl_explore.config import ArenaConfig
    from marl_explore.env import ExplorationEnv
    from marl_explore.happo import HAPPOLoss
    from marl_explore.make import make_env
    from marl_explore.native import backend
    from marl_explore.policies import list_policies, load_policy
    from marl_explore.transforms import CommunicationNeighbors, FrontierReachability

_HOMES = {
    "ArenaConfig": "config",
    "CommunicationNeighbors": "transforms",
    "ExplorationEnv": "env",
    "FrontierReachability": "transforms",
    "HAPPOLoss": "happo",
    "backend": "native",
    "list_policies": "policies",
    "list_suites": "arenas",
    "load_policy": "policies",
    "make_env": "make",
}

__all__ = [
    "ArenaConfig",
    "CommunicationNeighbors",
    "ExplorationEnv",
    "FrontierReachability",
    "HAPPOLoss",
    "backend",
    "list_policies",
    "list_suites",
    "load_policy",
    "make_env",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return version("marl-explore")
    if name in _HOMES:
        return getattr(import_module(f"marl_explore.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'marl_explore' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]

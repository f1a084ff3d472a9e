"""Everything that acts, by name: planners, bundled policies, policy files and run folders."""

from __future__ import annotations

from marl_explore.config.arena import ArenaConfig
from marl_explore.evaluation.episodes import Actor
from marl_explore.planners import PLANNERS
from marl_explore.policies.argmax import ArgmaxPolicy
from marl_explore.policies.io import load_policy, policy_info

ARGMAX = ":argmax"


def find_policy(name: str, config: ArenaConfig) -> Actor:
    """A planner's name, or what ``load_policy`` takes, ready to act on arenas of ``config``.

    Policies draw their actions; with ":argmax" after its name one takes the likeliest
    (``ArgmaxPolicy``).

    Raises:
        ValueError: naming what there is, for an unknown name.
    """
    if name in PLANNERS:
        return PLANNERS[name](config)
    likeliest = name.endswith(ARGMAX)
    try:
        policy = load_policy(name.removesuffix(ARGMAX))
    except ValueError as error:
        raise ValueError(f"{error}; planners: {sorted(PLANNERS)}") from error
    policy.check(config.num_agents, config.fov_size)
    return ArgmaxPolicy(policy) if likeliest else policy


def training_arenas(name: str) -> tuple[ArenaConfig, str]:
    """The arena and the kind of arenas (such as a suite's name) a policy was trained on.

    Raises:
        ValueError: saying why, for what is no policy, such as a planner's name.
    """
    name = name.removesuffix(ARGMAX)
    arena = load_policy(name).config.arena
    return arena, policy_info(name).get("config", {}).get("arenas", "uniform")


def trained_on(name: str) -> tuple[ArenaConfig, str] | None:
    """The ``training_arenas`` of a policy; None for what is none."""
    try:
        return training_arenas(name)
    except ValueError:
        return None

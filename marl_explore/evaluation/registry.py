"""Policies by name: planners, bundled policies, policy files, run folders, and those of others."""

from __future__ import annotations

import math

from marl_explore.config.arena import ArenaConfig
from marl_explore.evaluation import outside
from marl_explore.evaluation.episodes import Actor
from marl_explore.planners import PLANNERS
from marl_explore.policies.argmax import ArgmaxPolicy
from marl_explore.policies.io import load_policy, policy_info
from marl_explore.policies.policy import Policy

ARGMAX = ":argmax"


def find_policy(name: str, config: ArenaConfig) -> Actor:
    """The policy with a planner's name, or from ``load_policy``, ready to act in ``config``.

    "package.module:attribute" is a policy of another package (``evaluation.outside``).
    Policies sample their actions; with ":argmax" after its name a policy takes the most likely
    action (``ArgmaxPolicy``).

    Raises:
        ValueError: for an unknown name, listing the known ones.
    """
    if name in PLANNERS:
        return PLANNERS[name](config)
    if is_outside(name):
        return outside.outside_policy(name, config)
    likeliest = name.endswith(ARGMAX)
    try:
        policy = load_policy(name.removesuffix(ARGMAX))
    except ValueError as error:
        raise ValueError(f"{error}; planners: {sorted(PLANNERS)}") from error
    _require_sensor(policy, config)
    policy = policy.in_world(config)
    return ArgmaxPolicy(policy, move_period=config.move_period) if likeliest else policy


def is_outside(name: str) -> bool:
    """Whether a name is that of a policy of another package."""
    return outside.NAME.fullmatch(name) is not None and not name.endswith(ARGMAX)


def _require_sensor(policy: Policy, config: ArenaConfig) -> None:
    """Refuse a sensor that sees another square than the policy's, with what would fit."""
    own = policy.config.arena
    if config.fov_size == own.fov_size or policy.config.network.any_sensor:
        return
    if config.sensing_shape != "square" or isinstance(config.sensing_range, tuple):
        return  # the policy says which size it was trained for
    low, high = ((own.fov_radius + part) * math.sqrt(2) for part in (0.5, 1.5))
    reach, cell = config.sensing_range, config.cell_size
    raise ValueError(
        f"the policy sees {own.fov_size} x {own.fov_size} cells, and cell_size={cell} with "
        f"sensing_range={reach} gives {config.fov_size} x {config.fov_size}: use a sensing_range "
        f"from {low * cell:.4g} to below {high * cell:.4g} m, or a cell_size from above "
        f"{reach / high:.4g} to {reach / low:.4g} m"
    )


def training_arenas(name: str) -> tuple[ArenaConfig, str]:
    """The arena and the kind of arenas (such as a suite's name) that a policy was trained on.

    Raises:
        ValueError: for anything that is not a trained policy, such as a planner's name.
    """
    name = name.removesuffix(ARGMAX)
    arena = load_policy(name).config.arena
    return arena, policy_info(name).get("config", {}).get("arenas", "uniform")


def trained_on(name: str) -> tuple[ArenaConfig, str] | None:
    """The ``training_arenas`` of a policy; None if it is not a trained policy."""
    try:
        return training_arenas(name)
    except ValueError:
        return None

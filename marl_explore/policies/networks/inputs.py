"""Inputs of networks: parts of the observation, with or without a robot axis."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from tensordict import NestedKey
from torch import Tensor

from marl_explore.config.arena import ArenaConfig
from marl_explore.transforms.features import FEATURES

PAPER_INPUTS = ("fov", "fpr", "net")


def observation_keys(inputs: Sequence[str]) -> list[NestedKey]:
    """Entries of the group "agents" that hold these parts of the observation."""
    return [("agents", "observation", key) for key in inputs]


OBSERVATION_KEYS = observation_keys(PAPER_INPUTS)


def concat_observation(fov: Tensor, fpr: Tensor, net: Tensor) -> Tensor:
    """Each observation as one vector, [*B, (2k + 1)^2 + 24 + N]."""
    return torch.cat((fov.flatten(-2), fpr.flatten(-2), net), -1)


def robots_first(names: Sequence[str], *inputs: Tensor) -> list[Tensor]:
    """The inputs [*B, N, ...] with these names, with the robot axis moved to the front."""
    return [x.movedim(-1 - FEATURES[name].dims, 0) for name, x in zip(names, inputs, strict=True)]


def by_robot(names: Sequence[str], *inputs: Tensor) -> Iterable[tuple[Tensor, ...]]:
    """The inputs [*B, N, ...] split by robot, without the robot axis."""
    return zip(*robots_first(names, *inputs), strict=True)


def robots_read(arena: ArenaConfig, robot: int | None) -> range:
    """Robots whose observations a critic reads: one, or all."""
    return range(arena.num_agents) if robot is None else range(robot, robot + 1)

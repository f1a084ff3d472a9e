"""What networks read: parts of the observation, with or without an axis of robots."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from tensordict import NestedKey
from torch import Tensor

PAPER_INPUTS = ("fov", "fpr", "net")


def observation_keys(inputs: Sequence[str]) -> list[NestedKey]:
    """Entries of the group "agents" that hold these parts of the observation."""
    return [("agents", "observation", key) for key in inputs]


OBSERVATION_KEYS = observation_keys(PAPER_INPUTS)
_EVENT_DIMS = {
    "fov": 2,
    "fpr": 2,
    "net": 1,
    "gain": 1,
    "territory": 2,
    "teammates": 2,
    "clock": 1,
    "local": 3,
}


def in_a_row(fov: Tensor, fpr: Tensor, net: Tensor) -> Tensor:
    """The numbers of each observation [*B, (2k + 1)^2 + 24 + N]."""
    return torch.cat((fov.flatten(-2), fpr.flatten(-2), net), -1)


def robots_first(names: Sequence[str], *inputs: Tensor) -> list[Tensor]:
    """The inputs [*B, N, ...] of these names with the robot axis in front."""
    return [x.movedim(-1 - _EVENT_DIMS[name], 0) for name, x in zip(names, inputs, strict=True)]


def by_robot(names: Sequence[str], *inputs: Tensor) -> Iterable[tuple[Tensor, ...]]:
    """The inputs [*B, N, ...] of each robot, the robot axis taken off."""
    return zip(*robots_first(names, *inputs), strict=True)

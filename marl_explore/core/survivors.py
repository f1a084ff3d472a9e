"""Largest, mean and smallest over the robots of a team that have not failed."""

from __future__ import annotations

import torch
from torch import Tensor


def some_failed(alive: Tensor) -> bool:
    """Whether some robot may have failed, for robots that are alive [*B, N].

    Always true on devices other than the CPU: asking would synchronise the device, which takes
    longer than what the answer can save.
    """
    return alive.device.type != "cpu" or not bool(alive.all())


def failing(alive: Tensor) -> Tensor | None:
    """Robots that are alive, or None if they are known to be all."""
    return alive if some_failed(alive) else None


def mean_of_living(values: Tensor, alive: Tensor) -> Tensor:
    """Mean of floats [*B, N] over the robots that are alive [*B, N], [*B]; 0 without any."""
    if not some_failed(alive):
        return values.mean(-1)
    return (values * alive).sum(-1) / alive.sum(-1).clamp_min_(1)


def largest_of_living(values: Tensor, alive: Tensor) -> Tensor:
    """Largest of numbers of at least 0 [*B, N] over the living [*B, N], [*B]; 0 without any."""
    return (values * alive).amax(-1)


def smallest_of_living(values: Tensor, alive: Tensor) -> Tensor:
    """Smallest of numbers of at least 0 [*B, N] over the living [*B, N], [*B]; 0 without any."""
    largest = values.amax(-1, keepdim=True)
    smallest = torch.where(alive, values, largest).amin(-1)
    return smallest * alive.any(-1)

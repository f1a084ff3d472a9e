"""Stops a run at the first value that is not finite, and says where it was."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn


class NonFiniteError(FloatingPointError):
    """A tensor of a training run contains NaN or infinity; the message names update and tensor."""


def require_finite_batch(batch: TensorDictBase, update: int) -> None:
    """Raise an error for a rollout [B, T] with a value that is not finite.

    Raises:
        NonFiniteError: naming update, entry and, for entries [B, T, N, ...] of the group
            "agents", the robots.
    """
    for key, value in batch.items(include_nested=True, leaves_only=True):
        if value.is_floating_point() and not value.isfinite().all():
            robots = ""
            if "agents" in key:
                wrong = ~value.isfinite().flatten(3) if value.ndim > 3 else ~value.isfinite()
                rows = wrong.movedim(2, 0).flatten(1).any(1).nonzero().flatten()
                robots = " of " + ", ".join(f"robot_{i}" for i in rows.tolist())
            raise NonFiniteError(f"update {update}: {_name(key)}{robots} {_what(value)}")


def require_finite(tensors: Iterable[tuple[str, Tensor | None]], update: int, where: str) -> None:
    """Raise an error for tensors with a value that is not finite.

    Args:
        tensors: names and tensors; None is skipped.
        update: number of the update, starting at 1.
        where: whose tensors they are, such as "robot_1".

    Raises:
        NonFiniteError: naming update, owner and tensor.
    """
    named = [(name, value.detach()) for name, value in tensors if value is not None]
    numbers = [value for _, value in named if value.is_floating_point()]
    if nn.utils.get_total_norm(numbers).isfinite():
        return  # one norm over all takes a third of the time of checking each tensor
    for name, value in named:
        if not value.isfinite().all():
            raise NonFiniteError(f"update {update}, {where}: {name} {_what(value)}")


def _name(key: NestedKey) -> str:
    return key if isinstance(key, str) else ", ".join(map(str, key))


def _what(value: Tensor) -> str:
    number, size = int((~value.isfinite()).sum()), value.numel()
    kind = "NaN" if torch.isnan(value).any() else "infinite"
    return f"is {kind}" if size == 1 else f"is not finite: {number} of {size} values ({kind})"

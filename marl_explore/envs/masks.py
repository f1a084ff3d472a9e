"""The spec of the robots' actions: random ones are those that the current state allows."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torchrl.data import Categorical
from torchrl.data.utils import ACTION_SPACE_MAP

from marl_explore.core.motion import random_allowed


class CurrentMask:
    """The action mask of an environment's current state, shared by all clones of its spec."""

    def __init__(self) -> None:
        self.value: Tensor | None = None
        """bool [B, N, 10]; None before the first reset."""

    def __getstate__(self) -> dict[str, None]:
        return {"value": None}  # a spec in another process has no state to follow


class AllowedActions(Categorical):
    """Integers 0 to 9, of which ``rand`` draws those that an environment's state allows.

    The environment keeps ``current`` up to date, and clones share it: a ``TransformedEnv`` and a
    collector's random policy hold clones. Any valid action remains in the spec. A mask of the
    spec's own (``update_mask``, as TorchRL's ``ActionMask`` calls it) takes precedence. Specs of
    another shape follow no environment and draw any action.

    ``EnvBase.rand_action`` stays as it is, because TorchRL refuses random rollouts of an
    environment that overrides it and has an ``ActionMask``.
    """

    current: CurrentMask | None = None

    def rand(self, shape: torch.Size | None = None) -> Tensor:
        """Random actions, int64 [*shape, B, N]."""
        mask = None if self.current is None else self.current.value
        if mask is None or self.mask is not None:
            return super().rand(shape)
        drawn = random_allowed(mask.expand(*(shape or ()), *mask.shape))
        return drawn.to(self.device, self.dtype)

    def to(self, dest: torch.dtype | torch.device | str) -> AllowedActions:
        """The spec with another dtype or on another device, of the same environment."""
        moved: Any = super().to(dest)
        moved.current = self.current
        return moved

    def clone(self) -> AllowedActions:
        """A copy that follows the same environment."""
        copied: Any = super().clone()
        copied.current = self.current
        return copied


# TorchRL's value modules look kinds of specs up by class, not by subclass
ACTION_SPACE_MAP[AllowedActions] = ACTION_SPACE_MAP[Categorical]

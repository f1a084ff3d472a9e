"""What planners share: the entries they read, and yielding where a move is not possible."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from marl_explore.core.grid import COMMUNICATE, NUM_DIRECTIONS, STAY
from marl_explore.core.motion import random_allowed
from marl_explore.planners.communication import CommunicationRule


class Planner(TensorDictModuleBase):
    """Chooses a move by ``plan``, unless its communication rule says to communicate.

    A robot whose last move was refused, or whose planned move is not allowed, makes a random
    allowed move instead: without this yield rule two robots that want to pass block each other.
    """

    in_keys: list[NestedKey] = [  # noqa: RUF012 - TensorDict modules declare their keys so
        ("agents", key)
        for key in ("map", "position", "action_mask", "dangerous", "steps_since_merge", "merged")
    ]
    out_keys: list[NestedKey] = [("agents", "action")]  # noqa: RUF012

    def __init__(self, communicate: CommunicationRule) -> None:
        super().__init__()
        self.communicate = communicate

    def plan(self, tensordict: TensorDictBase) -> Tensor:
        """The wanted move or STAY of each robot, int64 [*B, N]."""
        raise NotImplementedError

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ("agents", "action")."""
        mask = tensordict.get(("agents", "action_mask"))
        wanted = self.plan(tensordict)
        allowed = mask.gather(-1, wanted.unsqueeze(-1)).squeeze(-1)
        refused = tensordict.get(("agents", "dangerous"))
        yielding = mask.clone()
        yielding[..., NUM_DIRECTIONS:] = False
        yielding[..., STAY] = ~yielding.any(-1)  # only where no move is open
        blocked = (wanted != STAY) & (refused | ~allowed)
        action = torch.where(blocked, random_allowed(yielding), wanted)
        action = action.masked_fill(self.communicate(tensordict), COMMUNICATE)
        return tensordict.set(("agents", "action"), action)

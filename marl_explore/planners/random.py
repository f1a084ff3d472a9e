"""The random walk that every policy has to beat."""

from __future__ import annotations

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase

from marl_explore.core.motion import random_allowed


class RandomWalk(TensorDictModuleBase):
    """Uniform choice among the allowed actions, communication included."""

    in_keys: list[NestedKey] = [("agents", "action_mask")]  # noqa: RUF012
    out_keys: list[NestedKey] = [("agents", "action")]  # noqa: RUF012
    sees: str = "which actions are allowed"

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ("agents", "action")."""
        action = random_allowed(tensordict.get(("agents", "action_mask")))
        return tensordict.set(("agents", "action"), action)

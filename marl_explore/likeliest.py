"""Policies that do what is likeliest instead of drawing from their probabilities."""

from __future__ import annotations

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import ExplorationType, set_exploration_type

from marl_explore.core.motion import give_way
from marl_explore.policies import Policy
from marl_explore.team import ACTION, ACTION_MASK

REFUSED: NestedKey = ("agents", "dangerous")


class LikeliestActions(TensorDictModuleBase):
    """A policy's likeliest actions, with the planners' yield rule.

    A refused move changes nothing that a policy without memory sees, so that it would choose it
    again for ever: a robot whose last move was refused makes a random allowed move.

    Args:
        policy: the team.
    """

    out_keys: list[NestedKey] = [ACTION]  # noqa: RUF012

    def __init__(self, policy: Policy) -> None:
        super().__init__()
        self.policy = policy
        self.in_keys: list[NestedKey] = [*policy.in_keys, REFUSED]
        self.sees = policy.sees

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ("agents", "action") int64 [*B, N]."""
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            wanted = self.policy(tensordict).get(ACTION)
        action = give_way(wanted, tensordict.get(ACTION_MASK), tensordict.get(REFUSED))
        return tensordict.set(ACTION, action)

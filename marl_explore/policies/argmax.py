"""Policies that take the most likely action instead of sampling."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import ExplorationType, set_exploration_type

from marl_explore.core.mapping import known_cells, known_mask
from marl_explore.core.motion import give_way
from marl_explore.policies.actors import ACTION, ACTION_MASK, REFUSED
from marl_explore.policies.policy import Policy

MAP: NestedKey = ("agents", "map")
STEP: NestedKey = "step_count"


class ArgmaxPolicy(TensorDictModuleBase):
    """A policy's most likely actions, with a way out of endless repetition.

    A memoryless policy would repeat a refused move forever, so a robot whose last move was refused
    makes a random allowed move, as planners do. A robot whose map has not grown for more than
    ``patience`` steps may be moving in circles, so it samples its actions until its map grows
    again. Call this once per step; its memory is reset at step 0 of an episode. Policies that
    choose among goals give way themselves and have a memory of their own.

    Args:
        policy: the team.
        patience: steps without map growth before actions are sampled.
    """

    out_keys: list[NestedKey] = [ACTION]  # noqa: RUF012

    def __init__(self, policy: Policy, patience: int = 12) -> None:
        super().__init__()
        self.policy, self.patience = policy, patience
        self.in_keys: list[NestedKey] = [*dict.fromkeys((*policy.in_keys, REFUSED, MAP, STEP))]
        self.sees = policy.sees
        self._known = self._since = torch.zeros(0, dtype=torch.int64)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ("agents", "action") int64 [*B, N]."""
        if self.policy.team.to_goals:
            with set_exploration_type(ExplorationType.DETERMINISTIC):
                return self.policy(tensordict)
        observed = self.policy.observe(tensordict)
        wanted = self._choose(observed, ExplorationType.DETERMINISTIC)
        stalled = self._remember(tensordict) > self.patience
        if stalled.any():
            drawn = self._choose(observed, ExplorationType.RANDOM)
            wanted = torch.where(stalled, drawn, wanted)
        action = give_way(wanted, tensordict.get(ACTION_MASK), tensordict.get(REFUSED))
        return tensordict.set(ACTION, action)

    def _choose(self, observed: TensorDictBase, how: ExplorationType) -> Tensor:
        with set_exploration_type(how):
            return self.policy.team(observed).get(ACTION)

    def _remember(self, tensordict: TensorDictBase) -> Tensor:
        """Steps since each robot's map last grew, int64 [*B, N]; 0 at the start of an episode."""
        known = known_cells(known_mask(tensordict.get(MAP)))
        if self._known.shape != known.shape:
            self._known = self._since = torch.zeros_like(known)
        grown = (known > self._known) | (tensordict.get(STEP) == 0)
        self._since = torch.where(grown, 0, self._since + 1)
        self._known = known
        return self._since

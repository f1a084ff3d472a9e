"""Policies that take the most likely action instead of sampling."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import ExplorationType, set_exploration_type

from marl_explore.config import goals
from marl_explore.config.arena import ArenaConfig
from marl_explore.core.mapping import known_cells, known_mask
from marl_explore.core.motion import give_way
from marl_explore.planners.goal_moves import follow, goes_to_and_fro, keep_goal
from marl_explore.planners.hindrances import Turns
from marl_explore.policies.actors import ACTION, ACTION_MASK, CHOICE
from marl_explore.policies.policy import Policy
from marl_explore.transforms.goals import Candidates
from marl_explore.transforms.memory import DANGEROUS, GOAL, REFUSED, STALLED

MAP: NestedKey = ("agents", "map")
STEP: NestedKey = "step_count"
PATIENCE = 12


class ArgmaxPolicy(TensorDictModuleBase):
    """A policy's most likely actions, with a way out of endless repetition.

    A memoryless policy would repeat a refused move forever, so a robot whose last move was refused
    makes a random allowed move, as planners do. A robot whose map has not grown for more than
    ``patience`` steps may be moving in circles, so it samples its actions until its map grows
    again. Call this once per step; its memory is reset at step 0 of an episode. Policies that
    choose among goals give way themselves; a robot whose map has not grown for so long stays with
    its last goal (``planners.goal_moves.keep_goal``), as two may turn back and forth for each
    other.

    Args:
        policy: the team.
        patience: steps without map growth before that; None: 12, or 40 if it chooses among goals,
            since ways to goals are longer.
        move_period: of the robots; None: of those that the policy was trained for.
    """

    out_keys: list[NestedKey] = [ACTION]  # noqa: RUF012

    def __init__(
        self,
        policy: Policy,
        patience: int | None = None,
        move_period: int | tuple[int, ...] | None = None,
    ) -> None:
        super().__init__()
        if patience is None:
            patience = goals.PATIENCE if policy.team.to_goals else PATIENCE
        self.policy, self.patience = policy, patience
        self.in_keys: list[NestedKey] = [*dict.fromkeys((*policy.in_keys, DANGEROUS, MAP, STEP))]
        self.sees = policy.sees
        self._turns = Turns(policy.config.arena.move_period if move_period is None else move_period)
        self._known = self._since = torch.zeros(0, dtype=torch.int64)

    def in_world(self, arena: ArenaConfig) -> ArgmaxPolicy:
        """As ``Policy.in_world``."""
        return ArgmaxPolicy(self.policy.in_world(arena), self.patience, arena.move_period)

    def only(self, arenas: Tensor) -> None:
        """Forget all but some arenas of the batch [B], int64 [b]: the next one has only those."""
        if self.policy.team.to_goals:
            return  # what it remembers is in the memory of its features
        self._known, self._since = self._known[arenas], self._since[arenas]
        self._turns.only(arenas)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ("agents", "action") int64 [*B, N]."""
        observed = self.policy.observe(tensordict)
        if self.policy.team.to_goals:
            return self._choose_goals(tensordict, observed)
        stalled = self._remember(tensordict) > self.patience
        wanted = self._choose(observed, ExplorationType.DETERMINISTIC)
        if stalled.any():
            drawn = self._choose(observed, ExplorationType.RANDOM)
            wanted = torch.where(stalled, drawn, wanted)
        action = give_way(wanted, tensordict.get(ACTION_MASK), self._turns.refused(tensordict))
        return tensordict.set(ACTION, action)

    def _choose(self, observed: TensorDictBase, how: ExplorationType) -> Tensor:
        with set_exploration_type(how):
            return self.policy.team(observed).get(ACTION)

    def _choose_goals(self, tensordict: TensorDictBase, observed: TensorDictBase) -> TensorDictBase:
        team, last = self.policy.team, observed.get(GOAL)
        stalled = observed.get(STALLED) > self.patience
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            acted = team(observed)
        if stalled.any():
            found = Candidates(*(acted.get(key) for key in team.observation_keys))
            choice = keep_goal(found, acted.get(CHOICE), stalled)
            changed = choice != acted.get(CHOICE)
            move = follow(acted.set(GOAL, last), found, choice)
            yields = observed.get(REFUSED) | goes_to_and_fro(observed, move)
            move = give_way(move, tensordict.get(ACTION_MASK), yields)
            acted.set(ACTION, torch.where(changed, move, acted.get(ACTION)))
        return self.policy.write(tensordict, acted)

    def _remember(self, tensordict: TensorDictBase) -> Tensor:
        """Steps since each robot's map last grew, int64 [*B, N]; 0 at the start of an episode."""
        known = known_cells(known_mask(tensordict.get(MAP)))
        if self._known.shape != known.shape or self._known.device != known.device:
            self._known = self._since = torch.zeros_like(known)
        grown = (known > self._known) | (tensordict.get(STEP) == 0)
        self._since = torch.where(grown, 0, self._since + 1)
        self._known = known
        return self._since

"""Features of candidate goals for networks: scaled to about unit size, with choices and a prior."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from marl_explore.config.constants import GOAL_COLUMNS, MAX_FRONTIERS
from marl_explore.planners.goal_utility import (
    NOT_CHOSEN,
    GoalWeights,
    frontier_utility,
    mate_utility,
    overdue,
    place_terms,
    share,
)
from marl_explore.transforms.goals import CONTEXT_COLUMNS, MATE_COLUMNS, Candidates

EXCHANGE_DUE, EXCHANGE_EARLY = 0.5, -0.4
"""Prior of communicating, relative to the best goal: when it is overdue, and before."""
FRONTIER_SIZE, PAIR_SIZE, MATE_SIZE, STILL_SIZE, CONTEXT_SIZE = 18, 8, 5, 8, 10
"""Numbers of features of a candidate frontier, of a teammate beside it, of a teammate as a goal, of
staying or communicating, and of the robot itself."""

_ABOUT = [MATE_COLUMNS.index(name) for name in ("age", "unshared", "since")]
_SHARED = [GOAL_COLUMNS.index(name) for name in ("moves", "from_last_goal", "pocket")]
_PLACE = (
    *("moves", "1 / moves", "nearest / moves", "near_gain", "middle_gain", "far_gain"),
    *("merged_cells", "last_goal", "from_last_goal", "ahead", "pocket", "small pocket"),
    *("isolation", "nearest of all", "move_gain", "allowed", "rivals", "utility"),
)
"""Features of a candidate frontier in their order."""
_COMPUTED = (
    *("moves", "from_last_goal", "pocket", "1 / moves"),
    *("-moves", "-log", "near_gain", "middle_gain", "far_gain", "merged_cells", "-exp"),
    *("isolation", "last_goal", "ahead", "move_gain", "allowed"),
    *("nearest / moves", "small pocket", "nearest of all", "rivals", "utility"),
)
"""The order in which they are computed, with further terms of the utility."""
_BUFFERS = {
    "about_halves": [16.0, 64.0, 8.0],
    "shared_halves": [8.0, 4.0, 12.0],
    "order": [_COMPUTED.index(name) for name in _PLACE],
}


class GoalFeatures(NamedTuple):
    """Features of R robots, with a row per candidate, and which rows are choices."""

    frontier: Tensor
    """[R, 24, FRONTIER_SIZE]."""
    pair: Tensor
    """[R, 24, N, PAIR_SIZE]."""
    known_mate: Tensor
    """Teammates that were seen, bool [R, N]."""
    mate: Tensor
    """[R, N, MATE_SIZE]."""
    still: Tensor
    """[R, 2, STILL_SIZE]."""
    context: Tensor
    """[R, CONTEXT_SIZE]."""
    valid: Tensor
    """[R, 24 + N + 2]."""
    prior: Tensor
    """[R, 24 + N + 2]."""


class FeatureScaling(nn.Module):
    """The features, choices and prior of R robots, whose candidates have shapes [R, ...].

    Args:
        radius: half side of the field of view (cells).
        every: robots may communicate every so many steps, besides when it is overdue.
        after: minimum steps since the last exchange with a linked robot before doing so.
    """

    weights: Tensor
    about_halves: Tensor
    shared_halves: Tensor
    order: Tensor

    def __init__(self, radius: int, every: int, after: int) -> None:
        super().__init__()
        self.radius, self.every, self.after = radius, every, after
        # saved with the policy: its prior does not follow later changes of the planner
        self.register_buffer("weights", GoalWeights().as_tensor().to(torch.get_default_dtype()))
        for name, numbers in _BUFFERS.items():
            self.register_buffer(name, torch.tensor(numbers), persistent=False)

    def forward(self, candidates: Candidates) -> GoalFeatures:
        """Features of about unit size, the choices, and their prior."""
        dtype = self.weights.dtype
        candidates = Candidates(*(entry.to(dtype) for entry in candidates))
        terms = place_terms(candidates.frontiers, self.radius)
        utility = frontier_utility(candidates, terms, self.weights)
        visit = mate_utility(candidates, self.weights)
        due = overdue(candidates, self.weights)
        mates = dict(zip(MATE_COLUMNS, candidates.mates.unbind(-1), strict=True))
        own = dict(zip(CONTEXT_COLUMNS, candidates.context.unbind(-1), strict=True))
        linked = mates["linked"]
        moves = candidates.frontiers[..., GOAL_COLUMNS.index("moves")]
        filled, known = moves > 0, mates["seen"] > 0
        length, knows = candidates.rivals.unbind(-1)
        nearer = (length < moves.unsqueeze(-1)) & known.unsqueeze(-2)
        nearest = moves.masked_fill(~filled, torch.inf).amin(-1, keepdim=True)
        # age, unshared cells and steps since the last exchange
        about = share(candidates.mates[..., _ABOUT], self.about_halves)
        goals, talks, stays = self._choices(utility, visit, linked, mates["since"], own, due)
        return GoalFeatures(
            frontier=self._places(candidates.frontiers, terms, nearest, nearer, linked, utility),
            pair=self._pairs(linked, about, length, knows, moves, mates["age"]),
            known_mate=known,
            mate=self._visits(mates["moves"], about),
            still=self._stills(mates, linked, due),
            context=self._context(own, linked, filled, mates["unshared"], nearest),
            valid=torch.cat((goals > NOT_CHOSEN, talks, stays), -1),
            prior=self._prior(goals, due),
        )

    def _places(
        self,
        frontiers: Tensor,
        terms: Tensor,
        nearest: Tensor,
        nearer: Tensor,
        linked: Tensor,
        utility: Tensor,
    ) -> Tensor:
        """``GoalFeatures.frontier``."""
        moves, pocket = (frontiers[..., GOAL_COLUMNS.index(c)] for c in ("moves", "pocket"))
        rivals = (nearer * linked.unsqueeze(-2)).amax(-1), nearer.sum(-1)
        own = torch.stack(
            (
                nearest / moves,
                pocket <= 4,
                1 - rivals[0],
                share(rivals[1].to(moves), 3),
                utility.clamp(-3, 3),
            ),
            -1,
        )
        allowed = frontiers[..., GOAL_COLUMNS.index("move_allowed"), None]
        shares = share(frontiers[..., _SHARED].clamp_min(0), self.shared_halves)
        every = torch.cat((shares, 1 / moves.unsqueeze(-1), terms, allowed, own), -1)
        return every.index_select(-1, self.order)

    def _pairs(
        self,
        linked: Tensor,
        about: Tensor,
        length: Tensor,
        knows: Tensor,
        moves: Tensor,
        age: Tensor,
    ) -> Tensor:
        """``GoalFeatures.pair``."""
        of_mate = torch.cat((linked.unsqueeze(-1), about), -1).unsqueeze(-3)
        behind = length - moves.unsqueeze(-1)
        late = behind - age.unsqueeze(-2)
        beside = (
            (behind / 8).clamp(-1, 1),
            4 / (4 + length.clamp_min(0)),
            knows,
            (late / 16).clamp(-1, 1),
        )
        return torch.cat((of_mate.expand(*length.shape, -1), torch.stack(beside, -1)), -1)

    @staticmethod
    def _visits(walk: Tensor, about: Tensor) -> Tensor:
        """``GoalFeatures.mate``."""
        of_walk = torch.stack((share(walk, 8), 1 / walk.clamp_min(1)), -1)
        return torch.cat((of_walk, about), -1)

    @staticmethod
    def _stills(mates: dict[str, Tensor], linked: Tensor, due: Tensor) -> Tensor:
        """``GoalFeatures.still``."""
        number = linked.sum(-1)
        one, zero = torch.ones_like(number), torch.zeros_like(number)
        talk = (
            one,
            share((mates["since"] * linked).amax(-1), 8),
            share((mates["unshared"] * linked).sum(-1), 64),
            share(number, 3),
            share(mates["square_distance"].amax(-1).sqrt(), 6),
            due.to(number),
            mates["waited"].amax(-1),
            zero,
        )
        stay = (*[zero] * (STILL_SIZE - 1), one)
        return torch.stack((*talk, *stay), -1).unflatten(-1, (2, STILL_SIZE))

    @staticmethod
    def _context(
        own: dict[str, Tensor], linked: Tensor, filled: Tensor, unshared: Tensor, nearest: Tensor
    ) -> Tensor:
        """``GoalFeatures.context``."""
        number = filled.sum(-1)
        parts = (
            share(own["step"], 64),
            number / MAX_FRONTIERS,
            own["known_cells"] / own["cells"].clamp_min(1),
            share(linked.sum(-1), 3),
            own["robots"] / 8,
            number > 0,
            own["all_covered"],
            own["refused"],
            share(unshared, 64).sum(-1) / (own["robots"] - 1).clamp_min(1),
            4 / (4 + nearest.squeeze(-1)),
        )
        return torch.stack([part.to(linked) for part in parts], -1)

    def _choices(
        self,
        utility: Tensor,
        visit: Tensor,
        linked: Tensor,
        since: Tensor,
        own: dict[str, Tensor],
        due: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Utilities of all places, and whether to communicate and to stay are choices."""
        goals = torch.cat((utility, visit), -1)
        nowhere = (goals <= NOT_CHOSEN).all(-1)
        on_time = (own["step"] % self.every == 0) & ((since * linked).amax(-1) >= self.after)
        alone = nowhere & (own["all_covered"] > 0)
        talks = (own["may_communicate"] > 0) & (on_time | due | alone)
        return goals, talks.unsqueeze(-1), (nowhere & ~talks).unsqueeze(-1)

    @staticmethod
    def _prior(goals: Tensor, due: Tensor) -> Tensor:
        """``GoalFeatures.prior``."""
        best = goals.amax(-1, keepdim=True)
        talk = torch.where(due, EXCHANGE_DUE, EXCHANGE_EARLY).unsqueeze(-1).to(goals)
        return torch.cat((goals - best, talk, torch.zeros_like(best)), -1)

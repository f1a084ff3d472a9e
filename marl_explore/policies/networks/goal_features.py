"""Features of candidate goals for networks: scaled to about unit size, with choices and a prior."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from marl_explore.config.constants import (
    CONTEXT_COLUMNS,
    GOAL_COLUMNS,
    MATE_COLUMNS,
    MAX_FRONTIERS,
)
from marl_explore.config.goals import (
    BEHIND_MOVES,
    COMPUTED,
    EXCHANGE_DUE,
    EXCHANGE_EARLY,
    HALVES,
    LATE_MOVES,
    MOST_UTILITY,
    NEAR_MOVES,
    PLACE,
    PRIOR,
    SENSOR,
    SMALL_POCKET,
    STILL_SIZE,
    TEAM,
)
from marl_explore.planners.goal_utility import (
    NOT_CHOSEN,
    frontier_utility,
    mate_utility,
    overdue,
    place_terms,
    share,
    weight_tensor,
)
from marl_explore.transforms.goals import Candidates

_ABOUT = ("age", "unshared", "since")
_SHARED = ("moves", "from_last_goal", "pocket")
_ABOUT_COLUMNS = [MATE_COLUMNS.index(name) for name in _ABOUT]
_SHARED_COLUMNS = [GOAL_COLUMNS.index(name) for name in _SHARED]
_BUFFERS = {
    "about_halves": [HALVES[name] for name in _ABOUT],
    "shared_halves": [HALVES[name] for name in _SHARED],
    "order": [COMPUTED.index(name) for name in PLACE],
}


class GoalFeatures(NamedTuple):
    """Features of R robots, which have V candidate frontiers together, and what are choices."""

    row: Tensor
    """Robot of each candidate frontier, int64 [V]."""
    frontier: Tensor
    """[V, FRONTIER_SIZE]."""
    pair: Tensor
    """Of every teammate beside every candidate frontier, [V, max(N - 1, 1), PAIR_SIZE]; if dense
    of every robot, [V, N, PAIR_SIZE]."""
    known_mate: Tensor
    """Teammates that were seen, bool [V, max(N - 1, 1)], or [V, N]."""
    mate: Tensor
    """[R, N, MATE_SIZE]."""
    still: Tensor
    """[R, 2, STILL_SIZE]."""
    context: Tensor
    """[R, CONTEXT_SIZE], followed by ``SENSOR`` where the sensor is read."""
    valid: Tensor
    """[R, 24 + N + 2]."""
    prior: Tensor
    """[R, 24 + N + 2]."""


class FeatureScaling(nn.Module):
    """The features, choices and prior of R robots, whose candidates have shapes [R, ...].

    Args:
        every: robots may communicate every so many steps, besides when it is overdue.
        after: minimum steps since the last exchange with a linked robot before doing so.
        reads_sensor: whether the context has the robot's own sensor.
    """

    weights: Tensor
    about_halves: Tensor
    shared_halves: Tensor
    order: Tensor

    def __init__(self, every: int, after: int, reads_sensor: bool = False) -> None:
        super().__init__()
        self.every, self.after, self.reads_sensor = every, after, reads_sensor
        # saved with the policy: its prior does not follow later changes of the planner
        self.register_buffer("weights", weight_tensor(PRIOR).to(torch.get_default_dtype()))
        for name, numbers in _BUFFERS.items():
            self.register_buffer(name, torch.tensor(numbers), persistent=False)

    def forward(self, candidates: Candidates, dense: bool = False) -> GoalFeatures:
        """Features of about unit size, the choices, and their prior.

        Args:
            candidates: of R robots.
            dense: whether rows without a candidate have features too, which mean nothing, and pairs
                all N robots: then V is 24 R, and no shape depends on what there is.
        """
        dtype = self.weights.dtype
        moves = candidates.frontiers[..., GOAL_COLUMNS.index("moves")]
        filled = moves > 0
        place = _every_place(filled) if dense else filled.flatten().nonzero().squeeze(-1)
        row = place // filled.shape[-1]
        # most rows of these tables are empty
        frontiers, rivals = (
            entry.flatten(0, 1).index_select(0, place).to(dtype)
            for entry in (candidates.frontiers, candidates.rivals)
        )
        candidates = candidates._replace(
            mates=candidates.mates.to(dtype), context=candidates.context.to(dtype)
        )
        known = candidates.mates[..., MATE_COLUMNS.index("seen")] > 0
        others = None if dense else _others(known)
        # as if each candidate had a robot of its own
        alone = Candidates(
            frontiers.unsqueeze(-2),
            _of(others if others is None else others.index_select(0, row), rivals).unsqueeze(-3),
            _of(others, candidates.mates).index_select(0, row),
            candidates.context.index_select(0, row),
        )
        terms = place_terms(alone)
        utility = frontier_utility(alone, terms, self.weights)
        visit = mate_utility(candidates, self.weights)
        due = overdue(candidates, self.weights)
        mates = dict(zip(MATE_COLUMNS, candidates.mates.unbind(-1), strict=True))
        own = dict(zip(CONTEXT_COLUMNS, candidates.context.unbind(-1), strict=True))
        linked = mates["linked"]
        nearest = moves.to(dtype).masked_fill(~filled, torch.inf).amin(-1, keepdim=True)
        # age, unshared cells and steps since the last exchange
        about = share(candidates.mates[..., _ABOUT_COLUMNS], self.about_halves)
        every = linked.new_full((filled.numel(),), NOT_CHOSEN)
        every = every.index_copy(0, place, utility.squeeze(-1)).view_as(filled)
        goals, talks, stays = self._choices(every, visit, linked, mates["since"], own, due)
        length, knows = alone.rivals.unbind(-1)
        walk = frontiers[..., GOAL_COLUMNS.index("moves"), None, None]
        seen, linked_there, age = (
            alone.mates[..., MATE_COLUMNS.index(name)] for name in ("seen", "linked", "age")
        )
        nearer = (length < walk) & (seen > 0).unsqueeze(-2)
        first = nearest.index_select(0, row)
        frontier = self._places(alone.frontiers, terms, first, nearer, linked_there, utility)
        about_there = _of(others, about).index_select(0, row)
        pair = self._pairs(linked_there, about_there, length, knows, walk.squeeze(-1), age)
        return GoalFeatures(
            row=row,
            frontier=frontier.squeeze(-2),
            pair=pair.squeeze(-3),
            known_mate=seen > 0,
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
                (pocket <= SMALL_POCKET).to(moves),
                1 - rivals[0],
                share(rivals[1].to(moves), HALVES["rivals"]),
                utility.clamp(-MOST_UTILITY, MOST_UTILITY),
            ),
            -1,
        )
        allowed = frontiers[..., GOAL_COLUMNS.index("move_allowed"), None]
        shares = share(frontiers[..., _SHARED_COLUMNS].clamp_min(0), self.shared_halves)
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
            (behind / BEHIND_MOVES).clamp(-1, 1),
            NEAR_MOVES / (NEAR_MOVES + length.clamp_min(0)),
            knows,
            (late / LATE_MOVES).clamp(-1, 1),
        )
        return torch.cat((of_mate.expand(*length.shape, -1), torch.stack(beside, -1)), -1)

    @staticmethod
    def _visits(walk: Tensor, about: Tensor) -> Tensor:
        """``GoalFeatures.mate``."""
        of_walk = torch.stack((share(walk, HALVES["moves"]), 1 / walk.clamp_min(1)), -1)
        return torch.cat((of_walk, about), -1)

    @staticmethod
    def _stills(mates: dict[str, Tensor], linked: Tensor, due: Tensor) -> Tensor:
        """``GoalFeatures.still``."""
        number = linked.sum(-1)
        one, zero = torch.ones_like(number), torch.zeros_like(number)
        talk = (
            one,
            share((mates["since"] * linked).amax(-1), HALVES["since"]),
            share((mates["unshared"] * linked).sum(-1), HALVES["unshared"]),
            share(number, HALVES["linked"]),
            share(mates["square_distance"].amax(-1).sqrt(), HALVES["distance"]),
            due.to(number),
            mates["waited"].amax(-1),
            zero,
        )
        stay = (*[zero] * (STILL_SIZE - 1), one)
        return torch.stack((*talk, *stay), -1).unflatten(-1, (2, STILL_SIZE))

    def _context(
        self,
        own: dict[str, Tensor],
        linked: Tensor,
        filled: Tensor,
        unshared: Tensor,
        nearest: Tensor,
    ) -> Tensor:
        """``GoalFeatures.context``."""
        number, cells = filled.sum(-1), own["cells"].clamp_min(1)
        parts = [
            share(own["step"] * own["robots"] / cells, HALVES["time"]),
            number / MAX_FRONTIERS,
            own["known_cells"] / cells,
            share(linked.sum(-1), HALVES["linked"]),
            own["robots"] / TEAM,
            number > 0,
            own["all_covered"],
            own["refused"],
            share(unshared, HALVES["unshared"]).sum(-1) / (own["robots"] - 1).clamp_min(1),
            NEAR_MOVES / (NEAR_MOVES + nearest.squeeze(-1)),
        ]
        if self.reads_sensor:
            parts += [share(own[name], HALVES[name]) for name in SENSOR]
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


def _every_place(table: Tensor) -> Tensor:
    """The numbers of all entries of a table [R, C], int64 [R C]."""
    return torch.arange(table.numel(), device=table.device)


def _of(robots: Tensor | None, table: Tensor) -> Tensor:
    """What a table [R, N, F] says of some robots int64 [R, n], [R, n, F]; None: of all."""
    return table if robots is None else table.take_along_dim(robots.unsqueeze(-1), -2)


def _others(known: Tensor) -> Tensor:
    """The numbers of all robots but one that was not seen, int64 [R, max(N - 1, 1)].

    Nobody sees itself, so this leaves out nothing.

    Args:
        known: teammates that were seen, bool [R, N].
    """
    first = known.int().argmin(-1, keepdim=True)
    numbers = torch.arange(max(known.shape[-1] - 1, 1), device=known.device)
    return (numbers + (numbers >= first)).clamp_max(known.shape[-1] - 1)

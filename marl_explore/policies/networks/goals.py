"""An actor that scores candidate goals: where to go, and whether to communicate now."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.checks import require_integer
from marl_explore.config.constants import FORBIDDEN_LOGIT, GOAL_COLUMNS, MAX_FRONTIERS
from marl_explore.config.fields import check_types
from marl_explore.planners.goal_utility import (
    NOT_CHOSEN,
    GoalWeights,
    frontier_utility,
    mate_utility,
    overdue,
    place_terms,
    share,
)
from marl_explore.policies.networks.base import Network
from marl_explore.policies.networks.layers import ACTOR_GAIN, CRITIC_GAIN, initialize
from marl_explore.transforms.goals import CONTEXT_COLUMNS, MATE_COLUMNS, Candidates

EXCHANGE_DUE, EXCHANGE_EARLY = 0.5, -0.4
"""Prior of communicating, relative to the best goal: when it is overdue, and before."""
_FRONTIER, _PAIR, _MATE, _STILL, _CONTEXT = 18, 8, 5, 8, 10
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


@dataclass(frozen=True)
class Goals(Network):
    """One actor for any team in any arena that chooses among candidate goals (docs/goals.md)."""

    code_width: int = 48
    """Width of the encoding of a candidate."""
    pair_width: int = 16
    """Width of the encoding of a candidate and a teammate."""
    prior: float = 8.0
    """Initial weight of the linear utility (``planners.goal_utility``) in the logits."""
    communicate_every: int = 3
    """Robots may communicate every so many steps of a shared clock, besides when it is overdue."""
    communicate_after: int = 4
    """Minimum steps since the last exchange with a linked robot before doing so."""

    name = "goals"
    features = Candidates._fields
    any_team = True
    sees = "own map, positions of robots in range and where it saw them last, what was exchanged"
    chooses = "goals"
    vmaps = False

    def __post_init__(self) -> None:
        """Check the options."""
        check_types(self)
        for option in ("code_width", "pair_width", "communicate_every"):
            require_integer(option, getattr(self, option), 1)
        require_integer("communicate_after", self.communicate_after, 0)

    @property
    def layout(self) -> Goals:
        """The network without the options that do not affect weights' shapes."""
        return replace(self, communicate_every=1, communicate_after=0, prior=0.0)

    def make_actor(self, arena: ArenaConfig) -> GoalActor:
        """As ``Network.make_actor``."""
        return GoalActor(arena, self)

    def make_observation_critic(self, arena: ArenaConfig, robot: int | None) -> GoalCritic:
        """As ``Network.make_observation_critic``."""
        return GoalCritic(arena, self, robot)


class _Scaled(NamedTuple):
    """Features of R robots, with a row per candidate, and which rows are choices."""

    frontier: Tensor
    """[R, 24, _FRONTIER]."""
    pair: Tensor
    """[R, 24, N, _PAIR]."""
    known_mate: Tensor
    """Teammates that were seen, bool [R, N]."""
    mate: Tensor
    """[R, N, _MATE]."""
    still: Tensor
    """[R, 2, _STILL]."""
    context: Tensor
    """[R, _CONTEXT]."""
    valid: Tensor
    """[R, 24 + N + 2]."""
    prior: Tensor
    """[R, 24 + N + 2]."""


class _Codes(NamedTuple):
    """Encodings of all choices of R robots."""

    row: Tensor
    """Robot of each choice, int64 [V]."""
    choice: Tensor
    """Its number among that robot's choices, int64 [V]."""
    each: Tensor
    """[V, width]."""
    pooled: Tensor
    """Mean and maximum over each robot's choices, [R, 2 width]."""


class GoalEncoder(nn.Module):
    """Encodings of each robot's choices, which form a set, as its teammates do.

    After Zaheer et al., "Deep Sets", 2017.

    Args:
        arena: only its field of view matters.
        options: see ``Goals``.
    """

    weights: Tensor
    about_halves: Tensor
    shared_halves: Tensor
    order: Tensor

    def __init__(self, arena: ArenaConfig, options: Goals) -> None:
        super().__init__()
        self.radius, self.width = arena.fov_radius, options.code_width
        self.every, self.after = options.communicate_every, options.communicate_after
        width, pair = options.code_width, options.pair_width
        self.pair = _layers(_PAIR, pair, pair)
        self.frontier = _layers(_FRONTIER + 2 * pair + _CONTEXT, width)
        self.mate = _layers(_MATE + _CONTEXT, width)
        self.still = _layers(_STILL + _CONTEXT, width)
        self.code = _layers(width, width)
        # saved with the policy: its prior does not follow later changes of the planner
        self.register_buffer("weights", GoalWeights().as_tensor().to(torch.get_default_dtype()))
        for name, numbers in _BUFFERS.items():
            self.register_buffer(name, torch.tensor(numbers), persistent=False)

    def forward(self, candidates: Candidates) -> tuple[_Scaled, _Codes]:
        """The features and encodings of R robots, whose candidates have shapes [R, ...]."""
        scaled = self.scale(candidates)
        robots = scaled.mate.shape[-2]
        row, index = scaled.valid.nonzero(as_tuple=True)
        first = torch.cat(
            (
                self._frontiers(scaled, row, index),
                self._of_kind(self.mate, scaled.mate, scaled, row, index - MAX_FRONTIERS),
                self._of_kind(
                    self.still, scaled.still, scaled, row, index - MAX_FRONTIERS - robots
                ),
            )
        )
        order = torch.cat(
            [
                ((index >= low) & (index < high)).nonzero().squeeze(-1)
                for low, high in (
                    (0, MAX_FRONTIERS),
                    (MAX_FRONTIERS, MAX_FRONTIERS + robots),
                    (MAX_FRONTIERS + robots, MAX_FRONTIERS + robots + 2),
                )
            ]
        )
        each = self.code(first)
        row, index = row[order], index[order]
        shape = (len(scaled.valid), self.width)
        number = scaled.valid.sum(-1, keepdim=True)
        total = each.new_zeros(shape).index_add(0, row, each)
        most = each.new_zeros(shape).scatter_reduce(
            0, row.unsqueeze(-1).expand_as(each), each, "amax", include_self=True
        )
        return scaled, _Codes(row, index, each, torch.cat((total / number, most), -1))

    def _frontiers(self, scaled: _Scaled, row: Tensor, index: Tensor) -> Tensor:
        """First encodings of the choices that are frontiers."""
        mine = index < MAX_FRONTIERS
        row, index = row[mine], index[mine]
        known = scaled.known_mate[row].unsqueeze(-1)
        pair = self.pair(scaled.pair[row, index]) * known
        pooled = (pair.sum(-2) / known.sum(-2).clamp_min(1), pair.amax(-2))
        return self.frontier(
            torch.cat((scaled.frontier[row, index], *pooled, scaled.context[row]), -1)
        )

    @staticmethod
    def _of_kind(
        layers: nn.Module, features: Tensor, scaled: _Scaled, row: Tensor, index: Tensor
    ) -> Tensor:
        """First encodings of the choices of another kind, which begins at index 0."""
        mine = (index >= 0) & (index < features.shape[-2])
        row, index = row[mine], index[mine]
        return layers(torch.cat((features[row, index], scaled.context[row]), -1))

    def scale(self, candidates: Candidates) -> _Scaled:
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
        return _Scaled(
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
        """``_Scaled.frontier``."""
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
        """``_Scaled.pair``."""
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
        """``_Scaled.mate``."""
        of_walk = torch.stack((share(walk, 8), 1 / walk.clamp_min(1)), -1)
        return torch.cat((of_walk, about), -1)

    @staticmethod
    def _stills(mates: dict[str, Tensor], linked: Tensor, due: Tensor) -> Tensor:
        """``_Scaled.still``."""
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
        stay = (*[zero] * (_STILL - 1), one)
        return torch.stack((*talk, *stay), -1).unflatten(-1, (2, _STILL))

    @staticmethod
    def _context(
        own: dict[str, Tensor], linked: Tensor, filled: Tensor, unshared: Tensor, nearest: Tensor
    ) -> Tensor:
        """``_Scaled.context``."""
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
        """``_Scaled.prior``."""
        best = goals.amax(-1, keepdim=True)
        talk = torch.where(due, EXCHANGE_DUE, EXCHANGE_EARLY).unsqueeze(-1).to(goals)
        return torch.cat((goals - best, talk, torch.zeros_like(best)), -1)


class GoalActor(nn.Module):
    """Logits [*B, 24 + N + 2] of one robot's choices (``planners.goal_moves.follow``).

    They start as a linear utility, times ``options.prior``, which training refines.

    Args:
        arena: only its field of view matters.
        options: see ``Goals``.
    """

    inputs = Candidates._fields
    chooses = Goals.chooses

    def __init__(self, arena: ArenaConfig, options: Goals) -> None:
        super().__init__()
        self.encoder = GoalEncoder(arena, options)
        width = options.code_width
        score = nn.Sequential(nn.Linear(3 * width, width), nn.ReLU(), nn.Linear(width, 1))
        self.score = initialize(score, ACTOR_GAIN)
        self.prior = nn.Parameter(torch.tensor(options.prior))

    def forward(self, *candidates: Tensor) -> Tensor:
        """Logits [*B, 24 + N + 2] of candidates [*B, ...]."""
        batch = candidates[-1].shape[:-1]
        rows = Candidates(*(x.reshape(-1, *x.shape[len(batch) :]) for x in candidates))
        scaled, codes = self.encoder(rows)
        read = torch.cat((codes.each, codes.pooled[codes.row]), -1)
        prior = scaled.prior[codes.row, codes.choice]
        each = self.score(read).squeeze(-1).float() + self.prior * prior
        logits = torch.full_like(scaled.prior, FORBIDDEN_LOGIT).index_put(
            (codes.row, codes.choice), each.to(scaled.prior.dtype)
        )
        return logits.view(*batch, -1)


class GoalCritic(nn.Module):
    """Value [*B, 1] of the choices of all robots, or of one robot's.

    Args:
        arena: only its field of view matters.
        options: see ``Goals``.
        robot: reads only this robot's; None: those of all.
    """

    def __init__(self, arena: ArenaConfig, options: Goals, robot: int | None) -> None:
        super().__init__()
        self.robot = robot
        self.encoder = GoalEncoder(arena, options)
        inputs = 2 * (2 * options.code_width + _CONTEXT)
        layers = nn.Sequential(nn.Linear(inputs, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU())
        self.layers = initialize(layers.append(nn.Linear(64, 1)), CRITIC_GAIN)

    def forward(self, *candidates: Tensor) -> Tensor:
        """Value [*B, 1] of candidates [*B, N, ...]."""
        if self.robot is not None:
            dims = (2, 3, 2, 1)
            candidates = tuple(
                x.narrow(-1 - d, self.robot, 1) for x, d in zip(candidates, dims, strict=True)
            )
        batch = candidates[-1].shape[:-1]
        rows = Candidates(*(x.reshape(-1, *x.shape[len(batch) :]) for x in candidates))
        scaled, codes = self.encoder(rows)
        robots = torch.cat((codes.pooled, scaled.context), -1)
        real = rows.context[:, CONTEXT_COLUMNS.index("robots"), None] > 0  # not padding
        robots = (robots * real).view(*batch, -1)
        number = real.view(*batch, 1).sum(-2)
        summary = (robots.sum(-2) / number, robots.amax(-2))
        return self.layers(torch.cat(summary, -1)).float()


def _layers(*widths: int) -> nn.Sequential:
    """Linear layers, each with a ReLU."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Linear(inputs, outputs), nn.ReLU()]
    return initialize(nn.Sequential(*layers), math.sqrt(2))

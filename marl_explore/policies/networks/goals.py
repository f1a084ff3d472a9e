"""An actor that scores candidate goals: where to go, and whether to communicate now."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, replace
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
    WEIGHTS,
    GoalWeights,
    cells_within,
    frontier_utility,
    mate_utility,
    overdue,
)
from marl_explore.policies.networks.base import Network
from marl_explore.policies.networks.layers import ACTOR_GAIN, CRITIC_GAIN, initialize
from marl_explore.transforms.goals import CONTEXT_COLUMNS, MATE_COLUMNS, Candidates

EXCHANGE_DUE, EXCHANGE_EARLY = 0.5, -0.4
"""Prior of communicating, relative to the best goal: when it is overdue, and before."""
_FRONTIER, _PAIR, _MATE, _STILL, _CONTEXT = 18, 8, 5, 8, 10
"""Numbers of features of a candidate frontier, of a teammate beside it, of a teammate as a goal, of
staying or communicating, and of the robot itself."""


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
        self.register_buffer("weights", torch.tensor(astuple(WEIGHTS)))

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
        at = _columns(candidates.frontiers, GOAL_COLUMNS)
        mate = _columns(candidates.mates, MATE_COLUMNS)
        own = _columns(candidates.context, CONTEXT_COLUMNS)
        weights = GoalWeights(*self.weights.unbind())
        utility = frontier_utility(candidates, self.radius, weights)
        visit = mate_utility(candidates, weights)
        due = overdue(candidates, weights)
        filled = at["moves"] > 0
        moves = at["moves"].clamp_min(1)
        nearest = moves.masked_fill(~filled, torch.inf).amin(-1, keepdim=True)
        length, knows = candidates.rivals.unbind(-1)
        known = mate["seen"] > 0
        nearer = (length < moves.unsqueeze(-1)) & known.unsqueeze(-2)
        linked = mate["linked"]
        frontier = torch.stack(
            (
                _share(moves, 8),
                1 / moves,
                torch.where(filled, nearest / moves, 0),
                at["near_gain"] / cells_within(self.radius),
                at["middle_gain"] / cells_within(2 * self.radius),
                at["far_gain"] / cells_within(4 * self.radius),
                _share(at["merged_cells"], 4),
                ((at["from_last_goal"] >= 0) & (at["from_last_goal"] <= self.radius)).to(dtype),
                _share(at["from_last_goal"].clamp_min(0), 4),
                (at["turn"] * (math.pi / 4)).cos() * (at["turn"] >= 0),
                _share(at["pocket"], 12),
                (at["pocket"] <= 4).to(dtype),
                _share(at["isolation"], 6),
                1 - (nearer * linked.unsqueeze(-2)).amax(-1),
                at["move_gain"] / cells_within(self.radius),
                at["move_allowed"],
                _share(nearer.sum(-1).to(dtype), 3),
                utility.clamp(-3, 3),
            ),
            -1,
        )
        age, unshared, since = mate["age"], mate["unshared"], mate["since"]
        about = (linked, _share(age, 16), _share(unshared, 64), _share(since, 8))
        behind = length - moves.unsqueeze(-1)
        pair = torch.stack(
            (
                *(entry.unsqueeze(-2).expand_as(length) for entry in about),
                (behind / 8).clamp(-1, 1),
                4 / (4 + length.clamp_min(0)),
                knows,
                ((behind - age.unsqueeze(-2)) / 16).clamp(-1, 1),
            ),
            -1,
        )
        walk = mate["moves"]
        to_mate = torch.stack((_share(walk, 8), 1 / walk.clamp_min(1), *about[1:]), -1)
        number = linked.sum(-1)
        waiting = (
            _share((since * linked).amax(-1), 8),
            _share((unshared * linked).sum(-1), 64),
            _share(number, 3),
            _share(mate["square_distance"].amax(-1).sqrt(), 6),
            due.to(dtype),
            mate["waited"].amax(-1),
        )
        talk = torch.stack((torch.ones_like(number), *waiting, torch.zeros_like(number)), -1)
        stay = torch.nn.functional.one_hot(torch.full_like(number, _STILL - 1).long(), _STILL)
        close = 4 / (4 + nearest.squeeze(-1))
        context = torch.stack(
            (
                _share(own["step"], 64),
                filled.sum(-1) / MAX_FRONTIERS,
                own["known_cells"] / own["cells"].clamp_min(1),
                _share(number, 3),
                own["robots"] / 8,
                filled.any(-1).to(dtype),
                own["all_covered"],
                own["refused"],
                _share(unshared, 64).sum(-1) / (own["robots"] - 1).clamp_min(1),
                close,
            ),
            -1,
        )
        goals = torch.cat((utility, visit), -1)
        possible = torch.cat((filled, visit > NOT_CHOSEN), -1)
        on_time = (own["step"] % self.every == 0) & ((since * linked).amax(-1) >= self.after)
        nowhere = ~possible.any(-1)
        talks = (own["may_communicate"] > 0) & (
            on_time | due | (nowhere & (own["all_covered"] > 0))
        )
        stays = nowhere & ~talks
        valid = torch.cat((possible, talks.unsqueeze(-1), stays.unsqueeze(-1)), -1)
        best = goals.amax(-1, keepdim=True)
        prior = torch.cat(
            (
                goals - best,
                torch.where(due, EXCHANGE_DUE, EXCHANGE_EARLY).unsqueeze(-1).to(dtype),
                torch.zeros_like(best),
            ),
            -1,
        )
        return _Scaled(
            frontier,
            pair,
            known,
            to_mate,
            torch.stack((talk, stay.to(dtype)), -2),
            context,
            valid,
            prior,
        )


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


def _columns(table: Tensor, names: tuple[str, ...]) -> dict[str, Tensor]:
    return dict(zip(names, table.unbind(-1), strict=True))


def _share(number: Tensor, half: float) -> Tensor:
    """n / (n + half), which resolves numbers around ``half`` best."""
    return number / (number + half)

"""An actor that scores candidate goals: where to go, and whether to communicate now."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.checks import require_integer, require_positive
from marl_explore.config.constants import CONTEXT_COLUMNS, FORBIDDEN_LOGIT, MAX_FRONTIERS
from marl_explore.config.fields import check_types
from marl_explore.config.goals import (
    CONTEXT_SIZE,
    FRONTIER_SIZE,
    MATE_SIZE,
    PAIR_SIZE,
    SENSOR,
    STILL_SIZE,
)
from marl_explore.planners.goal_moves import still_choices
from marl_explore.policies.networks.base import Network
from marl_explore.policies.networks.goal_features import FeatureScaling, GoalFeatures
from marl_explore.policies.networks.layers import ACTOR_GAIN, CRITIC_GAIN, initialize, relu
from marl_explore.transforms.goals import Candidates


@dataclass(frozen=True)
class Goals(Network):
    """One actor for any team in any arena that chooses among candidate goals (docs/goals.md)."""

    code_width: int = 48
    """Width of the encoding of a candidate."""
    pair_width: int = 16
    """Width of the encoding of a candidate and a teammate."""
    prior: float = 8.0
    """Initial weight of the linear utility (``planners.goal_utility``) in the logits."""
    refinement: float = 4.0
    """How far the network can move a logit relative to that of the best choice by the utility: in
    arenas unlike those of training it cannot overrule clear cases."""
    home_cells: int = 144
    """Cells of the largest arenas of training; in an arena of more cells, C, the utility counts
    C / ``home_cells`` times: it decides, and samples are nearer to the best choice."""
    communicate_every: int = 3
    """Robots may communicate every so many steps of a shared clock, besides when it is overdue."""
    communicate_after: int = 4
    """Minimum steps since the last exchange with a linked robot before doing so."""
    reads_sensor: bool = False
    """Whether a robot also reads the size of its own sensor: which type it is, in mixed teams."""

    name = "goals"
    features = Candidates._fields
    any_team = True
    any_sensor = True
    sees = "own map, positions of robots in range and where it saw them last, what was exchanged"
    chooses = "goals"
    exported_as = "goals"

    def __post_init__(self) -> None:
        """Check the options."""
        check_types(self)
        for option in ("code_width", "pair_width", "communicate_every", "home_cells"):
            require_integer(option, getattr(self, option), 1)
        require_integer("communicate_after", self.communicate_after, 0)
        require_positive("refinement", self.refinement)

    @property
    def layout(self) -> Goals:
        """The network without the options that do not affect weights' shapes."""
        return replace(
            self,
            communicate_every=1,
            communicate_after=0,
            prior=0.0,
            refinement=1.0,
            home_cells=1,
        )

    @property
    def context_size(self) -> int:
        """Numbers of features of a robot itself."""
        return CONTEXT_SIZE + len(SENSOR) * self.reads_sensor

    def make_actor(self, arena: ArenaConfig) -> GoalActor:
        """As ``Network.make_actor``."""
        return GoalActor(self)

    def make_observation_critic(self, arena: ArenaConfig, robot: int | None) -> GoalCritic:
        """As ``Network.make_observation_critic``."""
        return GoalCritic(self, robot)


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
        options: see ``Goals``.
    """

    def __init__(self, options: Goals) -> None:
        super().__init__()
        self.width = options.code_width
        self.features = FeatureScaling(
            options.communicate_every, options.communicate_after, options.reads_sensor
        )
        width, pair, own = options.code_width, options.pair_width, options.context_size
        self.pair = _layers(PAIR_SIZE, pair, pair)
        self.frontier = _layers(FRONTIER_SIZE + 2 * pair + own, width)
        self.mate = _layers(MATE_SIZE + own, width)
        self.still = _layers(STILL_SIZE + own, width)
        self.code = _layers(width, width)

    def forward(self, candidates: Candidates) -> tuple[GoalFeatures, _Codes]:
        """The features and encodings of R robots, whose candidates have shapes [R, ...]."""
        scaled = self.features(candidates)
        row, choice = scaled.valid.nonzero(as_tuple=True)
        talk, _ = still_choices(scaled.mate.shape[-2])
        kinds = (0, MAX_FRONTIERS, talk, scaled.valid.shape[-1])
        order = [
            ((choice >= low) & (choice < high)).nonzero().squeeze(-1)
            for low, high in pairwise(kinds)
        ]
        mates, stills = (
            (row[these], choice[these] - low)
            for these, low in zip(order[1:], kinds[1:], strict=False)
        )
        first = torch.cat(
            (
                self.of_frontiers(scaled),
                self._of_kind(self.mate, scaled.mate, scaled.context, *mates),
                self._of_kind(self.still, scaled.still, scaled.context, *stills),
            )
        )
        each = self.code(first)
        sorted_by_kind = torch.cat(order)
        row, choice = row[sorted_by_kind], choice[sorted_by_kind]
        shape = (len(scaled.valid), self.width)
        number = scaled.valid.sum(-1, keepdim=True)
        total = each.new_zeros(shape).index_add(0, row, each)
        most = each.new_zeros(shape).scatter_reduce(
            0, row.unsqueeze(-1).expand_as(each), each, "amax", include_self=True
        )
        return scaled, _Codes(row, choice, each, torch.cat((total / number, most), -1))

    def of_frontiers(self, scaled: GoalFeatures) -> Tensor:
        """First encodings of the choices that are frontiers."""
        known = scaled.known_mate.unsqueeze(-1)
        pair = self.pair(scaled.pair) * known
        pooled = (pair.sum(-2) / known.sum(-2).clamp_min(1), pair.amax(-2))
        context = scaled.context.index_select(0, scaled.row)
        return self.frontier(torch.cat((scaled.frontier, *pooled, context), -1))

    @staticmethod
    def _of_kind(
        layers: nn.Module, features: Tensor, context: Tensor, row: Tensor, index: Tensor
    ) -> Tensor:
        """First encodings of the choices of another kind, whose numbers begin at 0."""
        return layers(torch.cat((features[row, index], context[row]), -1))


class GoalActor(nn.Module):
    """Logits [*B, 24 + N + 2] of one robot's choices (``planners.goal_moves.follow``).

    They start as a linear utility, times ``options.prior``, which training refines.

    Args:
        options: see ``Goals``.
    """

    inputs = Candidates._fields
    chooses = Goals.chooses

    def __init__(self, options: Goals) -> None:
        super().__init__()
        self.encoder = GoalEncoder(options)
        width = options.code_width
        score = nn.Sequential(nn.Linear(3 * width, width), relu(), nn.Linear(width, 1))
        self.score = initialize(score, ACTOR_GAIN)
        self.prior = nn.Parameter(torch.tensor(options.prior))
        self.refinement, self.home_cells = options.refinement, options.home_cells

    def forward(self, *candidates: Tensor) -> Tensor:
        """Logits [*B, 24 + N + 2] of candidates [*B, ...]."""
        batch = candidates[-1].shape[:-1]
        rows = Candidates(*(x.reshape(-1, *x.shape[len(batch) :]) for x in candidates))
        scaled, codes = self.encoder(rows)
        score = torch.zeros_like(scaled.prior).index_put(
            (codes.row, codes.choice), self._scores(codes).to(scaled.prior.dtype)
        )
        logits = self.refine(score, scaled, rows.context)
        logits = logits.masked_fill(~scaled.valid, FORBIDDEN_LOGIT)
        return logits.view(*batch, -1)

    def _scores(self, codes: _Codes) -> Tensor:
        """Scores of all choices [V]: ``score`` of each encoding beside those of its robot."""
        first, *others = self.score
        weight, bias = first.get_parameter("weight"), first.get_parameter("bias")
        own, common = weight.split((codes.each.shape[-1], codes.pooled.shape[-1]), -1)
        # what all choices of a robot have in common is multiplied once
        shared = nn.functional.linear(codes.pooled, common, bias)
        value = nn.functional.linear(codes.each, own) + shared.index_select(0, codes.row)
        for layer in others:
            value = layer(value)
        return value.squeeze(-1)

    def refine(self, score: Tensor, scaled: GoalFeatures, context: Tensor) -> Tensor:
        """Logits from the network's scores and the prior, [R, 24 + N + 2]; any of no choices.

        Args:
            score: the network's scores [R, 24 + N + 2].
            scaled: the features of R robots.
            context: ``Candidates.context`` of them.
        """
        cells = context[:, CONTEXT_COLUMNS.index("cells"), None].to(score)
        homes = (cells / self.home_cells).clamp_min(1)
        allowed = scaled.prior.masked_fill(~scaled.valid, -torch.inf)
        apart = score - score.gather(-1, allowed.argmax(-1, keepdim=True))
        refined = self.refinement * (apart / self.refinement).tanh()
        return refined + homes * self.prior * scaled.prior


class GoalCritic(nn.Module):
    """Value [*B, 1] of the choices of all robots, or of one robot's.

    Args:
        options: see ``Goals``.
        robot: reads only this robot's; None: those of all.
    """

    def __init__(self, options: Goals, robot: int | None) -> None:
        super().__init__()
        self.robot = robot
        self.encoder = GoalEncoder(options)
        inputs = 2 * (2 * options.code_width + options.context_size)
        layers = nn.Sequential(nn.Linear(inputs, 64), relu(), nn.Linear(64, 64), relu())
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
        layers += [nn.Linear(inputs, outputs), relu()]
    return initialize(nn.Sequential(*layers), math.sqrt(2))

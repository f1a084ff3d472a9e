"""A linear utility of candidate goals, and the planner that goes to the best one."""

from __future__ import annotations

import math
from dataclasses import astuple, fields

import torch
from tensordict import TensorDictBase
from torch import Tensor

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.constants import (
    CONTEXT_COLUMNS,
    GAIN_SQUARES,
    GOAL_COLUMNS,
    MATE_COLUMNS,
)
from marl_explore.config.goals import HALVES, LATEST_START, POCKET_FADE, GoalWeights
from marl_explore.config.shapes import Sight
from marl_explore.core.grid import COMMUNICATE
from marl_explore.core.motion import give_way
from marl_explore.planners.base import Planner
from marl_explore.planners.communication import never, others_linked
from marl_explore.planners.goal_moves import follow, goes_to_and_fro, still_choices
from marl_explore.transforms.goals import Candidates, find_candidates
from marl_explore.transforms.memory import RememberTeam

NOT_CHOSEN = -1e9
"""Utility of rows without a candidate."""
_INDEX = {field.name: number for number, field in enumerate(fields(GoalWeights))}
_OF_PLACES = _INDEX["move_gain"] + 1
"""The first weights belong to what ``place_terms`` says of a place."""


def weight_tensor(weights: GoalWeights) -> Tensor:
    """The weights in their order, float32 [22]."""
    return torch.tensor(astuple(weights), dtype=torch.float32)  # whatever torch's default


def frontier_utility(candidates: Candidates, terms: Tensor, weights: Tensor) -> Tensor:
    """Utility of every candidate frontier, float32 [*B, 24]; NOT_CHOSEN in empty rows.

    Args:
        candidates: of robots [*B], integers or floats.
        terms: ``place_terms`` of them.
        weights: ``weight_tensor`` [22], or others for each robot [*B, 22].
    """
    frontiers, rivals, mates, _ = (_real(entry) for entry in candidates)
    moves = frontiers[..., GOAL_COLUMNS.index("moves")]
    of_places = (terms @ weights[..., :_OF_PLACES, None]).squeeze(-1)
    value = of_places - _rivalry(moves, rivals, mates, weights)
    return value.masked_fill(moves == 0, NOT_CHOSEN)


def place_terms(candidates: Candidates) -> Tensor:
    """What the first eleven weights multiply, float32 [*B, 24, 11]."""
    at = dict(zip(GOAL_COLUMNS, _real(candidates.frontiers).unbind(-1), strict=True))
    moves, turn, last = at["moves"].clamp_min(1), at["turn"], at["from_last_goal"]
    radius, near = (
        _real(candidates.context)[..., CONTEXT_COLUMNS.index(name), None]
        for name in ("radius", "shape_cells")
    )
    middle, far = ((2 * factor * radius + 1).square() for factor in GAIN_SQUARES[1:])
    return torch.stack(
        (
            -moves,
            -moves.log(),
            at["near_gain"] / near,
            at["middle_gain"] / middle,
            at["far_gain"] / far,
            share(at["merged_cells"], HALVES["merged_cells"]),
            (-at["pocket"] / POCKET_FADE).exp(),
            share(at["isolation"], HALVES["isolation"]),
            ((last >= 0) & (last <= radius)).to(moves),
            (turn * (math.pi / 4)).cos() * (turn >= 0),
            at["move_gain"] / near,
        ),
        -1,
    )


def _rivalry(moves: Tensor, rivals: Tensor, mates: Tensor, weights: Tensor) -> Tensor:
    """Price of teammates that are nearer, summed over them, [*B, 24]."""
    linked, scale, knowing, unknowing, arrived, memory = (
        weight[..., None, None] for weight in weights[..., _OF_PLACES : _OF_PLACES + 6].unbind(-1)
    )
    length, knows = rivals.unbind(-1)
    seen, near, age = (
        mates[..., MATE_COLUMNS.index(name)].unsqueeze(-2) for name in ("seen", "linked", "age")
    )
    nearer = ((moves.unsqueeze(-1) - length) / scale).sigmoid()
    lost = torch.lerp(unknowing, knowing, knows) * nearer + arrived * ((length <= age) * knows)
    return (seen * torch.where(near > 0, linked * nearer, lost * (-age / memory).exp())).sum(-1)


def mate_utility(candidates: Candidates, weights: Tensor) -> Tensor:
    """Utility of going to every teammate, float32 [*B, N]; NOT_CHOSEN where that is no choice.

    It is one while all frontiers are covered, and the teammate is not linked but was seen.
    """
    mates, context = _real(candidates.mates), candidates.context
    moves, age, unshared, linked = (
        mates[..., MATE_COLUMNS.index(name)] for name in ("moves", "age", "unshared", "linked")
    )
    of_moves, of_age, of_unshared = (
        weights[..., _INDEX[f"mate_{name}"], None] for name in ("moves", "age", "unshared")
    )
    known = of_age * share(age, HALVES["age of a visit"])
    value = known + of_unshared * share(unshared, HALVES["unshared"]) - of_moves * moves
    covered = context[..., CONTEXT_COLUMNS.index("all_covered"), None] > 0
    return value.masked_fill(~(covered & (linked == 0) & (moves > 0)), NOT_CHOSEN)


def overdue(candidates: Candidates, weights: Tensor) -> Tensor:
    """Whether a linked teammate has waited for an exchange for long enough, bool [*B]."""
    now, cells, robots = (
        candidates.context[..., CONTEXT_COLUMNS.index(name)] for name in ("step", "cells", "robots")
    )
    linked, since = (
        candidates.mates[..., MATE_COLUMNS.index(name)] for name in ("linked", "since")
    )
    timer, start = weights[..., _INDEX["timer"], None], weights[..., _INDEX["start"]]
    begin = ((cells / robots.clamp_min(1)).sqrt() * start).clamp_max(LATEST_START).round()
    return (now >= begin) & ((linked > 0) & (since >= timer.round())).any(-1)


def share(number: Tensor, half: float | Tensor) -> Tensor:
    """n / (n + half), which resolves numbers around ``half`` best."""
    return number / (number + half)


def _real(entries: Tensor) -> Tensor:
    return entries if entries.is_floating_point() else entries.float()


class GoalUtility(Planner):
    """Every robot goes to the candidate goal with the largest utility.

    Args:
        sight: of the robots (``ArenaConfig.sight``).
        weights: of the utility, also as a tensor [22], or others for each robot [*B, N, 22];
            None: those that a search found (docs/planners.md).
        config: as for ``Planner``.
    """

    sees = "own map, positions of robots in range and where it saw them last, what was exchanged"
    in_keys = [*Planner.in_keys, ("agents", "observation", "fov")]  # noqa: RUF012

    def __init__(
        self,
        sight: Sight,
        weights: GoalWeights | Tensor | None = None,
        config: ArenaConfig | None = None,
    ) -> None:
        super().__init__(never, config)  # exchanges are part of the plan
        weights = GoalWeights() if weights is None else weights
        self.sight = sight
        self.weights = weight_tensor(weights) if isinstance(weights, GoalWeights) else weights
        period = 1 if config is None else config.move_period
        self._memory = RememberTeam(sight=sight, move_period=period)

    def plan(self, tensordict: TensorDictBase) -> Tensor:
        """First moves to the goals, or COMMUNICATE, int64 [*B, N]."""
        known = self._memory(tensordict.select(*self.in_keys))
        found = find_candidates(known, self.sight)
        weights = self.weights.to(found.frontiers.device)
        terms = place_terms(found)
        utilities = frontier_utility(found, terms, weights), mate_utility(found, weights)
        best, choice = torch.cat(utilities, -1).max(-1)
        talk, stay = still_choices(found.mates.shape[-2])
        covered = found.context[..., CONTEXT_COLUMNS.index("all_covered")] > 0
        waits = torch.where(covered & others_linked(tensordict).any(-1), talk, stay)
        choice = torch.where(best <= NOT_CHOSEN, waits, choice)
        move = follow(known, found, choice)
        yields = goes_to_and_fro(known, move)
        if yields.any():
            move = give_way(move, tensordict.get(("agents", "action_mask")), yields)
        return move.masked_fill(overdue(found, weights), COMMUNICATE)

"""A linear utility of candidate goals, and the planner that goes to the best one."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from marl_explore.config.constants import GOAL_COLUMNS
from marl_explore.planners.base import Planner
from marl_explore.planners.communication import others_linked
from marl_explore.planners.goal_moves import follow, still_choices
from marl_explore.transforms.goals import CONTEXT_COLUMNS, MATE_COLUMNS, Candidates, find_candidates
from marl_explore.transforms.memory import RememberTeam

NOT_CHOSEN = -1e9
"""Utility of rows without a candidate."""


Weight = float | Tensor
"""A number, or one per robot, [*B, 1]."""


@dataclass(frozen=True)
class GoalWeights:
    """Weights and scales of the utility; all shares are at most 1 (docs/planners.md)."""

    moves: Weight = 0.092
    """Price of a move."""
    log_moves: Weight = -0.06
    """Price of the logarithm of the moves."""
    near_gain: Weight = 2.015
    """Share of unseen cells in the field of view there."""
    middle_gain: Weight = -1.03
    """The same of a square of twice the radius."""
    far_gain: Weight = -1.155
    """The same of a square of four times the radius."""
    merged_cells: Weight = 0.581
    """n / (n + 4) for the n frontier cells that it stands for."""
    pocket: Weight = 0.66
    """exp(-n / 8) for an unseen region of n cells."""
    isolation: Weight = 0.555
    """n / (n + 6) for the distance n to the next candidate."""
    last_goal: Weight = 0.109
    """Whether it is within the field of view of the last goal."""
    ahead: Weight = -0.063
    """Cosine of the turn."""
    move_gain: Weight = 0.89
    """Share of unseen cells in the field of view after the first move."""
    linked_rival: Weight = 2.544
    """Price of linked teammates that are nearer."""
    rival_scale: Weight = 2.346
    """Difference of moves to which being nearer is resolved."""
    knowing_rival: Weight = 1.924
    """Price of unlinked teammates that are nearer and know the place."""
    unknowing_rival: Weight = 0.49
    """Price of unlinked teammates that are nearer and may not know the place."""
    arrived_rival: Weight = 0.126
    """Price of unlinked teammates that know the place and may have got there since."""
    memory: Weight = 99.697
    """Time in which sightings fade (steps)."""
    mate_moves: Weight = 0.025
    """Price of a move to a teammate, when all frontiers are covered."""
    mate_age: Weight = -0.934
    """n / (n + 32) for n steps since it was seen."""
    mate_unshared: Weight = -0.579
    """n / (n + 64) for n unshared cells."""
    timer: Weight = 8.203
    """Steps since the last exchange after which robots communicate."""
    start: Weight = 1.915
    """First time of exchanges, in sqrt(cells / robots) steps, at most 14 steps."""


WEIGHTS = GoalWeights()
"""Found by search on training arenas (docs/planners.md)."""


def frontier_utility(candidates: Candidates, radius: int, weights: GoalWeights) -> Tensor:
    """Utility of every candidate frontier, float32 [*B, 24]; NOT_CHOSEN in empty rows.

    Args:
        candidates: of robots [*B], without further dimensions before their own.
        radius: half side of the field of view (cells).
        weights: numbers, or tensors [*B, 1].
    """
    column = dict(zip(GOAL_COLUMNS, _real(candidates.frontiers).unbind(-1), strict=True))
    mate = dict(zip(MATE_COLUMNS, _real(candidates.mates).unsqueeze(-3).unbind(-1), strict=True))
    w, moves = weights, column["moves"].clamp_min(1)
    heading = column["turn"] >= 0
    value = (
        -w.moves * moves
        - w.log_moves * moves.log()
        + w.near_gain * column["near_gain"] / cells_within(radius)
        + w.middle_gain * column["middle_gain"] / cells_within(2 * radius)
        + w.far_gain * column["far_gain"] / cells_within(4 * radius)
        + w.merged_cells * (column["merged_cells"] / (column["merged_cells"] + 4))
        + w.pocket * (-column["pocket"] / 8).exp()
        + w.isolation * (column["isolation"] / (column["isolation"] + 6))
        + w.last_goal * ((column["from_last_goal"] >= 0) & (column["from_last_goal"] <= radius))
        + w.ahead * (column["turn"] * (math.pi / 4)).cos() * heading
        + w.move_gain * column["move_gain"] / cells_within(radius)
    )
    length, knows = _real(candidates.rivals).unbind(-1)
    value = value - _rivalry(moves, length, knows, mate, w)
    return value.masked_fill(column["moves"] == 0, NOT_CHOSEN)


def _rivalry(
    moves: Tensor, length: Tensor, knows: Tensor, mate: dict[str, Tensor], w: GoalWeights
) -> Tensor:
    """Price of teammates that are nearer, summed over them, [*B, 24]."""

    def wide(weight: Weight) -> Weight:
        return weight.unsqueeze(-1) if isinstance(weight, Tensor) else weight

    nearer = ((moves.unsqueeze(-1) - length) / wide(w.rival_scale)).sigmoid()
    age, linked = mate["age"], mate["linked"]
    fading = (-age / wide(w.memory)).exp()
    arrived = (length <= age) * knows
    price = knows * wide(w.knowing_rival) + (1 - knows) * wide(w.unknowing_rival)
    unlinked = (price * nearer + wide(w.arrived_rival) * arrived) * fading
    each = torch.where(linked > 0, wide(w.linked_rival) * nearer, unlinked)
    return (each * (mate["seen"] > 0)).sum(-1)


def mate_utility(candidates: Candidates, weights: GoalWeights) -> Tensor:
    """Utility of going to every teammate, float32 [*B, N]; NOT_CHOSEN where that is no choice.

    It is one while all frontiers are covered, and the teammate is not linked but was seen.
    """
    mate = dict(zip(MATE_COLUMNS, _real(candidates.mates).unbind(-1), strict=True))
    covered = candidates.context[..., CONTEXT_COLUMNS.index("all_covered")].unsqueeze(-1)
    w = weights
    value = (
        w.mate_age * (mate["age"] / (mate["age"] + 32))
        + w.mate_unshared * (mate["unshared"] / (mate["unshared"] + 64))
        - w.mate_moves * mate["moves"]
    )
    choice = (covered > 0) & (mate["linked"] == 0) & (mate["moves"] > 0)
    return value.masked_fill(~choice, NOT_CHOSEN)


def overdue(candidates: Candidates, weights: GoalWeights) -> Tensor:
    """Whether a linked teammate has waited for an exchange for long enough, bool [*B]."""
    now, cells, robots = (
        candidates.context[..., CONTEXT_COLUMNS.index(name)] for name in ("step", "cells", "robots")
    )
    linked, since = (
        candidates.mates[..., MATE_COLUMNS.index(name)] for name in ("linked", "since")
    )
    start = ((cells / robots.clamp_min(1)).sqrt() * _squeezed(weights.start)).clamp_max(14).round()
    timer = weights.timer.round() if isinstance(weights.timer, Tensor) else round(weights.timer)
    return (now >= start) & ((linked > 0) & (since >= timer)).any(-1)


def _real(entries: Tensor) -> Tensor:
    return entries if entries.is_floating_point() else entries.float()


def _squeezed(weight: Weight) -> Weight:
    """A weight without its last dimension."""
    return weight.squeeze(-1) if isinstance(weight, Tensor) else weight


def cells_within(radius: int) -> int:
    """Cells of a square."""
    return (2 * radius + 1) ** 2


class GoalUtility(Planner):
    """Every robot goes to the candidate goal with the largest utility.

    Args:
        radius: half side of the field of view (cells).
        weights: of the utility.
    """

    sees = "own map, positions of robots in range and where it saw them last, what was exchanged"
    in_keys = [*Planner.in_keys, ("agents", "observation", "fov")]  # noqa: RUF012

    def __init__(self, radius: int, weights: GoalWeights = WEIGHTS) -> None:
        super().__init__(self._exchange)
        self.radius, self.weights = radius, weights
        self._memory = RememberTeam(radius)
        self._overdue = torch.zeros(0, dtype=torch.bool)

    def plan(self, tensordict: TensorDictBase) -> Tensor:
        """First moves to the goals, int64 [*B, N]."""
        known = self._memory(tensordict.select(*self.in_keys))
        found = find_candidates(known)
        frontier = frontier_utility(found, self.radius, self.weights)
        best, choice = torch.cat((frontier, mate_utility(found, self.weights)), -1).max(-1)
        talk, stay = still_choices(found.mates.shape[-2])
        covered = found.context[..., CONTEXT_COLUMNS.index("all_covered")] > 0
        waits = torch.where(covered & others_linked(tensordict).any(-1), talk, stay)
        choice = torch.where(best <= NOT_CHOSEN, waits, choice)
        self._overdue = overdue(found, self.weights)
        return follow(known, found, choice)

    def _exchange(self, tensordict: TensorDictBase) -> Tensor:
        return self._overdue

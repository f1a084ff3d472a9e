"""Candidate goals: names, order and scales of features, and the utility's weights.

For torch and for numpy.
"""

from __future__ import annotations

from dataclasses import dataclass

FRONTIER_SIZE, PAIR_SIZE, MATE_SIZE, STILL_SIZE, CONTEXT_SIZE = 18, 8, 5, 8, 10
"""Numbers of features of a candidate frontier, of a teammate beside it, of a teammate as a goal, of
staying or communicating, and of the robot itself."""
SENSOR = ("radius", "shape_cells")
"""Further features of the robot itself, where actors read its sensor: of ``CONTEXT_COLUMNS``."""
PLACE = (
    *("moves", "1 / moves", "nearest / moves", "near_gain", "middle_gain", "far_gain"),
    *("merged_cells", "last_goal", "from_last_goal", "ahead", "pocket", "small pocket"),
    *("isolation", "nearest of all", "move_gain", "allowed", "rivals", "utility"),
)
"""Features of a candidate frontier in their order."""
COMPUTED = (
    *("moves", "from_last_goal", "pocket", "1 / moves"),
    *("-moves", "-log", "near_gain", "middle_gain", "far_gain", "merged_cells", "-exp"),
    *("isolation", "last_goal", "ahead", "move_gain", "allowed"),
    *("nearest / moves", "small pocket", "nearest of all", "rivals", "utility"),
)
"""The order in which they are computed, with further terms of the utility."""
TERMS = slice(COMPUTED.index("-moves"), COMPUTED.index("move_gain") + 1)
"""Those that the utility weighs, in the order of its weights."""

HALVES = {
    "moves": 8.0,
    "from_last_goal": 4.0,
    "pocket": 12.0,
    "merged_cells": 4.0,
    "isolation": 6.0,
    "rivals": 3.0,
    "age": 16.0,
    "unshared": 64.0,
    "since": 8.0,
    "linked": 3.0,
    "distance": 6.0,
    "time": 0.5,  # steps of all robots per cell: alike in arenas and teams of any size
    "age of a visit": 32.0,
    "radius": 4.0,
    "shape_cells": 64.0,
}
"""The number h for which n / (n + h) stands for a number n: h is half of the way."""
POCKET_FADE = 8.0
"""Unseen cells of a region of which e times more have 1 / e of its urgency."""
SMALL_POCKET = 4
"""Cells of a region that counts as small."""
NEAR_MOVES = 4.0
"""m / (m + n) stands for n moves that matter when they are few."""
BEHIND_MOVES, LATE_MOVES = 8.0, 16.0
"""Moves by which a teammate is behind, and behind since it was seen, that stand for all more."""
MOST_UTILITY = 3.0
"""Utilities beyond it, on either side, are alike as features."""
TEAM = 8.0
"""Size of a team whose feature is 1."""
EXCHANGE_DUE, EXCHANGE_EARLY = 0.5, -0.4
"""Prior of communicating, relative to the best goal: when it is overdue, and before."""
LATEST_START = 14
"""Step at which the time of exchanges has begun in every arena."""


@dataclass(frozen=True)
class GoalWeights:
    """Weights and scales of the utility; all shares are at most 1.

    The defaults were found by search on training arenas (docs/planners.md).
    """

    moves: float = 0.092
    """Price of a move."""
    log_moves: float = -0.06
    """Price of the logarithm of the moves."""
    near_gain: float = 2.015
    """Unseen cells that the robot would see there, as a share of its sensor's cells."""
    middle_gain: float = -1.03
    """Share of unseen cells in a square of twice the radius."""
    far_gain: float = -1.155
    """The same of a square of four times the radius."""
    merged_cells: float = 0.581
    """n / (n + 4) for the n frontier cells that it stands for."""
    pocket: float = 0.66
    """exp(-n / 8) for an unseen region of n cells."""
    isolation: float = 0.555
    """n / (n + 6) for the distance n to the next candidate."""
    last_goal: float = 0.109
    """Whether the last goal is at most the radius away."""
    ahead: float = -0.063
    """Cosine of the turn."""
    move_gain: float = 0.89
    """The same as ``near_gain`` after the first move."""
    linked_rival: float = 2.544
    """Price of linked teammates that are nearer."""
    rival_scale: float = 2.346
    """Difference of moves to which being nearer is resolved."""
    knowing_rival: float = 1.924
    """Price of unlinked teammates that are nearer and know the place."""
    unknowing_rival: float = 0.49
    """Price of unlinked teammates that are nearer and may not know the place."""
    arrived_rival: float = 0.126
    """Price of unlinked teammates that know the place and may have got there since."""
    memory: float = 99.697
    """Time in which sightings fade (steps)."""
    mate_moves: float = 0.025
    """Price of a move to a teammate, when all frontiers are covered."""
    mate_age: float = -0.934
    """n / (n + 32) for n steps since it was seen."""
    mate_unshared: float = -0.579
    """n / (n + 64) for n unshared cells."""
    timer: float = 8.203
    """Steps since the last exchange after which robots communicate."""
    start: float = 1.915
    """First time of exchanges, in sqrt(cells / robots) steps, at most 14 steps."""


PATIENCE = 40
"""Steps without growth of its map after which a robot that takes its best goal keeps the last."""
PRIOR = GoalWeights(
    moves=0.125,
    log_moves=-0.129,
    near_gain=1.89,
    middle_gain=-0.902,
    far_gain=-1.058,
    merged_cells=0.508,
    pocket=0.603,
    isolation=0.435,
    last_goal=0.101,
    ahead=-0.068,
    move_gain=0.65,
    linked_rival=2.705,
    rival_scale=2.459,
    knowing_rival=1.758,
    unknowing_rival=0.836,
    arrived_rival=0.355,
    memory=92.282,
    mate_moves=0.01,
    mate_age=-0.89,
    mate_unshared=-0.127,
    timer=6.93,
    start=1.935,
)
"""Those of a longer search, with which actors that choose among goals begin (docs/planners.md)."""

"""Features of candidate goals: names, order and scales, for networks in torch and in numpy."""

from __future__ import annotations

FRONTIER_SIZE, PAIR_SIZE, MATE_SIZE, STILL_SIZE, CONTEXT_SIZE = 18, 8, 5, 8, 10
"""Numbers of features of a candidate frontier, of a teammate beside it, of a teammate as a goal, of
staying or communicating, and of the robot itself."""
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
    "step": 64.0,
    "age of a visit": 32.0,
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

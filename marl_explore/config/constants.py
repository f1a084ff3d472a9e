"""Constants of maps, actions and feature tables, without torch."""

from __future__ import annotations

from typing import Literal, get_args

UNKNOWN, FREE, OCCUPIED = -1, 0, 1
"""Cell values of an occupancy map (int8)."""

COMPASS = ((-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1))
"""(row, column) offsets of N, NE, E, SE, S, SW, W, NW; row 0 is north."""
NUM_DIRECTIONS = len(COMPASS)
STAY, COMMUNICATE = 8, 9
NUM_ACTIONS = 10

Ability = Literal["fov", "fpr", "net", "communication"]
ABILITIES: tuple[Ability, ...] = get_args(Ability)
"""What can be ablated: parts of the observation, and communication."""

FORBIDDEN_LOGIT = -1e4
"""Logit of an action that is never chosen, in every precision."""

NUM_FEATURES = 3
"""Columns of the feature table per direction."""
Normalization = Literal["relative", "proximity", "absolute"]
NORMALIZATIONS: tuple[Normalization | None, ...] = ("relative", "proximity", "absolute", None)

NEVER = 1_000_000
"""Steps since the last merge of two robots that never merged; the counter stops there."""

MAX_FRONTIERS = 24
"""Candidate frontier cells of a robot (docs/goals.md)."""
GOAL_COLUMNS = (
    "row",
    "column",
    "moves",
    "move",
    "merged_cells",
    "near_gain",
    "middle_gain",
    "far_gain",
    "pocket",
    "isolation",
    "move_gain",
    "move_allowed",
    "turn",
    "from_last_goal",
)
"""What is known about each of them."""
MATE_COLUMNS = (
    "seen",
    "linked",
    "age",
    "moves",
    "move",
    "unshared",
    "since",
    "square_distance",
    "waited",
)
"""What is known about each teammate."""
CONTEXT_COLUMNS = (
    "step",
    "known_cells",
    "cells",
    "robots",
    "all_covered",
    "refused",
    "may_communicate",
    "radius",
    "shape_cells",
)
"""What is known about the robot itself."""
GAIN_SQUARES = (1, 2, 4)
"""Radii of the squares in which unseen cells are counted, in radii of the robot's own sensor; the
first is its shape itself."""
LARGE_POCKET = 64
"""Cells from which on the size of an unseen region no longer matters."""
FAR_CELLS = 20
"""Distance from which on other candidates no longer matter (cells)."""
DETOUR_CELLS = 4
"""Added to the straight distance of cells to which no path is known."""
EXCHANGE_TIMER = 6
"""Steps since a merge after which the planners nearest-timer and utility-cost communicate."""
MOVE_COST, RIVAL_REACH = 0.1, 3
"""Of utility-cost: a move's cost in units of a frontier's utility, and the distance up to which a
chosen frontier lowers the utility of others (cells)."""
LONG_AGO = 10_000
"""Steps since a merge that stand for all longer times, and for never."""
NOT_SEEN = -1_000_000
"""Step of the last sighting of a teammate if there was none."""
PATIENCE_STEPS = 8
"""Steps for which a robot leaves cells to those who have seen them while nothing else is left."""

TOLERANCE = 1e-9
"""Tolerance in every comparison of real distances, so that 0.3 / 0.1 counts as 3."""

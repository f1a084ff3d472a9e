"""Columns of a benchmark's table: the measures of the field beside ours."""

from __future__ import annotations

import math

from marl_explore.evaluation.leaderboard.ranking import Row
from marl_explore.evaluation.leaderboard.table import MEANINGS as OURS
from marl_explore.evaluation.leaderboard.table import Columns, plain, with_interval
from marl_explore.utils import tables


def _kilobytes(row: Row) -> str:
    return tables.number(row.measures.get("bytes_until_complete", math.nan) / 1000)


COLUMNS: Columns = {
    "policy": lambda row: row.name,
    "steps to 90 %": plain("steps_to_90"),
    "95 %": plain("steps_to_95"),
    "99 %": plain("steps_to_99"),
    "100 %": with_interval("steps_to_100"),
    "success": plain("complete"),
    "mean way (m)": plain("distance_mean_m"),
    "longest (m)": plain("distance_longest_m"),
    "moves": plain("moves_longest"),
    "sent (kB)": _kilobytes,
    "overlap": plain("overlap"),
    "to best planner": with_interval("difference", sign="+"),
}
MEANINGS = {
    "steps to 90, 95, 99, 100 %": "mean number of steps until the largest map covers that share of "
    "the target cells; if it is not reached, it counts as one more than the budget; in brackets "
    "the 95 % bootstrap interval over seeds and maps",
    "success": "share of the maps that were complete within the budget",
    "mean way, longest": "metres that the robots drove until a map was complete, or the budget was "
    "used up: their mean, and those of the robot that drove farthest",
    "moves": "most moves of a robot until then",
    "sent": "what all communicate actions until then sent: whole maps, two bits per cell",
    **{name: OURS[name] for name in ("overlap", "to best planner", "below the line")},
}
"""The meanings of the columns."""

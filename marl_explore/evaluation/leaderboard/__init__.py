"""The leaderboard: policies on suites, measured, ranked, and written as tables and a report."""

from __future__ import annotations

from marl_explore.evaluation.leaderboard.cells import Cell, make_cells
from marl_explore.evaluation.leaderboard.entries import BOUND, Entry, parse_entries
from marl_explore.evaluation.leaderboard.ranking import Row, rank
from marl_explore.evaluation.leaderboard.report import write_report
from marl_explore.evaluation.leaderboard.table import write_tables

__all__ = [
    "BOUND",
    "Cell",
    "Entry",
    "Row",
    "make_cells",
    "parse_entries",
    "rank",
    "write_report",
    "write_tables",
]

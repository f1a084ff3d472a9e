"""Benchmarks that others can join: one protocol, the field's maps, any policy, a file to send.

The tables come from the cells of a leaderboard; docs/benchmark.md has the rules.
"""

from __future__ import annotations

from marl_explore.evaluation.benchmark.protocol import (
    BENCHMARKS,
    SEED,
    Benchmark,
    Prepared,
    find_benchmark,
)
from marl_explore.evaluation.benchmark.rerun import Repeated, repeated, require_same_maps
from marl_explore.evaluation.benchmark.results import make_results, read_results, write_results
from marl_explore.evaluation.benchmark.table import COLUMNS, MEANINGS

__all__ = [
    "BENCHMARKS",
    "COLUMNS",
    "MEANINGS",
    "SEED",
    "Benchmark",
    "Prepared",
    "Repeated",
    "find_benchmark",
    "make_results",
    "read_results",
    "repeated",
    "require_same_maps",
    "write_results",
]

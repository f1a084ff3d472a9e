"""Interleaved medians: contenders take turns, so that a machine's moods hit all of them."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable

import torch

import marl_explore

TURN_SECONDS = 0.1
"""Least length of a turn: who follows another would else be timed on cold caches."""


def conditions() -> str:
    """What times depend on besides the machine: threads, torch, and whether there are kernels."""
    return f"one thread, torch {torch.__version__}, {marl_explore.backend()}"


def medians(contenders: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Median seconds of one call of each; a turn is as many calls as take TURN_SECONDS."""
    calls = {name: _calls(function) for name, function in contenders.items()}
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(repeats):
        for name, function in contenders.items():
            times[name].append(_seconds(function, calls[name]) / calls[name])
    return {name: statistics.median(values) for name, values in times.items()}


def _calls(function: Callable[[], object]) -> int:
    """How many calls make up a turn; the first one does not count."""
    function()
    return max(1, math.ceil(TURN_SECONDS / _seconds(function, 1)))


def _seconds(function: Callable[[], object], calls: int) -> float:
    start = time.perf_counter()
    for _ in range(calls):
        function()
    return time.perf_counter() - start

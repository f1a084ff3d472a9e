"""Interleaved medians: contenders take turns, so that a machine's moods hit all of them."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Mapping

import torch

import marl_explore

Clock = Callable[[], float]
TURN_SECONDS = 0.1
"""Least length of a turn: who follows another would else be timed on cold caches."""


def conditions() -> str:
    """What times depend on besides the machine: threads, torch, and whether there are kernels."""
    return f"one thread, torch {torch.__version__}, {marl_explore.backend()}"


def medians(
    contenders: Mapping[str, Callable[[], object]],
    repeats: int,
    clock: Clock = time.perf_counter,
) -> dict[str, float]:
    """Median seconds of one call of each; a turn is as many calls as take TURN_SECONDS."""
    calls = {name: _calls(function, clock) for name, function in contenders.items()}
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(repeats):
        for name, function in contenders.items():
            times[name].append(_seconds(function, calls[name], clock) / calls[name])
    return {name: statistics.median(values) for name, values in times.items()}


def _calls(function: Callable[[], object], clock: Clock) -> int:
    """How many calls make up a turn; the first one, which may compile, does not count."""
    function()
    return max(1, math.ceil(TURN_SECONDS / _seconds(function, 1, clock)))


def _seconds(function: Callable[[], object], calls: int, clock: Clock) -> float:
    start = clock()
    for _ in range(calls):
        function()
    return clock() - start

"""The shared clock: when the team's next step begins, by agreement or by wall-clock time."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Protocol

from marl_explore.config.checks import (
    require,
    require_integer,
    require_positive,
    require_time,
)

_PERIODS = 0.01, 86_400.0
"""Shortest and longest period of a tick (seconds)."""


class Clock(Protocol):
    """Tells a robot the current tick."""

    announces: bool
    """Whether robots tell each other that they have finished a tick."""

    def tick(self, now: float) -> int:
        """The tick at a time (seconds); -1 before the first.

        It decreases only when the time is set back; robots then wait for the tick after their own.
        """

    def begins(self, tick: int) -> float | None:
        """When a tick begins (seconds); None if that depends on the robots."""

    def report(self, robot: int, tick: int, now: float) -> None:
        """Report that a robot has finished a tick."""

    @property
    def waited_for(self) -> set[int]:
        """Robots without which the next tick does not begin."""


class PeriodClock:
    """A tick every ``period`` seconds, the same on all robots whose clocks agree.

    Args:
        period: length of a tick (seconds).
        start: when tick 0 begins (seconds).

    Raises:
        ValueError: for a period that is no tick's, or a start that is no time.
    """

    announces = False

    def __init__(self, period: float, start: float = 0.0) -> None:
        require_positive("period", period, "seconds")
        shortest, longest = _PERIODS
        allowed = f"it must be from {shortest:g} to {longest:g} seconds"
        require(shortest <= period <= longest, "period", period, allowed)
        require_time("start", start)
        self.period, self.start = period, start

    def tick(self, now: float) -> int:
        """The tick at a time (seconds)."""
        require_time("now", now)
        return max(-1, math.floor((now - self.start) / self.period))

    def begins(self, tick: int) -> float:
        """When a tick begins (seconds)."""
        return self.start + tick * self.period

    def report(self, robot: int, tick: int, now: float) -> None:
        """Does nothing: no robot is waited for."""

    @property
    def waited_for(self) -> set[int]:
        """No robot."""
        return set()


class BarrierClock:
    """A tick begins when all robots have finished the one before.

    Every robot has its own clock, which gets the others' reports; a robot that is silent for longer
    than ``patience`` is no longer waited for.

    Args:
        robots: numbers of all robots.
        patience: how long a robot is waited for (seconds).

    Raises:
        ValueError: when the robots are not numbered from 0 on, or a patience that is none.
    """

    announces = True

    def __init__(self, robots: Iterable[int], patience: float = 60.0) -> None:
        require_positive("patience", patience, "seconds")
        self.patience = patience
        robots = list(robots)
        for robot in robots:
            require_integer("robots", robot, 0)
        numbered = len(robots) > 0 and sorted(robots) == list(range(len(robots)))
        require(numbered, "robots", robots, "the numbers of all robots, from 0 on")
        self._through = dict.fromkeys(robots, -1)
        self._missed: set[int] = set()
        self._tick, self._since = 0, math.inf

    def tick(self, now: float) -> int:
        """The tick at a time (seconds)."""
        require_time("now", now)
        self._since = min(self._since, now)  # clocks can be set back
        if now - self._since > self.patience:
            self._missed |= self.waited_for
        latest = max(self._through.values())
        if latest > self._tick:  # the others are ahead: join them
            self._begin(latest, now)
        elif latest == self._tick and not self.waited_for:
            self._begin(self._tick + 1, now)
        return self._tick

    def check(self, robots: int) -> None:
        """Raise an error for a team of another size.

        Raises:
            ValueError: naming both.
        """
        own = len(self._through)
        require(own == robots, "robots", own, f"the clock is for a team of {robots}")

    def begins(self, tick: int) -> None:
        """None: that depends on the robots."""

    def report(self, robot: int, tick: int, now: float) -> None:
        """Report that a robot has finished a tick; a robot that was silent is waited for again."""
        self._through[robot] = max(tick, self._through.get(robot, -1))
        self._missed.discard(robot)

    @property
    def waited_for(self) -> set[int]:
        """Robots that have not finished the tick, less those that have been silent for too long."""
        late = {robot for robot, tick in self._through.items() if tick < self._tick}
        return late - self._missed

    def _begin(self, tick: int, now: float) -> None:
        self._tick, self._since = tick, now

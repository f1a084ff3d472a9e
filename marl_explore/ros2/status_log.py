"""What of a status is logged: nothing twice that only went away for a moment."""

from __future__ import annotations

import math
from collections.abc import Hashable
from typing import Literal

from marl_explore.robot.status import Reason, Status

GONE_SECONDS = 10.0
"""What has been gone for longer is logged again."""


class Sightings:
    """When things that come and go were last seen.

    Args:
        gone: what was not seen for longer is new (seconds).
    """

    def __init__(self, gone: float = GONE_SECONDS) -> None:
        self.gone = gone
        self._seen: dict[Hashable, float] = {}

    def is_new(self, what: Hashable, now: float) -> bool:
        """Note that something is seen at a time (seconds); whether it is new.

        A clock that is set back makes nothing new.
        """
        last = self._seen.get(what)
        self._seen[what] = now
        return last is None or now - last > self.gone


class StatusLog:
    """Chooses what a robot's node logs: faults, their ends, long waits, and a complete map.

    Args:
        gone: a kind of status is logged again when it was gone for longer, the end of a fault when
            there was none for so long, and what is waited for after so long (seconds).
    """

    def __init__(self, gone: float = GONE_SECONDS) -> None:
        self._sightings = Sightings(gone)
        self._fault_at: float | None = None
        self._wait: tuple[str, float] | None = None
        """What is waited for, and since when (seconds)."""

    def level(self, status: Status, now: float) -> Literal["warning", "info"] | None:
        """How to log a status at a time (seconds); None: not at all. Call it with every status."""
        is_new = self._sightings.is_new(status.reason, now)
        if self._waits_for_long(status, now):
            return "info"
        if status.is_fault:
            self._fault_at = now
            return "warning" if is_new else None
        if self._fault_at is not None:
            self._fault_at = min(self._fault_at, now)  # clocks can be set back
            if now - self._fault_at > self._sightings.gone:
                self._fault_at = None
                return "info"
        return "info" if is_new and status.reason is Reason.COMPLETE else None

    def _waits_for_long(self, status: Status, now: float) -> bool:
        """Whether the same has been waited for for so long just now."""
        if status.reason is not Reason.WAITING:
            self._wait = None
            return False
        if (
            self._wait is None
            or self._wait[0] != status.text
            or (math.isfinite(self._wait[1]) and now < self._wait[1])
        ):
            self._wait = status.text, now
        if now - self._wait[1] <= self._sightings.gone:
            return False
        self._wait = status.text, math.inf  # once
        return True

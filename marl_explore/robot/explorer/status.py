"""What an explorer says of itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

State = Literal["waiting", "exploring", "returning", "complete", "stuck"]
"""``complete``: no frontier is left. ``stuck``: those that are left could not be reached."""


@dataclass(frozen=True)
class Status:
    """A state, a sentence for people, and counts."""

    state: State
    sentence: str
    """What the robot does or lacks."""
    known: float = 0.0
    """Known area, teammates' maps included (square metres)."""
    frontiers: int = 0
    """Frontiers that can be reached and are long enough."""
    small: int = 0
    """Frontiers that are ignored, because they are short."""
    unreachable: int = 0
    """Frontiers that are long enough, but not reached by free cells."""
    reached: int = 0
    """Goals that were reached."""
    skipped: int = 0
    """Goals that were not reached once, and will be tried once more."""
    given_up: int = 0
    """Goals that were not reached twice."""
    exhausted: int = 0
    """Goals that were reached, and whose frontier stayed."""
    team: tuple[str, ...] = ()
    """A sentence for every teammate."""

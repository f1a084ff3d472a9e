"""Settings of an explorer: the robot's size, what counts as a frontier, patience, its team."""

from __future__ import annotations

from dataclasses import dataclass

from marl_explore.config.checks import (
    require,
    require_not_negative,
    require_positive,
    require_share,
)
from marl_explore.config.fields import check_types

SMALLEST, LARGEST = 0.03, 5.0
"""Radius of a robot (metres)."""
_DAY = 86_400.0
_POSITIVE = {
    "min_frontier": ("metres", 100.0),
    "arrival": ("metres", 10.0),
    "goal_radius": ("metres", 10.0),
    "refusal": ("seconds", _DAY),
    "no_progress": ("seconds", _DAY),
    "slowest": ("metres per second", 10.0),
    "map_patience": ("seconds", _DAY),
    "view": ("metres", 10.0),
    "lost_after": ("seconds", _DAY),
}
"""Units of settings that must be positive, and most of each."""
_NOT_NEGATIVE = {
    "settle": ("seconds", _DAY),
    "gain": ("metres", 1000.0),
    "keep": ("metres", 1000.0),
    "territory": ("metres", 1000.0),
    "body_radius": ("metres", 10.0),
    "body_time": ("seconds", 3600.0),
}
"""The same of those that may be 0."""


@dataclass(frozen=True)
class ExplorerSettings:
    """Lengths in metres, times in seconds; the defaults suit a TurtleBot 4."""

    radius: float = 0.2
    """Of the robot."""
    min_frontier: float = 0.4
    """Shorter frontiers are ignored."""
    arrival: float = 0.5
    """A robot this near to its goal has arrived; more than Nav2's ``xy_goal_tolerance``."""
    goal_radius: float = 1.0
    """Frontiers this near to a goal belong to it: they are skipped and reserved with it."""
    refusal: float = 10.0
    """A goal is refused if the robot does not start for this long; after half of it, it is sent
    once more."""
    no_progress: float = 20.0
    """A goal is given up if the robot stays within ``arrival`` for this long."""
    slowest: float = 0.05
    """Mean speed (m/s) below which a goal is not reached in time, after ``no_progress``."""
    settle: float = 10.0
    """How long no frontier must be left before exploration is complete."""
    map_patience: float = 6.0
    """How long to wait at a goal for the next map; more than SLAM's interval between maps."""
    return_to_start: bool = True
    """Whether the robot returns to where it was first when it is done."""
    view: float = 2.0
    """How far around a goal unknown cells count as its gain."""
    gain: float = 2.0
    """Length of a detour for a goal with only unknown cells around it."""
    keep: float = 2.0
    """How much shorter the way to another goal must be to change the goal."""
    territory: float = 10.0
    """Length of a detour that leaves a frontier to a teammate who is nearer, or has chosen it."""
    lost_after: float = 30.0
    """A teammate that is not heard for longer is lost: it reserves nothing; more than SLAM's
    interval between maps."""
    body_radius: float = 0.25
    """Obstacles this near to where a teammate is, or has been, are its body."""
    body_time: float = 30.0
    """For how long they are, after the teammate was there."""
    most_conflicts: float = 0.25
    """Share of the walls in both maps that may contradict; above it a map is refused."""

    def __post_init__(self) -> None:
        """Check the settings."""
        check_types(self)
        allowed = f"it must be from {SMALLEST:g} to {LARGEST:g} metres"
        require(SMALLEST <= self.radius <= LARGEST, "radius", self.radius, allowed)
        for name, (unit, most) in _POSITIVE.items():
            require_positive(name, getattr(self, name), unit, most)
        for name, (unit, most) in _NOT_NEGATIVE.items():
            require_not_negative(name, getattr(self, name), unit, most)
        require_share("most_conflicts", self.most_conflicts)

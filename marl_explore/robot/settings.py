"""Settings of a robot: timeouts, drive and sensor model."""

from __future__ import annotations

from dataclasses import dataclass, field

from marl_explore.config.checks import require_positive
from marl_explore.config.fields import check_types
from marl_explore.robot.driving import Drive
from marl_explore.robot.mapper import BeamModel


@dataclass(frozen=True)
class RobotSettings:
    """Timeouts, drive and sensor model; times in seconds."""

    max_pose_age: float = 0.5
    """A robot stands still if its pose is older than this."""
    max_scan_age: float = 1.0
    """A robot stands still if its scan is older than this."""
    message_patience: float = 2.0
    """How long to wait for intents and maps of others."""
    lock_expiry: float = 20.0
    """How long to wait for a cell that another robot holds before giving up the move."""
    move_expiry: float = 40.0
    """How long a move may take before the robot drives back."""
    stop_when_complete: bool = True
    """Whether a robot without a reachable frontier makes no more moves."""
    drive: Drive = field(default_factory=Drive)
    beams: BeamModel = field(default_factory=BeamModel)

    def __post_init__(self) -> None:
        """Check the times."""
        check_types(self)
        for name in ("max_pose_age", "message_patience", "lock_expiry", "move_expiry"):
            require_positive(name, getattr(self, name), "seconds")
        if not self.max_scan_age > 0:
            raise ValueError(f"max_scan_age={self.max_scan_age!r} is not allowed: it must be > 0 s")

"""How a robot waits, drives and looks."""

from __future__ import annotations

from dataclasses import dataclass, field

from marl_explore.config.checks import require_positive
from marl_explore.robot.driving import Drive
from marl_explore.robot.mapper import BeamModel


@dataclass(frozen=True)
class RobotSettings:
    """How a robot waits, drives and looks; times in seconds."""

    max_pose_age: float = 0.5
    """A robot whose pose is older stands still."""
    max_scan_age: float = 1.0
    """A robot whose scan is older stands still."""
    message_patience: float = 2.0
    """How long intents and maps of others are waited for."""
    lock_expiry: float = 20.0
    """How long a cell that another robot holds is waited for before the move is given up."""
    move_expiry: float = 40.0
    """How long a move may take before the robot goes back."""
    stop_when_complete: bool = True
    """Whether a robot with no frontier left to reach makes no more moves."""
    drive: Drive = field(default_factory=Drive)
    beams: BeamModel = field(default_factory=BeamModel)

    def __post_init__(self) -> None:
        """Refuse times that are none."""
        for name in ("max_pose_age", "message_patience", "lock_expiry", "move_expiry"):
            require_positive(name, getattr(self, name), "seconds")
        if not self.max_scan_age > 0:
            raise ValueError(f"max_scan_age={self.max_scan_age!r} is not allowed: more than 0 s")

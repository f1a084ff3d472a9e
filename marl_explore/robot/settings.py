"""Settings of a robot: timeouts, drive, sensor model, and how maps are kept."""

from __future__ import annotations

from dataclasses import dataclass, field

from marl_explore.config.checks import require_not_negative, require_positive
from marl_explore.config.fields import check_types
from marl_explore.robot.driving import Drive
from marl_explore.robot.evidence import EvidenceModel
from marl_explore.robot.jumps import JumpLimits
from marl_explore.robot.mapper import BeamModel
from marl_explore.robot.merging import MergeLimits

_DAY = 86_400.0
_FARTHEST = 1000.0
_TIMES = ("max_pose_age", "message_patience", "lock_expiry", "move_expiry", "move_patience")


@dataclass(frozen=True)
class RobotSettings:
    """Timeouts, drive, sensor model, and how maps are kept; times in seconds."""

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
    move_patience: float = 5.0
    """How long a robot may try to drive without moving before it gives up the move."""
    shut_seconds: float = 60.0
    """How long a cell that could not be reached counts as occupied."""
    stop_when_complete: bool = True
    """Whether a robot without a reachable frontier makes no more moves."""
    mate_patience: float = 60.0
    """How long a robot that is not heard holds its cell, and returns where it may be are no
    obstacle."""
    mate_reach: float = 1.5
    """How far such a robot can have driven at most (metres)."""
    drive: Drive = field(default_factory=Drive)
    beams: BeamModel = field(default_factory=BeamModel)
    evidence: EvidenceModel = field(default_factory=EvidenceModel)
    merging: MergeLimits = field(default_factory=MergeLimits)
    jumps: JumpLimits = field(default_factory=JumpLimits)

    def __post_init__(self) -> None:
        """Check the times."""
        check_types(self)
        for name in _TIMES:
            require_positive(name, getattr(self, name), "seconds", _DAY)
        for name in ("shut_seconds", "mate_patience"):
            require_not_negative(name, getattr(self, name), "seconds", _DAY)
        require_not_negative("mate_reach", self.mate_reach, "metres", _FARTHEST)
        if not self.max_scan_age > 0:
            raise ValueError(f"max_scan_age={self.max_scan_age!r} is not allowed: it must be > 0 s")

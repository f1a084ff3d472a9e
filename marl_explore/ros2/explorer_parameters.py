"""Parameters of ``explorer_node``, and the explorer that they make."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

from marl_explore.config.checks import require, require_positive
from marl_explore.robot.explorer import ExplorerCore, ExplorerSettings, Place

PoseSource = Literal["topic", "tf"]
SLOWEST_RATE = 1.0


@dataclass(frozen=True)
class ExplorerParameters:
    """Parameters of ``explorer_node``; topics are relative to its namespace."""

    frame: str = "map"
    """Frame of the own map, poses and goals."""
    base_frame: str = "base_link"
    """Frame of the robot, for tf."""
    pose_source: str = "topic"
    """``topic``, or ``tf``: the transform from ``frame`` to ``base_frame``."""
    map_topic: str = "map"
    """OccupancyGrid."""
    pose_topic: str = "pose"
    """PoseWithCovarianceStamped or PoseStamped."""
    goal_topic: str = "goal_pose"
    """PoseStamped, which Nav2 follows."""
    mate_pose_topic: str = "explorer/pose"
    """Teammates' poses, under their namespaces; every explorer_node publishes its own there."""
    team: list[str] = field(default_factory=list)
    """Namespaces of all robots of the team, the own one too."""
    frames: list[float] = field(default_factory=list)
    """x, y, yaw of the map frame of every robot of the team in a common frame; empty: all alike."""
    rate: float = 2.0
    """How often the node decides (per second)."""
    settings: ExplorerSettings = field(default_factory=ExplorerSettings)

    def __post_init__(self) -> None:
        """Check the parameters."""
        allowed = get_args(PoseSource)
        require(self.pose_source in allowed, "pose_source", self.pose_source, f"one of {allowed}")
        require_positive("rate", self.rate, "1/s")
        require(self.rate >= SLOWEST_RATE, "rate", self.rate, f"at least {SLOWEST_RATE:g} 1/s")
        require(len({*self.team}) == len(self.team), "team", self.team, "a robot is in it twice")
        sizes = (0, 3 * len(self.team))
        require(len(self.frames) in sizes, "frames", self.frames, "x, y, yaw for each of the team")

    def mates(self, name: str) -> dict[str, Place]:
        """The map frames of the teammates in that of one robot.

        Raises:
            ValueError: when the robot is not in its team.
        """
        if not self.team:
            return {}
        require(name in self.team, "team", self.team, f"the node's namespace {name!r} is not in it")
        numbers = iter(map(float, self.frames or [0.0] * 3 * len(self.team)))
        places = {mate: Place(next(numbers), next(numbers), next(numbers)) for mate in self.team}
        own = places.pop(name)
        return {mate: own.relative(place) for mate, place in places.items()}

    def make_core(self, name: str) -> ExplorerCore:
        """The explorer of a robot.

        Raises:
            ValueError: when the robot is not in its team, or a frame is not finite.
        """
        return ExplorerCore(self.settings, name, self.mates(name))

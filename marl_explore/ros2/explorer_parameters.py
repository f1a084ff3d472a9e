"""Parameters of ``explorer_node``, and the explorer that they make."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

from marl_explore.config.checks import require, require_finite, require_positive
from marl_explore.config.fields import check_types
from marl_explore.robot.explorer import ExplorerCore, ExplorerSettings, Place
from marl_explore.ros2.names import frame_id, require_team, require_topic
from marl_explore.ros2.parameters import FASTEST_RATE

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
    map_frames: list[str] = field(default_factory=list)
    """Names of the map frames of all robots of the team, the own one too; empty: all are
    ``frame``."""
    rate: float = 2.0
    """How often the node decides (per second)."""
    settings: ExplorerSettings = field(default_factory=ExplorerSettings)

    def __post_init__(self) -> None:
        """Check the parameters."""
        check_types(self)
        for name in ("frame", "base_frame"):
            object.__setattr__(self, name, frame_id(name, getattr(self, name)))
        names = [frame_id("map_frames", name) for name in self.map_frames]
        object.__setattr__(self, "map_frames", names)
        sources = get_args(PoseSource)
        require(self.pose_source in sources, "pose_source", self.pose_source, f"one of {sources}")
        require_positive("rate", self.rate, "1/s", FASTEST_RATE)
        require(self.rate >= SLOWEST_RATE, "rate", self.rate, f"at least {SLOWEST_RATE:g} 1/s")
        require_team(self.team)
        self._check_topics()
        for number in self.frames:
            require_finite("frames", number)
        sizes = (0, 3 * len(self.team))
        require(len(self.frames) in sizes, "frames", self.frames, "x, y, yaw for each of the team")
        sizes = (0, len(self.team))
        allowed = "a name for each of the team"
        require(len(names) in sizes, "map_frames", self.map_frames, allowed)

    def _check_topics(self) -> None:
        require_topic("pose_topic", self.pose_topic)
        for name in ("map_topic", "goal_topic", "mate_pose_topic"):
            require_topic(name, getattr(self, name), in_team=bool(self.team))
        require(self.goal_topic != self.map_topic, "goal_topic", self.goal_topic, "it is the map's")
        for name in ("pose_topic", "mate_pose_topic"):
            topic = getattr(self, name)
            others = self.map_topic, self.goal_topic
            require(topic not in others, name, topic, "it is the map's or that of goals")

    def frame_of(self, robot: str | None) -> str:
        """Name of the map frame of a robot of the team, or of the own one (None)."""
        if robot is None or not self.map_frames:
            return self.frame
        return self.map_frames[self.team.index(robot)]

    def mates(self, name: str) -> dict[str, Place]:
        """The map frames of the teammates in that of one robot.

        Raises:
            ValueError: when the robot is not in its team, or its frame has another name there.
        """
        if not self.team:
            return {}
        require(name in self.team, "team", self.team, f"the node's namespace {name!r} is not in it")
        allowed = f"that of {name!r} must be frame={self.frame!r}"
        require(self.frame_of(name) == self.frame, "map_frames", self.map_frames, allowed)
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

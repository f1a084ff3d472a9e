"""Parameters of the nodes: dataclasses whose fields are set by name."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.checks import (
    require,
    require_integer,
    require_not_negative,
    require_positive,
)
from marl_explore.config.fields import check_types
from marl_explore.robot import BarrierClock, ExportedPolicy, PeriodClock, RobotCore, RobotSettings
from marl_explore.robot.clock import Clock
from marl_explore.robot.planners import PLANNERS
from marl_explore.ros2.names import frame_id, require_team

Given = TypeVar("Given")
MOST_ROBOTS = 16
"""Of a team."""
FASTEST_RATE = 1000.0
"""Per second."""


def flat(values: Any, prefix: str = "") -> dict[str, Any]:
    """The fields of a dataclass by name; those of nested dataclasses as ``outer.inner``."""
    fields: dict[str, Any] = {}
    for entry in dataclasses.fields(values):
        value, name = getattr(values, entry.name), prefix + entry.name
        fields |= flat(value, f"{name}.") if dataclasses.is_dataclass(value) else {name: value}
    return fields


def replaced(default: Given, given: Mapping[str, Any]) -> Given:
    """A dataclass with some parameters replaced.

    Args:
        default: the default values.
        given: values by the names from ``flat``.

    Raises:
        ValueError: for an unknown name, a value of another type, or one that is not allowed.
    """
    known = flat(default)
    for name, value in given.items():
        if name not in known:
            raise ValueError(f"parameter {name!r} is not allowed: there are {', '.join(known)}")
        kinds = (int, float) if isinstance(known[name], float) else (type(known[name]),)
        if type(value) not in kinds:
            allowed = type(known[name]).__name__
            raise ValueError(f"{name}={value!r} is not allowed: it must be of type {allowed}")
    return _replaced(default, given, "")


def _replaced(default: Any, given: Mapping[str, Any], prefix: str) -> Any:
    values = {}
    for entry in dataclasses.fields(default):
        value, name = getattr(default, entry.name), prefix + entry.name
        if dataclasses.is_dataclass(value):
            values[entry.name] = _replaced(value, given, f"{name}.")
        else:
            values[entry.name] = given.get(name, value)
    return dataclasses.replace(default, **values)


def four_robots() -> list[str]:
    """Namespaces of the paper's team."""
    return [f"robot_{number}" for number in range(4)]


@dataclass(frozen=True)
class RobotParameters:
    """Parameters of ``robot_node``."""

    robot: int = 0
    """The robot's number in the team."""
    policy: str = ""
    """An exported policy (.npz), which determines arena, ranges and mostly also the team's size;
    or the name of a planner that runs on robots."""
    arena: ArenaConfig = field(default_factory=ArenaConfig)
    """Arena and ranges for a planner; the team's size is that of ``team``."""
    team: list[str] = field(default_factory=four_robots)
    """Namespaces of all robots, in the order of their numbers."""
    frame: str = "arena"
    """Frame of poses and maps, with its origin in the middle of the arena."""
    base_frame: str = "base_link"
    """Frame of stamped velocities."""
    lidar_from_tf: bool = False
    """Whether tf says where the lidar is on the robot, instead of ``settings.beams``."""
    stamped: bool = False
    """Whether velocities are TwistStamped instead of Twist."""
    rate: float = 20.0
    """How often velocities are sent (per second)."""
    period: float = 0.0
    """Length of a tick by wall-clock time (seconds); 0: a tick begins when all are done."""
    start: float = 0.0
    """When the first tick begins if ``period`` is not 0 (seconds of the robots' clocks)."""
    patience: float = 60.0
    """How long to wait for a silent robot if ``period`` is 0 (seconds)."""
    sample: bool = True
    """Whether actions are sampled."""
    seed: int = 0
    """Seed of the sampled actions."""
    settings: RobotSettings = field(default_factory=RobotSettings)

    def __post_init__(self) -> None:
        """Check the parameters that the robot itself does not know, or knows by other names."""
        check_types(self)
        require_team(self.team)
        allowed = f"namespaces of 1 to {MOST_ROBOTS} robots"
        require(0 < len(self.team) <= MOST_ROBOTS, "team", self.team, allowed)
        require_integer("robot", self.robot, 0, len(self.team) - 1)
        require_integer("seed", self.seed, 0)
        require_positive("rate", self.rate, "1/s", FASTEST_RATE)
        require_not_negative("period", self.period, "seconds")
        for name in ("frame", "base_frame"):
            object.__setattr__(self, name, frame_id(name, getattr(self, name)))

    def make_core(self) -> RobotCore:
        """The robot.

        Raises:
            ValueError: when the policy is neither an exported policy nor a planner, or is for
                another team.
        """
        robots = len(self.team)
        clock: Clock = BarrierClock(range(robots), self.patience)
        if self.period:
            clock = PeriodClock(self.period, self.start)
        if self.policy in PLANNERS:
            arena = dataclasses.replace(self.arena, num_agents=robots)
            planner = PLANNERS[self.policy](self.robot, arena, self.seed)
            return RobotCore(self.robot, arena, planner, clock, settings=self.settings)
        if not Path(self.policy).is_file():
            raise ValueError(
                f"policy={self.policy!r} is not allowed: it must be an exported .npz or one of "
                f"{', '.join(PLANNERS)}"
            )
        policy = ExportedPolicy(self.policy, self.robot, self.sample, self.seed)
        if robots != policy.arena.num_agents and not policy.any_team:
            raise ValueError(
                f"team={self.team!r} is not allowed: the policy is for {policy.arena.num_agents} "
                "robots"
            )
        arena = dataclasses.replace(policy.arena, num_agents=robots)
        return RobotCore(self.robot, arena, policy, clock, policy.fpr, self.settings)

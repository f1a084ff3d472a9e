"""Parameters of the nodes: dataclasses that are declared field by field, and what they make."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from marl_explore.config import require_positive
from marl_explore.robot import BarrierClock, ExportedPolicy, PeriodClock, RobotCore, Settings

Declared = TypeVar("Declared")
Declare = Callable[[str, Any], Any]
"""(name, default) -> value, as by ``rclpy.node.Node.declare_parameter(...).value``."""


def declared(declare: Declare, default: Declared, prefix: str = "") -> Declared:
    """A dataclass with every field declared, those of dataclasses in it as ``outer.inner``.

    Args:
        declare: how a parameter is declared.
        default: the values where nothing is given.
        prefix: of the names.
    """
    values = {}
    for entry in dataclasses.fields(default):  # type: ignore[arg-type]
        value = getattr(default, entry.name)
        name = prefix + entry.name
        if dataclasses.is_dataclass(value):
            values[entry.name] = declared(declare, value, f"{name}.")
        else:
            values[entry.name] = declare(name, value)
    return dataclasses.replace(default, **values)  # type: ignore[type-var]


def four_robots() -> list[str]:
    """Namespaces of the paper's team."""
    return [f"robot_{number}" for number in range(4)]


@dataclass(frozen=True)
class RobotParameters:
    """Of ``robot_node``."""

    robot: int = 0
    """The robot's number in the team."""
    policy: str = ""
    """An exported policy, .npz; the arena is the one it was trained for."""
    team: list[str] = field(default_factory=four_robots)
    """Namespaces of all robots, in the order of their numbers."""
    frame: str = "arena"
    """Frame of poses and maps: its origin is the arena's middle."""
    base_frame: str = "base_link"
    """Frame of a stamped velocity."""
    stamped: bool = False
    """Whether velocities are TwistStamped instead of Twist."""
    rate: float = 20.0
    """How often velocities are sent (per second)."""
    period: float = 0.0
    """Length of a tick by the time of day (seconds); 0: a tick begins when all are through."""
    patience: float = 60.0
    """How long a robot is waited for with no ``period`` (seconds)."""
    sample: bool = True
    """Whether actions are drawn with the policy's probabilities."""
    seed: int = 0
    """Of the drawn actions."""
    settings: Settings = field(default_factory=Settings)

    def make_core(self) -> RobotCore:
        """The robot.

        Raises:
            ValueError: for a policy that is none or of another team.
        """
        require_positive("rate", self.rate, "1/s")
        if not Path(self.policy).is_file():
            raise ValueError(f"policy={self.policy!r} is not allowed: it must be an exported .npz")
        policy = ExportedPolicy(self.policy, self.robot, self.sample, self.seed)
        robots = policy.arena.num_agents
        if len(self.team) != robots:
            raise ValueError(f"team={self.team!r} is not allowed: the policy is of {robots} robots")
        clock = (
            PeriodClock(self.period) if self.period else BarrierClock(range(robots), self.patience)
        )
        return RobotCore(self.robot, policy.arena, policy, clock, policy.fpr, self.settings)

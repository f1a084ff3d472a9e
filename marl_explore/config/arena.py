"""Settings of an arena and its robots: given in metres, converted to cells for the rules."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

from marl_explore.config.checks import (
    require,
    require_integer,
    require_not_negative,
    require_positive,
    require_share,
)
from marl_explore.config.fields import check_types
from marl_explore.config.shapes import (
    MAX_SENSING_CELLS,
    SHAPES,
    Sight,
    holds_neighbours,
    most_discovered,
    one_if_equal,
    smallest_range,
)

Number = TypeVar("Number", int, float)
ANY_SIZE = ("uniform", "uniform-v2", "mixed")
"""Kinds of arenas that take any size; suites have a fixed size."""
SENSING_RANGE_M, COMMUNICATION_RANGE_M = 1.1, 3.2
"""The paper's ranges."""
WIDER = (
    "sensing_shape",
    "wall_loss_db",
    "shadowing_db",
    "message_loss",
    "move_period",
    "failure_rate",
    "num_walkers",
    "radio",
)
"""Settings of a world beyond the paper's, apart from those of each robot and from sight."""
PER_ROBOT = ("sensing_range", "communication_range", "move_period")
"""Settings that may be a tuple with one entry per robot."""


@dataclass(frozen=True)
class ArenaConfig:
    """The arena, its robots, their sensors and radios; the defaults are the paper's Table III.

    Settings of each robot are a number for all, or a tuple with one entry per robot; a tuple of
    equal entries is stored as the number. docs/environment.md describes the rules.

    Raises:
        ValueError: naming the field, its value and the bound, when a value is out of range.
    """

    height: int = 12
    """Rows of the grid (cells)."""
    width: int = 12
    """Columns of the grid (cells)."""
    obstacle_density: float = 0.1
    """Share of the cells that hold a static obstacle."""
    num_agents: int = 4
    """Robots in the arena."""
    cell_size: float = 0.5
    """Side of a cell (metres)."""
    sensing_range: float | tuple[float, ...] = SENSING_RANGE_M
    """Range of the sensors (metres); may differ between robots."""
    communication_range: float | tuple[float, ...] = COMMUNICATION_RANGE_M
    """Largest distance between two robots that can exchange maps (metres; may be infinite); of two
    robots that differ the shorter counts."""
    occlusion: bool = False
    """Another name of ``line_of_sight`` for 3 x 3 fields of view; stored as ``line_of_sight``."""
    sensing_shape: str = "square"
    """The cells that a sensor covers: the largest "square" in the sensing disc, or the "disc"; or
    another name of ``SHAPES``."""
    line_of_sight: bool = False
    """Whether obstacles hide what lies behind them."""
    wall_loss_db: float = 0.0
    """Loss of a radio link per obstacle on the straight line (dB); infinite: one cuts the link."""
    path_loss_exponent: float = 2.0
    """Exponent n with which the power of radio falls with distance."""
    shadowing_db: float = 0.0
    """Standard deviation of a further loss, drawn for each pair and episode (dB)."""
    message_loss: float = 0.0
    """Probability that a link carries no maps in a step."""
    move_period: int | tuple[int, ...] = 1
    """A robot may move only at every so many steps; may differ between robots."""
    failure_rate: float = 0.0
    """Probability per step that a robot fails for good."""
    num_walkers: int = 0
    """People who walk about."""
    radio: str = "path-loss"
    """The rule by which robots are linked, a name of ``core.links.RADIOS``."""

    def __post_init__(self) -> None:
        """Raise an error for settings that are not allowed."""
        for name in PER_ROBOT:
            value = getattr(self, name)
            if isinstance(value, list):
                object.__setattr__(self, name, tuple(value))
        check_types(self)
        require_integer("height", self.height, 1)
        require_integer("width", self.width, 1)
        require_integer("num_agents", self.num_agents, 1)
        require_positive("cell_size", self.cell_size, "metres")
        for name in PER_ROBOT:
            self._read_per_robot(name)
        self._check_sensors()
        self._check_radios()
        self._check_events()

    def _read_per_robot(self, name: str) -> None:
        """Check the length of a tuple, and store one of equal entries as the number."""
        value = getattr(self, name)
        if isinstance(value, tuple):
            require(
                len(value) == self.num_agents,
                name,
                value,
                f"a tuple needs one entry per robot, and num_agents={self.num_agents}",
            )
            object.__setattr__(self, name, one_if_equal(value))

    def _each(self, name: str, allowed: Callable[[float], bool], words: str) -> None:
        """Require something of the entry of every robot."""
        value = getattr(self, name)
        entries = value if isinstance(value, tuple) else (value,)
        require(all(map(allowed, entries)), name, value, words)

    def _check_sensors(self) -> None:
        name, cell = "sensing_range", self.cell_size
        self._each(
            name, lambda x: 0 < x < math.inf, "it must be a positive finite number of metres"
        )
        self._each(
            name,
            lambda x: x < MAX_SENSING_CELLS * cell,
            f"it must be less than {MAX_SENSING_CELLS} cells of {cell} m",
        )
        shape = self.sensing_shape
        require(shape in SHAPES, "sensing_shape", shape, f"it must be one of {sorted(SHAPES)}")
        self._each(
            name,
            lambda x: holds_neighbours(shape, x / cell),
            f"it must be at least {_rounded_up(smallest_range(shape) * cell):.4g} m to hold a "
            f"3 x 3 square of {cell} m cells",
        )
        if self.occlusion:
            object.__setattr__(self, "occlusion", False)
            object.__setattr__(self, "line_of_sight", True)
            require(
                self.fov_radius == 1,
                "occlusion",
                True,
                f"it needs a 3 x 3 field of view, and sensing_range={self.sensing_range} gives "
                f"{self.fov_size} x {self.fov_size}: use line_of_sight",
            )

    def _check_radios(self) -> None:
        self._each("communication_range", lambda x: x >= 0, "it must be at least 0 metres")
        require(self.wall_loss_db >= 0, "wall_loss_db", self.wall_loss_db, "it must be at least 0")
        require_positive("path_loss_exponent", self.path_loss_exponent)
        require_not_negative("shadowing_db", self.shadowing_db)
        require_share("message_loss", self.message_loss)

    def _check_events(self) -> None:
        """Check what may happen in an episode, and the room for it."""
        self._each("move_period", lambda x: x >= 1, "it must be an integer of at least 1")
        require_share("failure_rate", self.failure_rate)
        require_integer("num_walkers", self.num_walkers, 0)
        require(
            0 <= self.obstacle_density < 1,
            "obstacle_density",
            self.obstacle_density,
            "it must lie in [0, 1)",
        )
        free = self.num_cells - self.num_obstacles
        room = (
            f"{self.height} x {self.width} cells with obstacle_density={self.obstacle_density} "
            f"leave room for at most {free}"
        )
        require(self.num_agents <= free, "num_agents", self.num_agents, room)
        require(
            self.num_agents + self.num_walkers <= free,
            "num_walkers",
            self.num_walkers,
            f"{room}, robots among them, and num_agents={self.num_agents}",
        )

    @property
    def num_cells(self) -> int:
        """Cells of the grid."""
        return self.height * self.width

    @property
    def num_obstacles(self) -> int:
        """Static obstacles of every arena."""
        return round(self.obstacle_density * self.num_cells)

    def each_robot(self, value: Number | tuple[Number, ...]) -> tuple[Number, ...]:
        """A setting as one entry per robot."""
        return value if isinstance(value, tuple) else (value,) * self.num_agents

    @property
    def types(self) -> tuple[tuple[int, ...], ...]:
        """The robots of each type, with the same sensor, radio and speed, in the order of their
        numbers."""
        settings = zip(*(self.each_robot(getattr(self, name)) for name in PER_ROBOT), strict=True)
        types: dict[tuple[float, ...], list[int]] = {}
        for robot, own in enumerate(settings):
            types.setdefault(own, []).append(robot)
        return tuple(map(tuple, types.values()))

    @cached_property
    def sight(self) -> Sight:
        """The robots' sensors, in cells."""
        ranges = self.sensing_range
        ranges = ranges if isinstance(ranges, tuple) else (ranges,)
        cells = tuple(reach / self.cell_size for reach in ranges)
        return Sight(self.sensing_shape, cells, self.line_of_sight)

    @property
    def fov_radius(self) -> int:
        """k of the (2k+1) x (2k+1) field of view, which holds every robot's shape (cells)."""
        return self.sight.radius

    @property
    def fov_size(self) -> int:
        """Side of the field of view, 2k + 1 (cells)."""
        return self.sight.side

    @property
    def communication_cells(self) -> float | tuple[float, ...]:
        """Communication range (cells); may differ between robots."""
        ranges = self.communication_range
        if isinstance(ranges, tuple):
            return tuple(reach / self.cell_size for reach in ranges)
        return ranges / self.cell_size

    def require_as_in_paper(self, reason: str) -> None:
        """Raise an error if anything but sizes, ranges and sight of 3 x 3 cells is not the paper's.

        Args:
            reason: why other settings are not allowed.

        Raises:
            ValueError: naming the first setting that differs.
        """
        paper = ArenaConfig()
        for name in WIDER:
            value, default = getattr(self, name), getattr(paper, name)
            require(value == default, name, value, f"{reason}, which takes {default!r} only")
        for name in PER_ROBOT:
            value = getattr(self, name)
            require(not isinstance(value, tuple), name, value, f"{reason}, which takes one number")
        near = not self.line_of_sight or self.fov_radius == 1
        require(near, "line_of_sight", True, f"{reason}, which has it for 3 x 3 cells only")

    def reach_cells(self, robot: int, other: int) -> float:
        """Largest distance between two robots that are linked, without walls (cells)."""
        cells = self.each_robot(self.communication_cells)
        return min(cells[robot], cells[other])

    @cached_property
    def max_discovery(self) -> int | tuple[int, ...]:
        """Most cells that one move can discover without walls, the paper's e_max (Eq. 5).

        For a square 4k + 1; a tuple only if robots differ.
        """
        sight = self.sight
        return one_if_equal(most_discovered(sight.shape, reach) for reach in sight.ranges_cells)

    @property
    def observation_size(self) -> int:
        """Size of the paper's actor input: FOV, FPR (8 x 3) and NET; 37 for the paper's arena."""
        return self.fov_size**2 + 24 + self.num_agents


def _rounded_up(value: float) -> float:
    """A positive number with four digits, not smaller than it is by more than a millionth."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 3)
    return math.ceil(value / unit * (1 - 1e-6)) * unit

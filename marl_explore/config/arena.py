"""Settings of an arena and its robots: given in metres, converted to cells for the rules."""

from __future__ import annotations

import math
from dataclasses import dataclass

from marl_explore.config.checks import require, require_integer, require_positive
from marl_explore.config.fields import check_types

ANY_SIZE = ("uniform", "mixed")
"""Kinds of arenas that take any size; suites have a fixed size."""
MAX_SENSING_CELLS = 1000
"""Largest sensing radius in cells: a field of view beyond it holds millions of cells per robot."""
TOLERANCE = 1e-9
"""Tolerance in every comparison of real distances, so that 0.3 / 0.1 counts as 3."""


@dataclass(frozen=True)
class ArenaConfig:
    """The arena, its robots and their sensors; the defaults are the paper's Table III.

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
    sensing_range: float = 1.1
    """Radius of the sensing disc (metres)."""
    communication_range: float = 3.2
    """Largest distance between two robots that can exchange maps (metres; may be infinite)."""
    occlusion: bool = False
    """Whether two obstacles hide the diagonal cell behind them (3 x 3 field of view only)."""

    def __post_init__(self) -> None:
        """Raise an error for settings that are not allowed."""
        check_types(self)
        require_integer("height", self.height, 1)
        require_integer("width", self.width, 1)
        require_integer("num_agents", self.num_agents, 1)
        for name in ("cell_size", "sensing_range"):
            require_positive(name, getattr(self, name), "metres")
        require(
            self.communication_range >= 0,
            "communication_range",
            self.communication_range,
            "it must be at least 0 metres",
        )
        require(
            0 <= self.obstacle_density < 1,
            "obstacle_density",
            self.obstacle_density,
            "it must lie in [0, 1)",
        )
        require(
            self.sensing_range < MAX_SENSING_CELLS * self.cell_size,
            "sensing_range",
            self.sensing_range,
            f"it must be less than {MAX_SENSING_CELLS} cells of {self.cell_size} m",
        )
        smallest = 1.5 * math.sqrt(2) * self.cell_size
        require(
            self.fov_radius >= 1,
            "sensing_range",
            self.sensing_range,
            f"it must be at least {smallest:.4g} m to hold a 3 x 3 square of "
            f"{self.cell_size} m cells",
        )
        require(
            not self.occlusion or self.fov_radius == 1,
            "occlusion",
            self.occlusion,
            f"it needs a 3 x 3 field of view, and sensing_range={self.sensing_range} gives "
            f"{self.fov_size} x {self.fov_size}",
        )
        free = self.num_cells - self.num_obstacles
        require(
            self.num_agents <= free,
            "num_agents",
            self.num_agents,
            f"{self.height} x {self.width} cells with obstacle_density={self.obstacle_density} "
            f"leave room for at most {free}",
        )

    @property
    def num_cells(self) -> int:
        """Cells of the grid."""
        return self.height * self.width

    @property
    def num_obstacles(self) -> int:
        """Static obstacles of every arena."""
        return round(self.obstacle_density * self.num_cells)

    @property
    def fov_radius(self) -> int:
        """k of the (2k+1) x (2k+1) field of view, whose square lies inside the sensing disc."""
        return math.floor(self.sensing_range / (math.sqrt(2) * self.cell_size) - 0.5 + TOLERANCE)

    @property
    def fov_size(self) -> int:
        """Side of the field of view, 2k + 1 (cells)."""
        return 2 * self.fov_radius + 1

    @property
    def communication_cells(self) -> float:
        """Communication range (cells)."""
        return self.communication_range / self.cell_size

    @property
    def max_discovery(self) -> int:
        """Most cells that one move can discover, the paper's e_max = 4k + 1 (Eq. 5)."""
        return 4 * self.fov_radius + 1

    @property
    def observation_size(self) -> int:
        """Size of the paper's actor input: FOV, FPR (8 x 3) and NET; 37 for the paper's arena."""
        return self.fov_size**2 + 24 + self.num_agents

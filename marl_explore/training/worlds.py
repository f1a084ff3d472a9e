"""Worlds drawn at random, in which one policy learns for any sensor and any radio."""

from __future__ import annotations

import math
from random import Random
from typing import Any

from marl_explore.config.arena import ArenaConfig

SENSING_CELLS = (1.5, 10.0)
"""Range of lidars; the shortest sees the 3 x 3 cells around a robot."""
RADIO_CELLS = (2.0, 16.0)
WALL_LOSSES_DB = (0.0, 3.0, 6.0, math.inf)
MOST_SHADOWING_DB, MOST_MESSAGE_LOSS, MOST_FAILURES, MOST_WALKERS = 6.0, 0.3, 0.002, 4


def random_world(number: int, arena: ArenaConfig) -> ArenaConfig:
    """An arena's robots in the world of this number: sensors, radio, and what goes wrong.

    Half of the worlds have lidars with line of sight, a quarter lidars that see through obstacles,
    a quarter the paper's sensors. In a quarter of them robots differ. Ranges are spread evenly on a
    logarithmic scale; every other thing that can go wrong does in about half of them.

    Args:
        number: 0, 1, 2, ...
        arena: size, robots, and side of a cell; its other settings are replaced.
    """
    draw = Random(f"world {number}")  # the same with every version of Python
    differ = draw.random() < 1 / 4
    each = arena.num_agents if differ else 1
    settings = _sensors(draw, each, arena) | {
        "communication_range": _lengths(draw, each, RADIO_CELLS, arena),
        "wall_loss_db": WALL_LOSSES_DB[int(4 * draw.random())],
        "path_loss_exponent": 2 + draw.random(),
        "shadowing_db": _sometimes(draw) * MOST_SHADOWING_DB,
        "message_loss": _sometimes(draw) * MOST_MESSAGE_LOSS,
        "failure_rate": _sometimes(draw) * MOST_FAILURES,
        "num_walkers": round(_sometimes(draw) * MOST_WALKERS),
        "move_period": tuple(1 + (draw.random() < 1 / 2) for _ in range(each)) if differ else 1,
    }
    kept = ("height", "width", "obstacle_density", "num_agents", "cell_size")
    return ArenaConfig(**{name: getattr(arena, name) for name in kept}, **settings)


def _sensors(draw: Random, each: int, arena: ArenaConfig) -> dict[str, Any]:
    kind = draw.random()
    ranges = _lengths(draw, each, SENSING_CELLS, arena)
    if kind < 1 / 4:
        return {}
    return {"sensing_range": ranges, "sensing_shape": "disc", "line_of_sight": kind < 3 / 4}


def _lengths(
    draw: Random, number: int, cells: tuple[float, float], arena: ArenaConfig
) -> float | tuple[float, ...]:
    """Lengths in metres; a single one for all robots."""
    low, high = map(math.log, cells)
    found = tuple(
        math.exp(low + (high - low) * draw.random()) * arena.cell_size for _ in range(number)
    )
    return found if number > 1 else found[0]


def _sometimes(draw: Random) -> float:
    """0 in half of the worlds, else up to 1."""
    return max(0.0, 2 * draw.random() - 1)

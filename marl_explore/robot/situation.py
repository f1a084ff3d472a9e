"""What a robot knows when it looks for goals, and what it finds; docs/goals.md has every entry."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_explore.config.constants import NUM_DIRECTIONS


class Situation(NamedTuple):
    """What a robot of a team of N knows; ``core.goals.Situation`` of one robot."""

    grid: NDArray[np.int8]
    """Its map [H, W]."""
    position: NDArray[np.int64]
    """Its cell [2]."""
    taken: NDArray[np.bool_]
    """Cells of the eight directions that hold something that is not on the map [8]."""
    allowed: NDArray[np.bool_]
    """Allowed moves [8]."""
    seen_step: NDArray[np.int64]
    """Step at which it was last linked to each robot [N], negative if never, and for itself."""
    seen_cell: NDArray[np.int64]
    """Where each was then [N, 2]."""
    known_by: NDArray[np.bool_]
    """Cells that it is sure each robot knows [N, H, W]."""
    covered: NDArray[np.bool_]
    """Cells that it leaves to others [H, W]."""
    heading: int | NDArray[np.int64]
    """Direction of its last move; -1 before the first."""
    goal: NDArray[np.int64]
    """The cell that it last chose to go to [2]; (-1, -1) for none."""


class GoalTable(NamedTuple):
    """``core.goals.GoalTable`` of one robot."""

    frontiers: NDArray[np.int32]
    """Candidates [24, 14]."""
    rivals: NDArray[np.int32]
    """Candidates as each teammate would find them [24, N, 2]."""
    ways: NDArray[np.int32]
    """Ways to where each teammate was last seen [N, 2]."""
    all_covered: bool
    """Whether frontiers can be reached, all of them covered by teammates."""


def arrays_of(situation: Situation) -> dict[str, NDArray[Any]]:
    """The entries by name, contiguous; those of another dtype or not contiguous are copied.

    Raises:
        ValueError: for an array of another shape.
    """
    team, cells = len(situation.seen_step), situation.grid.shape
    inputs: dict[str, tuple[type[np.generic], tuple[int, ...]]] = {
        "grid": (np.int8, cells),
        "position": (np.int64, (2,)),
        "taken": (np.bool_, (NUM_DIRECTIONS,)),
        "allowed": (np.bool_, (NUM_DIRECTIONS,)),
        "seen_step": (np.int64, (team,)),
        "seen_cell": (np.int64, (team, 2)),
        "known_by": (np.bool_, (team, *cells)),
        "covered": (np.bool_, cells),
        "heading": (np.int64, ()),
        "goal": (np.int64, (2,)),
    }
    arrays = {}
    for name, (dtype, shape) in inputs.items():
        arrays[name] = array = np.asarray(getattr(situation, name), dtype, order="C")
        if array.shape != shape:
            raise ValueError(f"{name} must have the shape {shape}, got {array.shape}")
    return arrays

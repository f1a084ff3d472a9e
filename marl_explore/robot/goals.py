"""Candidate goals of one robot, with the native kernels if they were built, else with numpy."""

from __future__ import annotations

from collections.abc import Callable

from marl_explore.config.shapes import Sight
from marl_explore.core import native
from marl_explore.robot.native_goals import GoalFinder
from marl_explore.robot.plain_goals import plain_goal_table
from marl_explore.robot.situation import GoalTable, Situation, arrays_of


def goal_table(situation: Situation, sight: Sight) -> GoalTable:
    """``core.goals.goal_table`` of one robot, equal in every entry.

    Args:
        situation: what the robot knows.
        sight: of the robot alone; its k is at least 1.

    Raises:
        ValueError: for a k below 1, an array of another shape, or a cell outside the map.
    """
    return goal_finder(situation, sight)()


def goal_finder(situation: Situation, sight: Sight) -> Callable[[], GoalTable]:
    """What finds the ``goal_table`` of a situation whose arrays change in place.

    The next call of it overwrites the arrays of its table.

    Args:
        situation: as for ``goal_table``.
        sight: as for ``goal_table``.

    Raises:
        ValueError: for a k below 1, or an array of another shape.
    """
    if sight.radius < 1:
        raise ValueError(f"radius={sight.radius} is not at least 1")
    if uses_kernel():
        return GoalFinder(situation, sight).find
    plain = Situation(**arrays_of(situation))
    return lambda: plain_goal_table(plain, sight)


def uses_kernels() -> bool:
    """Whether all that robots compute in C where possible is computed so, not more slowly."""
    others: tuple[native.Kernel, ...] = ("paths", "frontier")
    return uses_kernel() and not any(map(native.missing, others))


def uses_kernel() -> bool:
    """Whether candidates are found in C; numpy finds the same ones more slowly."""
    needed: tuple[native.Kernel, ...] = ("goals", "sight", "discoveries")
    return not any(map(native.missing, needed))

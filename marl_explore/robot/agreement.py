"""Who may go where: every robot computes the same paths from the same intents.

First the rules of the grid apply (docs/environment.md, Actions): contending and crossing moves are
refused. Then cells are locked in the order of the robots' numbers. A robot holds the cell that it
stands on and its target, and for a diagonal, driven as two straight moves, one cell beside it. A
robot that needs a cell which another one leaves or passes goes after it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from marl_explore.config.constants import COMPASS, STAY
from marl_explore.robot.geometry import GridCell
from marl_explore.robot.messages import Intent


@dataclass(frozen=True)
class Way:
    """The path of a robot in one tick."""

    cells: tuple[GridCell, ...]
    """Cells to drive to, in order; empty: the robot stays."""
    after: frozenset[int] = field(default_factory=frozenset)
    """Robots that must have arrived before it starts."""


def agree(intents: Mapping[int, Intent]) -> dict[int, Way]:
    """The paths of all robots.

    Args:
        intents: by robot; robots that are not heard have the intent to stay where they are.
    """
    refused = {robot for robot, intent in intents.items() if intent.action >= STAY}
    refused |= contested(intents)
    while True:
        ways = _Locks(intents, refused)
        if ways.stuck is None:
            return ways.ways()
        refused.add(ways.stuck)


def target(intent: Intent) -> GridCell:
    """The cell that an action leads to."""
    if intent.action >= STAY:
        return intent.cell
    up, side = COMPASS[intent.action]
    return intent.cell[0] + up, intent.cell[1] + side


def contested(intents: Mapping[int, Intent]) -> set[int]:
    """Robots whose move is refused: to an occupied or contended cell, or across another path."""
    moves = {robot: intent for robot, intent in intents.items() if intent.action < STAY}
    starts = {intent.cell for intent in intents.values()}
    targets = {robot: target(intent) for robot, intent in moves.items()}
    doubled_midpoints = {
        robot: (intent.cell[0] + targets[robot][0], intent.cell[1] + targets[robot][1])
        for robot, intent in moves.items()
    }
    contenders, crossers = Counter(targets.values()), Counter(doubled_midpoints.values())
    return {
        robot
        for robot in moves
        if targets[robot] in starts
        or contenders[targets[robot]] > 1
        or crossers[doubled_midpoints[robot]] > 1
    }


class _Locks:
    """Locks on cells beside diagonals, assigned in the order of the robots' numbers."""

    def __init__(self, intents: Mapping[int, Intent], refused: set[int]) -> None:
        self.intents, self.refused = intents, refused
        self.moving = sorted(intents.keys() - refused)
        self.beside: dict[int, GridCell] = {}
        self.before: dict[int, frozenset[int]] = {robot: frozenset() for robot in self.moving}
        self.stuck: int | None = next((r for r in self.moving if not self._place(r)), None)

    def ways(self) -> dict[int, Way]:
        ways = {robot: Way(()) for robot in self.refused}
        for robot in self.moving:
            beside = [self.beside[robot]] if robot in self.beside else []
            ways[robot] = Way((*beside, target(self.intents[robot])), self.before[robot])
        return ways

    def _place(self, robot: int) -> bool:
        """Lock a cell beside a robot's diagonal, if it needs one; False if none is available."""
        if self.intents[robot].action % 2 == 0:
            return True
        for cell in self._sides(robot):
            order = self._order(robot, cell)
            if order is not None and not _circular(order):
                self.beside[robot], self.before = cell, order
                return True
        return False

    def _sides(self, robot: int) -> Iterator[GridCell]:
        intent = self.intents[robot]
        row, column = target(intent)
        if intent.upright:
            yield row, intent.cell[1]
        if intent.sideways:
            yield intent.cell[0], column

    def _order(self, robot: int, cell: GridCell) -> dict[int, frozenset[int]] | None:
        """Who goes after whom if a robot passes a cell; None if that cell stays occupied."""
        order = dict(self.before)
        for other, intent in self.intents.items():
            if other == robot:
                continue
            if intent.cell == cell and other not in self.moving:
                return None
            if cell == intent.cell or cell == self.beside.get(other):
                order[robot] |= {other}
            elif other in self.moving and cell == target(intent):
                order[other] |= {robot}
        return order


def _circular(order: Mapping[int, frozenset[int]]) -> bool:
    """Whether robots would wait for each other."""
    waiting = dict(order)
    while waiting:
        ready = [robot for robot, others in waiting.items() if not others & waiting.keys()]
        if not ready:
            return True
        for robot in ready:
            del waiting[robot]
    return False

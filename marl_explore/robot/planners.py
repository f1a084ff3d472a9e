"""Planners that run on a robot: those of ``marl_explore.planners``, for one robot and in numpy."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import astuple
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.constants import (
    COMMUNICATE,
    DETOUR_CELLS,
    EXCHANGE_TIMER,
    FREE,
    MAX_FRONTIERS,
    MOVE_COST,
    NUM_DIRECTIONS,
    OCCUPIED,
    RIVAL_REACH,
    STAY,
    UNKNOWN,
)
from marl_explore.config.goals import GoalWeights
from marl_explore.robot.goal_actor import GoalChooser, give_way, yield_way
from marl_explore.robot.goal_features import FeatureScaling
from marl_explore.robot.observation import Observation
from marl_explore.robot.paths import Integers, paths_to
from marl_explore.robot.wavefront import Mask, beside_any
from marl_explore.robot.ways import Room

if TYPE_CHECKING:
    from typing_extensions import Self


class RobotPlanner(ABC):
    """A planner of one robot: called with an ``Observation``, it returns an action.

    Robots give way as ``marl_explore.planners`` do (docs/planners.md).

    Args:
        robot: its number.
        config: the arena and its robots.
        seed: of the random choice with which it yields.
    """

    def __init__(self, robot: int, config: ArenaConfig, seed: int = 0) -> None:
        self.robot, self.config = robot, config
        self._chance = np.random.default_rng([seed, robot])
        self._room = Room()

    def check(self, robots: int, fov_size: int) -> None:
        """Raise an error for another team or sensor than the planner is for.

        Args:
            robots: size of the team.
            fov_size: side of the field of view (cells).

        Raises:
            ValueError: naming both.
        """
        mine = self.config.num_agents, self.config.fov_size
        if (robots, fov_size) != mine:
            raise ValueError(
                f"the planner is for num_agents={mine[0]} and {mine[1]} x {mine[1]} cells in view, "
                f"not for {robots} and {fov_size} x {fov_size}"
            )

    @abstractmethod
    def plan(self, observed: Observation) -> int:
        """The wanted action: a move, STAY or COMMUNICATE."""

    def __call__(self, observed: Observation) -> int:
        """An action."""
        refused, room = observed.refused, self._room
        return yield_way(self.plan(observed), observed, refused, room, self._chance)

    def with_seed(self, seed: int | Sequence[int]) -> Self:
        """The same planner with another seed, which remembers nothing."""
        other = copy.copy(self)
        other._chance = np.random.default_rng(seed)
        other.reset()
        return other

    def reset(self) -> None:
        """Forget the episode."""
        self._room = Room()


class _Timed(RobotPlanner):
    """Communicates when the last merge with some linked robot is long enough ago, or never was."""

    def __call__(self, observed: Observation) -> int:
        """An action."""
        action = super().__call__(observed)
        since = observed.steps_since_merge
        due = any(since[mate] >= EXCHANGE_TIMER for mate in observed.mates)
        return COMMUNICATE if due else action


class Nearest(_Timed):
    """Walks to the nearest frontier: ``planners.NearestFrontier`` with a ``PairTimer``."""

    def plan(self, observed: Observation) -> int:
        """The first move to the nearest frontier."""
        moves, lengths = paths_to(observed.map, frontiers(observed), observed.position)
        reached = lengths > 0
        if not reached.any():
            return STAY
        return int((lengths * NUM_DIRECTIONS + moves)[reached].min() % NUM_DIRECTIONS)


class UtilityCost(_Timed):
    """Assigns its frontiers to the linked robots: ``planners.UtilityCost`` of one robot."""

    def plan(self, observed: Observation) -> int:
        """The first move to the frontier that it assigns to itself."""
        mask, grid, position = frontiers(observed), observed.map, observed.position
        around = grid.copy()
        around[position] = OCCUPIED
        for row, column in observed.mates.values():
            if max(abs(row - position[0]), abs(column - position[1])) <= 1:
                around[row, column] = OCCUPIED
        moves, own = paths_to(around, mask, position)
        if not (own > 0).any():
            return STAY
        place = np.argwhere(mask)
        team = sorted([self.robot, *observed.mates])
        distance = [
            own if robot == self.robot else _moves_of_another(grid, mask, place, cell)
            for robot, cell in ((robot, observed.mates.get(robot, position)) for robot in team)
        ]
        choice = _assigned(team.index(self.robot), np.stack(distance), own > 0, place)
        return int(moves[choice])


def frontiers(observed: Observation) -> Mask:
    """Known free cells with an unknown 4-neighbour, bool [H, W]."""
    return beside_any(observed.map == UNKNOWN) & (observed.map == FREE)


def _moves_of_another(
    grid: NDArray[np.int8], mask: Mask, place: Integers, cell: tuple[int, int]
) -> Integers:
    """Moves of a linked robot to each frontier [F]."""
    _, length = paths_to(grid, mask, cell)
    straight = np.abs(place - cell).max(1)
    return np.where((length > 0) | (straight == 0), length, straight + DETOUR_CELLS)


def _assigned(me: int, distance: Integers, reached: Mask, place: Integers) -> int:
    """The frontier of one robot when the best pair by utility minus cost always goes first.

    Args:
        me: row of the robot.
        distance: moves of each robot to each frontier [R, F].
        reached: frontiers that the robot can reach [F].
        place: cells of the frontiers [F, 2].
    """
    cost = np.float32(MOVE_COST) * distance.astype(np.float32)
    utility = np.where(reached, np.float32(1), np.float32(-np.inf))
    waiting = np.ones(len(distance), bool)
    while True:
        value = np.where(waiting[:, None], utility - cost, np.float32(-np.inf))
        robot = int(value.max(1).argmax())
        choice = int(value[robot].argmax())
        if robot == me:
            return choice
        waiting[robot] = False
        apart = np.abs(place - place[choice]).max(1).astype(np.float32)
        utility = utility - np.maximum(1 - apart / np.float32(RIVAL_REACH + 1), 0)


class GoalUtility(RobotPlanner):
    """Goes to the candidate goal with the largest utility: ``planners.GoalUtility``.

    It has a memory of its episode: call it once per step.

    Args:
        robot: as for ``RobotPlanner``.
        config: as for ``RobotPlanner``.
        seed: as for ``RobotPlanner``.
        weights: of the utility.
    """

    def __init__(
        self,
        robot: int,
        config: ArenaConfig,
        seed: int = 0,
        weights: GoalWeights | None = None,
    ) -> None:
        super().__init__(robot, config, seed)
        numbers = np.array(astuple(weights or GoalWeights()), np.float32)
        self._scaling = FeatureScaling(numbers, every=1, after=0)
        self._goals = GoalChooser(robot, config.sight)

    def reset(self) -> None:
        """Forget the episode."""
        super().reset()
        self._goals = GoalChooser(self.robot, self.config.sight)

    def plan(self, observed: Observation) -> int:
        """The first move to the goal, or COMMUNICATE."""
        found = self._goals.find(observed)
        weighed = self._scaling.weigh(found)
        if weighed.choices:
            choice = weighed.choices[int(weighed.utility.argmax())]
        else:
            waits = found.context.all_covered and bool(observed.mates)
            choice = MAX_FRONTIERS + len(found.mates) + (not waits)
        move = self._goals.go(found, choice)
        if self._goals.goes_to_and_fro(move):
            move = give_way(move, observed.action_mask, True, self._chance)
        return COMMUNICATE if weighed.due else move


PLANNERS: dict[str, Callable[[int, ArenaConfig, int], RobotPlanner]] = {
    "goal-utility": GoalUtility,
    "utility-cost": UtilityCost,
    "nearest-timer": Nearest,
}
"""Constructors by the names of ``marl_explore.planners``, from robot, configuration and seed."""

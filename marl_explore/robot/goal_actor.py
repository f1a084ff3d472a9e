"""A robot that chooses among goals: its memory, candidates, network, choice and first move."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_explore.config.constants import (
    COMMUNICATE,
    GOAL_COLUMNS,
    MATE_COLUMNS,
    MAX_FRONTIERS,
    NUM_DIRECTIONS,
    STAY,
)
from marl_explore.config.goals import PATIENCE
from marl_explore.config.shapes import Sight
from marl_explore.robot.candidates import CandidateFinder, Candidates
from marl_explore.robot.goal_network import GoalNetwork
from marl_explore.robot.networks import Array, Weights
from marl_explore.robot.observation import Observation
from marl_explore.robot.ways import Room, make_room

_MOVE, _MOVES = GOAL_COLUMNS.index("move"), GOAL_COLUMNS.index("moves")
_FROM_LAST_GOAL = GOAL_COLUMNS.index("from_last_goal")
_MOVE_TO_MATE = MATE_COLUMNS.index("move")


if TYPE_CHECKING:
    from typing_extensions import Self


class Options(NamedTuple):
    """What there is to choose from in a step."""

    found: Candidates
    choices: list[int]
    """Numbers of the choices (``planners.goal_moves.follow``)."""
    logits: Array
    """Of the choices, float32."""


class GoalChooser:
    """One robot that chooses among goals, with its memory of the episode.

    Args:
        robot: its number.
        sight: of the robots.
    """

    def __init__(self, robot: int, sight: Sight) -> None:
        self.robot, self.sight = robot, sight
        self._episode: CandidateFinder | None = None

    def blank(self) -> Self:
        """The same without a memory."""
        other = copy.copy(self)
        other.reset()
        return other

    def reset(self) -> None:
        """Forget the episode."""
        self._episode = None

    def find(self, observed: Observation) -> Candidates:
        """Remember an observation, and find the candidates."""
        episode = self._episode
        if episode is None or not episode.follows(observed):
            robots = len(observed.net)
            episode = CandidateFinder(self.robot, robots, observed.map.shape, self.sight)
            self._episode = episode
        return episode.find(observed)

    def go(self, found: Candidates, choice: int) -> int:
        """The first move to a choice, whose cell is remembered as the goal.

        It need not be allowed.
        """
        assert self._episode is not None
        goal = self._episode.memory.goal
        if choice < MAX_FRONTIERS:
            goal[:] = found.frontiers[choice, :2]
            return int(found.frontiers[choice, _MOVE])
        mate = choice - MAX_FRONTIERS
        if mate < len(found.mates):
            goal[:] = -1
            return int(found.mates[mate, _MOVE_TO_MATE])
        return COMMUNICATE if mate == len(found.mates) else STAY

    def is_stalled(self) -> bool:
        """Whether its map has not grown for long."""
        assert self._episode is not None
        return self._episode.memory.stalled > PATIENCE

    def goes_to_and_fro(self, move: int) -> bool:
        """``planners.goal_moves.goes_to_and_fro`` of one robot."""
        assert self._episode is not None
        heading = int(self._episode.memory.heading)
        back = (heading + NUM_DIRECTIONS // 2) % NUM_DIRECTIONS
        return self.is_stalled() and heading >= 0 and move == back


class GoalActor(GoalChooser):
    """One robot's actor that chooses among goals, and its memory of the episode.

    Args:
        weights: of the network by name, float32.
        options: of the network.
        robot: its number.
        sight: of the robots.

    Raises:
        ValueError, KeyError: as for ``GoalNetwork``.
    """

    def __init__(self, weights: Weights, options: dict[str, Any], robot: int, sight: Sight) -> None:
        super().__init__(robot, sight)
        self._room = Room()
        self.network = GoalNetwork(weights, options)

    def reset(self) -> None:
        """Forget the episode."""
        super().reset()
        self._room = Room()

    def look(self, observed: Observation) -> Options:
        """Remember an observation, and weigh what there is to choose from."""
        found = self.find(observed)
        return Options(found, *self.network(found))

    def act(self, observed: Observation, chance: np.random.Generator, sample: bool) -> int:
        """An action: the first move to a choice, unless the robot yields.

        Args:
            observed: the robot's observation.
            chance: of samples, and of the way in which it yields.
            sample: whether the choice is sampled; False: the most likely one.
        """
        found, choices, logits = self.look(observed)
        best = (logits + chance.gumbel(size=logits.shape) if sample else logits).argmax()
        choice = choices[int(best)]
        if not sample and self.is_stalled():
            choice = keep_goal(found, choice)
        wanted = self.go(found, choice)
        yields = observed.refused or self.goes_to_and_fro(wanted)
        return yield_way(wanted, observed, yields, self._room, chance)


def keep_goal(found: Candidates, choice: int) -> int:
    """``planners.goal_moves.keep_goal`` of one robot that stays with its goal."""
    places = found.frontiers
    there = (places[:, _MOVES] > 0) & (places[:, _FROM_LAST_GOAL] >= 0)
    if choice == MAX_FRONTIERS + len(found.mates) or not there.any():
        return choice
    away = np.where(there, places[:, _FROM_LAST_GOAL], np.inf)
    return int(away.argmin())


def yield_way(
    wanted: int, observed: Observation, refused: bool, room: Room, chance: np.random.Generator
) -> int:
    """``give_way`` to what a robot observes, and make room for others; to be asked once per step.

    Args:
        wanted: an action.
        observed: the robot's observation.
        refused: whether it has to give way.
        room: what it remembers of having to make room.
        chance: as for ``give_way``.
    """
    crowded = room.is_wanted(observed)
    if crowded and wanted == STAY:
        wanted = make_room(observed)
    return give_way(wanted, observed.action_mask, refused, chance, crowded)


def give_way(
    wanted: int,
    mask: NDArray[np.bool_],
    refused: bool,
    chance: np.random.Generator,
    crowded: bool = False,
) -> int:
    """``core.motion.give_way`` of one robot: the wanted action, or a random one if it is blocked.

    Args:
        wanted: an action.
        mask: allowed actions [10].
        refused: whether the last move was refused.
        chance: of the random choice among the open moves and staying.
        crowded: whether it has to make room (``ways.Room``).
    """
    blocked = wanted < NUM_DIRECTIONS and (refused or not mask[wanted])
    if blocked or (crowded and wanted == STAY):
        return int(chance.choice(mask[: STAY + 1].nonzero()[0]))
    return wanted

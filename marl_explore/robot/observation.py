"""A robot's observation: FOV, FPR, NET, action mask and teammates, from its map and the poses."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.constants import (
    COMMUNICATE,
    COMPASS,
    FREE,
    NUM_ACTIONS,
    OCCUPIED,
    STAY,
    TOLERANCE,
    UNKNOWN,
    Normalization,
)
from marl_explore.robot.evidence import Map
from marl_explore.robot.frontier import feature_table
from marl_explore.robot.geometry import GridCell
from marl_explore.robot.knowledge import Knowledge
from marl_explore.robot.mapper import hidden_corners


class Observation(NamedTuple):
    """One robot's entries of ``ExplorationEnv``, without batch and robot dimensions."""

    fov: NDArray[np.float32]
    """[2k + 1, 2k + 1]; 1 for obstacles, robots, cells outside and unknown cells."""
    fpr: NDArray[np.float32]
    """[8, 3]."""
    net: NDArray[np.float32]
    """[N]."""
    action_mask: NDArray[np.bool_]
    """[10]."""
    map: Map
    """int8 [H, W]."""
    position: GridCell
    unshared: NDArray[np.int64]
    """[N]."""
    steps_since_merge: NDArray[np.int64]
    """[N]."""
    step: int = 0
    """Of the episode: the tick of the team's clock."""
    mates: Mapping[int, GridCell] = {}
    """Cells of the robots that it is linked to, by robot."""
    refused: bool = False
    """Whether its last action was a move that was not made."""


def in_range(cell: GridCell, other: GridCell, range_cells: float) -> bool:
    """Whether two cells are at most ``range_cells`` apart (cells; may be infinite)."""
    squared = (cell[0] - other[0]) ** 2 + (cell[1] - other[1]) ** 2
    return squared <= (range_cells + TOLERANCE) ** 2


def in_reach(robot: int, cells: Mapping[int, GridCell], config: ArenaConfig) -> set[int]:
    """The other robots within a robot's communication range."""
    return {
        other
        for other, place in cells.items()
        if other != robot and in_range(cells[robot], place, config.reach_cells(robot, other))
    }


def observe(
    knowledge: Knowledge,
    cells: Mapping[int, GridCell],
    config: ArenaConfig,
    fpr: Normalization | None,
    step: int = 0,
    refused: bool = False,
    shut: Iterable[GridCell] = (),
    silent: Collection[int] = (),
) -> Observation:
    """The observation of a robot.

    Args:
        knowledge: the robot's, after sensing and merging.
        cells: of the robots whose poses are known, including its own.
        config: sizes and ranges.
        fpr: normalisation of the frontier table.
        step: of the episode.
        refused: whether the robot's last action was a move that was not made.
        shut: cells that it could not reach lately: they count as occupied.
        silent: robots that do not answer, and so are not linked.
    """
    robot, grid = knowledge.robot, knowledge.map.copy()
    for place in shut:
        if place != cells[robot] and grid[place] == FREE:
            grid[place] = OCCUPIED
    cell = cells[robot]
    others = {other: place for other, place in cells.items() if other != robot}
    codes = _around(grid, cell, config.fov_radius)
    net = np.zeros(config.num_agents, np.float32)
    net[robot] = 1
    for other in in_reach(robot, cells, config).difference(silent):
        net[other] = 1
    return Observation(
        fov=_field_of_view(codes, cell, others),
        fpr=feature_table(grid, cell, fpr),
        net=net,
        action_mask=_action_mask(codes, cell, others, net),
        map=grid,
        position=cell,
        unshared=knowledge.unshared.copy(),
        steps_since_merge=knowledge.steps_since_merge.copy(),
        step=step,
        # a robot beside the border may be measured outside
        mates={other: knowledge.frame.nearest(others[other]) for other in others if net[other]},
        refused=refused,
    )


def _around(grid: Map, cell: GridCell, radius: int) -> Map:
    """Cell values of the square around a cell, UNKNOWN outside, int8 [2k + 1, 2k + 1]."""
    padded = np.pad(grid, radius, constant_values=UNKNOWN)
    row, column = cell
    side = 2 * radius + 1
    return padded[row : row + side, column : column + side]


def _field_of_view(
    codes: Map, cell: GridCell, others: Mapping[int, GridCell]
) -> NDArray[np.float32]:
    blocked = (codes != FREE) | hidden_corners(codes == OCCUPIED)
    middle = len(codes) // 2
    for place in others.values():
        row, column = place[0] - cell[0] + middle, place[1] - cell[1] + middle
        if 0 <= row < len(codes) and 0 <= column < len(codes):
            blocked[row, column] = True
    blocked[middle, middle] = False
    return blocked.astype(np.float32)


def open_sides(codes: Map, action: int) -> tuple[bool, bool]:
    """Whether the cells beside a diagonal, north or south and east or west of it, are free.

    Args:
        codes: cell values around the robot, int8 [2k + 1, 2k + 1].
        action: any action; only diagonals have open sides.
    """
    if action >= STAY or action % 2 == 0:
        return False, False
    middle = len(codes) // 2
    up, side = COMPASS[action]
    return bool(codes[middle + up, middle] == FREE), bool(codes[middle, middle + side] == FREE)


def sides_of(observation: Observation, config: ArenaConfig, action: int) -> tuple[bool, bool]:
    """``open_sides`` at the robot's own cell."""
    return open_sides(_around(observation.map, observation.position, config.fov_radius), action)


def _action_mask(
    codes: Map, cell: GridCell, others: Mapping[int, GridCell], net: NDArray[np.float32]
) -> NDArray[np.bool_]:
    mask = np.zeros(NUM_ACTIONS, bool)
    mask[STAY], mask[COMMUNICATE] = True, net.sum() > 1
    middle = len(codes) // 2
    held = set(others.values())
    for action, (up, side) in enumerate(COMPASS):
        shut = codes[middle + up, middle] == OCCUPIED == codes[middle, middle + side]
        free = codes[middle + up, middle + side] == FREE
        mask[action] = free and not shut and (cell[0] + up, cell[1] + side) not in held
    return mask


def complete(grid: Map, cell: GridCell) -> bool:
    """Whether no free cell that a robot can reach, its own included, borders an unknown one.

    Args:
        grid: its map, int8 [H, W].
        cell: its own.
    """
    row, column = cell
    beside = grid[max(row - 1, 0) : row + 2, column], grid[row, max(column - 1, 0) : column + 2]
    numbers = feature_table(grid, cell, None)[:, 0]  # of frontiers, without the own cell
    return not numbers.any() and all((codes != UNKNOWN).all() for codes in beside)

"""The state of a batch of arenas, how an episode starts, and what one step does to it."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from marl_explore.config import ArenaConfig
from marl_explore.core.grid import (
    COMMUNICATE,
    NUM_DIRECTIONS,
    UNKNOWN,
    bordered,
    other_robots,
    surroundings,
    with_robots,
)
from marl_explore.core.mapping import (
    draw,
    known_cells,
    known_mask,
    known_targets,
    merge,
    sense,
    target_cells,
)
from marl_explore.core.motion import action_mask, dangerous_moves, move, open_moves
from marl_explore.core.radio import in_range, networks
from marl_explore.core.rewards import StepRecord

NEVER = 1_000_000
"""Steps since the last merge of two robots that never merged; the counter stops there."""


class WorldState(NamedTuple):
    """Everything an episode's future depends on; the first dimensions are arenas."""

    obstacles: Tensor
    """Static obstacles, bool [*B, H, W]."""
    walls: Tensor
    """``grid.bordered`` obstacles, int8 [*B, H + 2k, W + 2k]."""
    target: Tensor
    """Cells to be mapped, bool [*B, H, W]; follows from obstacles and positions."""
    map: Tensor
    """Each robot's occupancy map, int8 [*B, N, H, W]."""
    position: Tensor
    """(row, column) of each robot, int64 [*B, N, 2]."""
    unshared: Tensor
    """q_ij: own discoveries since the last merge with j, int64 [*B, N, N] (cells), 0 for j = i."""
    steps_since_merge: Tensor
    """Steps since i and j were in one network, int64 [*B, N, N]; NEVER before; 0 for j = i."""
    step_count: Tensor
    """Steps of the episode so far, int64 [*B, 1]."""
    view: Tensor
    """``grid.surroundings``, int8 [*B, N, 2k + 1, 2k + 1]; follows from obstacles, positions."""
    action_mask: Tensor
    """Allowed actions, bool [*B, N, 10]; follows from obstacles and positions."""
    known: Tensor
    """Number of known cells of each map, int64 [*B, N]; follows from the maps."""


def start(config: ArenaConfig, obstacles: Tensor, position: Tensor) -> WorldState:
    """State at reset: every robot has sensed once.

    Args:
        config: sizes and ranges.
        obstacles: bool [*B, H, W].
        position: int64 [*B, N, 2], free and distinct cells.
    """
    *batch, height, width = obstacles.shape
    robots = position.shape[-2]
    unknown = torch.full(
        (*batch, robots, height, width), UNKNOWN, dtype=torch.int8, device=obstacles.device
    )
    walls = bordered(obstacles, config.fov_radius)
    view = surroundings(walls, position, config.fov_radius, config.occlusion)
    grid, discovered = sense(unknown, view, position)
    others = other_robots(robots, position.device)
    return resume(
        config,
        obstacles,
        position,
        grid,
        unshared=discovered.unsqueeze(-1) * others,
        steps_since_merge=(NEVER * others).expand(*batch, robots, robots).clone(),
        step_count=position.new_zeros(*batch, 1),
    )


def resume(
    config: ArenaConfig,
    obstacles: Tensor,
    position: Tensor,
    map: Tensor,
    unshared: Tensor,
    steps_since_merge: Tensor,
    step_count: Tensor,
) -> WorldState:
    """State of an episode under way, from all that does not follow from something else."""
    walls = bordered(obstacles, config.fov_radius)
    view = surroundings(walls, position, config.fov_radius, config.occlusion)
    return WorldState(
        obstacles=obstacles,
        walls=walls,
        target=target_cells(obstacles, position),
        map=map,
        position=position,
        unshared=unshared,
        steps_since_merge=steps_since_merge,
        step_count=step_count,
        view=view,
        action_mask=action_mask(open_moves(view), in_range(position, config.communication_cells)),
        known=known_cells(known_mask(map)),
    )


def advance(
    config: ArenaConfig, state: WorldState, action: Tensor
) -> tuple[WorldState, StepRecord]:
    """One step of all robots at once: move, sense, merge (docs/environment.md, Actions).

    Args:
        config: sizes and ranges.
        state: before the step; it is not changed.
        action: int64 [*B, N], any of the ten actions, allowed or not.

    Returns:
        The state after the step, and the record of what happened.
    """
    visible = state.action_mask[..., :NUM_DIRECTIONS]
    dangerous = dangerous_moves(visible, state.position, action)
    position = move(state.position, action, dangerous)
    view = surroundings(state.walls, position, config.fov_radius, config.occlusion)
    sensed, discovered = sense(state.map, view, position)
    reach = in_range(position, config.communication_cells)
    network = networks(reach, action == COMMUNICATE)
    knowledge = merge(known_mask(sensed), network)

    known = known_cells(knowledge)
    targets = num_targets(state).unsqueeze(-1)
    others = other_robots(action.shape[-1], action.device)
    unshared = state.unshared + discovered.unsqueeze(-1) * others
    waited = (state.steps_since_merge + others).clamp_max(NEVER)
    after = state._replace(
        map=draw(knowledge, state.obstacles),
        position=position,
        unshared=unshared.masked_fill(network, 0),
        steps_since_merge=waited.masked_fill(network, 0),
        step_count=state.step_count + 1,
        view=view,
        action_mask=action_mask(open_moves(view), reach),
        known=known,
    )
    record = StepRecord(
        action=action,
        dangerous=dangerous,
        network=network,
        discovered=discovered,
        received=known - state.known - discovered,
        known=known,
        unshared=unshared,
        complete=(known_targets(knowledge, state.target) == targets).any(-1),
        num_cells=config.num_cells,
        max_discovery=config.max_discovery,
    )
    return after, record


def check_starts(obstacles: Tensor, position: Tensor) -> None:
    """Refuse start cells that are out of bounds, occupied or shared.

    Args:
        obstacles: bool [B, H, W].
        position: int64 [B, N, 2].

    Raises:
        ValueError: naming robot, arena and cell.
    """
    size = torch.tensor(obstacles.shape[-2:], device=position.device)
    outside = ((position < 0) | (position >= size)).any(-1)
    _refuse(outside, position, f"is outside the arena of {size[0]} x {size[1]} cells")
    batch = torch.arange(len(obstacles), device=position.device).unsqueeze(-1)
    _refuse(obstacles[batch, position[..., 0], position[..., 1]], position, "is an obstacle")
    same = (position.unsqueeze(-2) == position.unsqueeze(-3)).all(-1)
    _refuse(same.sum(-1) > 1, position, "holds more than one robot")


def _refuse(wrong: Tensor, position: Tensor, reason: str) -> None:
    if wrong.any():
        arena, robot = wrong.nonzero()[0].tolist()
        cell = tuple(position[arena, robot].tolist())
        raise ValueError(f"start of robot {robot} in arena {arena}: cell {cell} {reason}")


def check_maps(obstacles: Tensor, position: Tensor, grid: Tensor) -> None:
    """Refuse maps of an episode under way that its arena cannot have given.

    Args:
        obstacles: bool [B, H, W].
        position: int64 [B, N, 2].
        grid: int8 [B, N, H, W].

    Raises:
        ValueError: naming robot, arena and cell.
    """
    wrong = (grid != UNKNOWN) & (grid != obstacles.unsqueeze(-3))
    own = with_robots(torch.zeros_like(grid, dtype=torch.bool), position.unsqueeze(-2))
    blind = own & (grid == UNKNOWN)
    for cells, reason in ((wrong, "contradicts the obstacles"), (blind, "holds it, unknown")):
        if cells.any():
            arena, robot, row, column = cells.nonzero()[0].tolist()
            raise ValueError(
                f"map of robot {robot} in arena {arena}: cell {(row, column)} {reason}; to start "
                "a new episode give only the obstacles and positions"
            )


def num_targets(state: WorldState) -> Tensor:
    """Number of cells to be mapped, int64 [*B]."""
    return state.target.flatten(-2).sum(-1)

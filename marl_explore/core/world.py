"""The state of a batch of arenas: how an episode starts, and what one step does."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.constants import NEVER as NEVER
from marl_explore.core.communication import networks
from marl_explore.core.grid import COMMUNICATE, UNKNOWN, other_robots, with_robots
from marl_explore.core.links import links
from marl_explore.core.mapping import (
    blank_maps,
    draw,
    known_cells,
    known_mask,
    known_targets,
    merge,
    target_cells,
)
from marl_explore.core.motion import action_mask, dangerous_moves, move, open_moves
from marl_explore.core.rewards import StepRecord
from marl_explore.core.sensing import bordered, sense, surroundings


class WorldState(NamedTuple):
    """Everything that an episode's future depends on; the first dimensions are arenas."""

    obstacles: Tensor
    """Static obstacles, bool [*B, H, W]."""
    walls: Tensor
    """``sensing.bordered`` obstacles, int8 [*B, H + 2k, W + 2k]."""
    target: Tensor
    """Target cells, bool [*B, H, W]; follows from obstacles and positions."""
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
    """``sensing.surroundings``, int8 [*B, N, 2k + 1, 2k + 1]; follows from obstacles, positions."""
    linked: Tensor
    """``links.links``, bool [*B, N, N]; follows from positions."""
    action_mask: Tensor
    """Allowed actions, bool [*B, N, 10]; follows from obstacles, positions and links."""
    known: Tensor
    """Number of known cells of each map, int64 [*B, N]; follows from the maps."""
    missing: Tensor
    """Number of target cells that each map does not know, int64 [*B, N]; follows from the maps."""


def start(config: ArenaConfig, obstacles: Tensor, position: Tensor) -> WorldState:
    """State at reset: every robot has sensed once.

    Args:
        config: sizes and ranges.
        obstacles: bool [*B, H, W].
        position: int64 [*B, N, 2], free and distinct cells.
    """
    *batch, height, width = obstacles.shape
    robots = position.shape[-2]
    walls = bordered(obstacles, config.fov_radius)
    view = surroundings(walls, position, config.fov_radius, config.occlusion)
    sensed = sense(blank_maps(position, height, width), view, position, config.occlusion)
    discovered = sensed.discovered + 1  # plus the own cell
    others = other_robots(robots, position.device)
    return resume(
        config,
        obstacles,
        position,
        sensed.map,
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
    """State of an episode in progress, from the entries that cannot be derived."""
    walls = bordered(obstacles, config.fov_radius)
    view = surroundings(walls, position, config.fov_radius, config.occlusion)
    linked = links(config, position, obstacles)
    known, target = known_mask(map), target_cells(obstacles, position)
    return WorldState(
        obstacles=obstacles,
        walls=walls,
        target=target,
        map=map,
        position=position,
        unshared=unshared,
        steps_since_merge=steps_since_merge,
        step_count=step_count,
        view=view,
        linked=linked,
        action_mask=action_mask(open_moves(view), linked),
        known=known_cells(known),
        missing=num_targets(target).unsqueeze(-1) - known_targets(known, target),
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
    dangerous = dangerous_moves(state.action_mask, state.position, action)
    position = move(state.position, action, dangerous)
    view = surroundings(state.walls, position, config.fov_radius, config.occlusion)
    sensed = sense(state.map, view, position, config.occlusion)
    linked = links(config, position, state.obstacles)
    exchanged = _exchange(sensed.map, state, linked, action)
    network = exchanged.network

    discovered = sensed.discovered
    known = state.known + discovered + exchanged.received
    missing = state.missing - sensed.discovered_of(state.target) - exchanged.received_targets
    others = other_robots(action.shape[-1], action.device)
    unshared = state.unshared + discovered.unsqueeze(-1)
    unshared.diagonal(dim1=-2, dim2=-1).zero_()
    waited = (state.steps_since_merge + others).clamp_max_(NEVER)
    after = state._replace(
        map=sensed.map,
        position=position,
        unshared=unshared.masked_fill(network, 0),
        steps_since_merge=waited.masked_fill_(network, 0),
        step_count=state.step_count + 1,
        view=view,
        linked=linked,
        action_mask=action_mask(open_moves(view), linked),
        known=known,
        missing=missing,
    )
    record = StepRecord(
        action=action,
        dangerous=dangerous,
        network=network,
        discovered=discovered,
        received=exchanged.received,
        known=known,
        unshared=unshared,
        missing=missing,
        maps=(state.map, sensed.map),
        num_cells=config.num_cells,
        max_discovery=config.max_discovery,
    )
    return after, record


class _Exchanged(NamedTuple):
    network: Tensor
    """Pairs in one network, bool [*B, N, N]."""
    received: Tensor
    """Cells new to each map, int64 [*B, N]."""
    received_targets: Tensor
    """Target cells among them, int64 [*B, N]."""


def _exchange(grid: Tensor, state: WorldState, linked: Tensor, action: Tensor) -> _Exchanged:
    """Merge the maps [*B, N, H, W] of robots that communicate, in place; returns the gains."""
    robots, *size = grid.shape[-3:]
    communicating = (action == COMMUNICATE).reshape(-1, robots)
    result = _Exchanged(
        torch.zeros_like(linked), torch.zeros_like(state.known), torch.zeros_like(state.known)
    )
    rows = _arenas_to_merge(communicating)
    if len(rows) == 0:
        return result

    def at_rows(part: Tensor, *shape: int) -> Tensor:  # several times faster than part[rows]
        return part.reshape(-1, *shape).index_select(0, rows)

    network = networks(at_rows(linked, robots, robots), at_rows(communicating, robots))
    before = known_mask(at_rows(grid, robots, *size))
    after = merge(before, network)
    maps = draw(after, at_rows(state.obstacles, *size))
    grid.view(-1, robots, *size).index_copy_(0, rows, maps)
    added = after - before
    targets = known_targets(added, at_rows(state.target, *size))
    brought = (network, known_cells(added), targets)
    for whole, part in zip(result, brought, strict=True):
        whole.view(-1, *part.shape[1:]).index_copy_(0, rows, part)
    return result


def _arenas_to_merge(communicating: Tensor) -> Tensor:
    """Indices of the arenas in which to merge maps, int64 [R]; ``communicating`` is bool [B, N].

    On the CPU these are the arenas where several robots communicate, usually few. On other devices
    they are all arenas: selecting some would synchronise the device, which takes longer.
    """
    if communicating.device.type == "cpu":
        return (communicating.sum(-1) > 1).nonzero().squeeze(-1)
    return torch.arange(len(communicating), device=communicating.device)


def check_starts(obstacles: Tensor, position: Tensor) -> None:
    """Raise an error for start cells that are out of bounds, occupied or shared.

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
    """Raise an error for maps of an episode in progress that do not fit its arena.

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
    for cells, reason in (
        (wrong, "contradicts the obstacles"),
        (blind, "holds the robot but is unknown"),
    ):
        if cells.any():
            arena, robot, row, column = cells.nonzero()[0].tolist()
            raise ValueError(
                f"map of robot {robot} in arena {arena}: cell {(row, column)} {reason}; to start "
                "a new episode give only the obstacles and positions"
            )


def num_targets(target: Tensor) -> Tensor:
    """Number of target cells, int64 [*B], of a mask bool [*B, H, W]."""
    return target.flatten(-2).sum(-1)

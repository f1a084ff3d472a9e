"""The state of a batch of arenas: how an episode starts, and what one step does."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.constants import NEVER as NEVER
from marl_explore.core.communication import leaders, networks
from marl_explore.core.draws import happens
from marl_explore.core.grid import COMMUNICATE, STAY, UNKNOWN, other_robots, with_robots
from marl_explore.core.links import linked_alive, links
from marl_explore.core.mapping import (
    blank_maps,
    draw,
    known_cells,
    known_mask,
    known_targets,
    merge,
    target_cells,
)
from marl_explore.core.motion import action_mask, dangerous_moves, in_turn, move, open_moves
from marl_explore.core.native import Backend, step
from marl_explore.core.native import merging as kernel
from marl_explore.core.native.choice import in_use
from marl_explore.core.radio import most_squared_within, pairs, reaches
from marl_explore.core.rewards import StepRecord
from marl_explore.core.sensing import blinded, bordered, sense, surroundings
from marl_explore.core.sight import shapes
from marl_explore.core.survivors import failing
from marl_explore.core.walkers import move_walkers, walker_starts


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
    alive: Tensor
    """Robots that have not failed, bool [*B, N]."""
    walkers: Tensor
    """(row, column) of each walker, int64 [*B, W, 2]."""
    draw_key: Tensor
    """Of the episode's random events, int64 [*B, 1]."""
    reach: Tensor
    """``radio.reaches``, int64 [*B, P, L]; follows from the draw key."""
    view: Tensor
    """``sensing.surroundings``, int8 [*B, N, 2k + 1, 2k + 1]; follows from obstacles, positions."""
    linked: Tensor
    """``links.links``, bool [*B, N, N]; follows from positions, obstacles, failures."""
    action_mask: Tensor
    """Allowed actions, bool [*B, N, 10]; follows from view, links, failures and time."""
    known: Tensor
    """Number of known cells of each map, int64 [*B, N]; follows from the maps."""
    missing: Tensor
    """Number of target cells that each map does not know, int64 [*B, N]; follows from the maps."""


def start(
    config: ArenaConfig,
    obstacles: Tensor,
    position: Tensor,
    draw_key: Tensor | None = None,
    alive: Tensor | None = None,
    walkers: Tensor | None = None,
) -> WorldState:
    """State at reset: every robot has sensed once.

    Args:
        config: sizes, sensors, radios and events.
        obstacles: bool [*B, H, W].
        position: int64 [*B, N, 2], free and distinct cells.
        draw_key: of the episodes' events, int64 [*B, 1]; None: 0.
        alive: robots that have not failed, bool [*B, N]; None: all.
        walkers: cells of the walkers, int64 [*B, W, 2]; None: drawn.

    Raises:
        ValueError: if there is no room for the walkers.
    """
    *batch, height, width = obstacles.shape
    robots = position.shape[-2]
    events = _Events.of(config, obstacles, position, draw_key, alive, walkers)
    alive, walkers = events.alive, events.walkers
    living = failing(alive)
    walls = bordered(obstacles, config.fov_radius)
    view = surroundings(walls, position, config.sight, walkers)
    blank = blank_maps(position, height, width).masked_fill_(~alive[..., None, None], UNKNOWN)
    sensed = sense(blank, view, position, torch.zeros_like(obstacles), living)
    discovered = sensed.discovered + alive  # plus the own cell
    others = other_robots(robots, position.device)
    return resume(
        config,
        obstacles,
        position,
        sensed.map,
        unshared=discovered.unsqueeze(-1) * others,
        steps_since_merge=(NEVER * others).expand(*batch, robots, robots).clone(),
        step_count=position.new_zeros(*batch, 1),
        **events._asdict(),
    )


class _Events(NamedTuple):
    """What may happen in episodes, and what has."""

    draw_key: Tensor
    alive: Tensor
    walkers: Tensor

    @classmethod
    def of(
        cls,
        config: ArenaConfig,
        obstacles: Tensor,
        position: Tensor,
        draw_key: Tensor | None,
        alive: Tensor | None,
        walkers: Tensor | None,
    ) -> _Events:
        """As given, or as at the start of an episode."""
        *batch, robots, _ = position.shape
        if draw_key is None:
            draw_key = position.new_zeros(*batch, 1)
        if alive is None:
            alive = torch.ones(*batch, robots, dtype=torch.bool, device=position.device)
        if walkers is None:
            walkers = walker_starts(config.num_walkers, obstacles, position, draw_key)
        return cls(draw_key, alive, walkers)


def resume(
    config: ArenaConfig,
    obstacles: Tensor,
    position: Tensor,
    map: Tensor,
    unshared: Tensor,
    steps_since_merge: Tensor,
    step_count: Tensor,
    draw_key: Tensor | None = None,
    alive: Tensor | None = None,
    walkers: Tensor | None = None,
) -> WorldState:
    """State of an episode in progress, from the entries that cannot be derived.

    ``draw_key``, ``alive`` and ``walkers`` are as for ``start``.
    """
    events = _Events.of(config, obstacles, position, draw_key, alive, walkers)
    draw_key, alive, walkers = events
    living = failing(alive)
    walls = bordered(obstacles, config.fov_radius)
    view = blinded(surroundings(walls, position, config.sight, walkers), living)
    reach = reaches(config, draw_key)
    linked = links(config, position, obstacles, reach, living)
    known, target = known_mask(map), target_cells(obstacles, position)
    may_move = in_turn(config.move_period, living, step_count)
    return WorldState(
        obstacles=obstacles,
        walls=walls,
        target=target,
        map=map,
        position=position,
        unshared=unshared,
        steps_since_merge=steps_since_merge,
        step_count=step_count,
        alive=alive,
        walkers=walkers,
        draw_key=draw_key,
        reach=reach,
        view=view,
        linked=linked,
        action_mask=action_mask(open_moves(view), linked, may_move),
        known=known_cells(known),
        missing=num_targets(target).unsqueeze(-1) - known_targets(known, target),
    )


def advance(
    config: ArenaConfig, state: WorldState, action: Tensor, backend: Backend = "auto"
) -> tuple[WorldState, StepRecord]:
    """One step of all robots at once (docs/environment.md, A step).

    Robots and walkers move, robots sense, those that communicate merge their maps, some fail.

    Args:
        config: sizes, sensors, radios and events.
        state: before the step; it is not changed.
        action: int64 [*B, N], any of the ten actions, allowed or not.
        backend: "torch", "native" (a whole step in C, in arenas without hindrances), or "auto".

    Returns:
        The state after the step, and the record of what happened.

    Raises:
        ValueError: for an unknown backend, and where the native one is not for these arenas.
    """
    living = failing(state.alive)
    if in_use("step", backend, action.device) and not torch.compiler.is_compiling():
        reach = _reach_without_hindrances(config) if living is None else None
        if reach is not None:
            return _advance_at_once(config, state, action, reach)
        if backend == "native":
            raise ValueError(
                "backend='native' is not allowed: it takes arenas without hindrances, on the CPU"
            )
    alive, key, time = state.alive, state.draw_key, state.step_count
    may_move = in_turn(config.move_period, living, time)
    moves = action if may_move is None else torch.where(may_move, action, STAY)
    dangerous = dangerous_moves(state.action_mask, state.position, moves)
    position = move(state.position, moves, dangerous)
    walkers = state.walkers
    if config.num_walkers:
        walkers = move_walkers(walkers, position, state.obstacles, key, time)
    parts: Backend = "torch" if backend == "torch" else "auto"
    view = surroundings(state.walls, position, config.sight, walkers, parts)
    linked = links(config, position, state.obstacles, state.reach, living)
    sensed = sense(state.map, view, position, state.target, living, parts)
    carried = carrying(config, linked, key, time)
    exchanged = exchange(sensed.map, state, carried, action, parts)
    network = exchanged.network
    if config.failure_rate:
        robots = torch.arange(action.shape[-1], device=action.device)
        alive = alive & ~happens(config.failure_rate, key, "failure", robots, time)
        living = failing(alive)
        linked = linked_alive(linked, living)
    view = blinded(view, living)

    discovered = sensed.discovered
    known = state.known + discovered + exchanged.received
    missing = state.missing - sensed.targets - exchanged.received_targets
    others = other_robots(action.shape[-1], action.device)
    unshared = state.unshared + discovered.unsqueeze(-1)
    unshared.diagonal(dim1=-2, dim2=-1).zero_()
    waited = (state.steps_since_merge + others).clamp_max_(NEVER)
    may_move = in_turn(config.move_period, living, time + 1)
    after = state._replace(
        map=sensed.map,
        position=position,
        unshared=unshared.masked_fill(network, 0),
        steps_since_merge=waited.masked_fill_(network, 0),
        step_count=time + 1,
        alive=alive,
        walkers=walkers,
        view=view,
        linked=linked,
        action_mask=action_mask(open_moves(view), linked, may_move),
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
        alive=alive,
        maps=(state.map, sensed.map),
        num_cells=config.num_cells,
        max_discovery=most_discoveries(config, action.device),
    )
    return after, record


@lru_cache
def _reach_without_hindrances(config: ArenaConfig) -> int | None:
    """Largest squared distance of linked robots, if they can always move and lose no message.

    None: something hinders them, or their ranges differ.
    """
    hindrances = (
        config.wall_loss_db,
        config.shadowing_db,
        config.message_loss,
        config.failure_rate,
        config.num_walkers,
        config.move_period != 1,
        config.radio != "path-loss",
    )
    range_cells = config.communication_cells
    if any(hindrances) or isinstance(range_cells, tuple):
        return None
    return most_squared_within(range_cells)


def _advance_at_once(
    config: ArenaConfig, state: WorldState, action: Tensor, reach: int
) -> tuple[WorldState, StepRecord]:
    """``advance`` by one call of the kernel, for arenas without hindrances."""
    new = step.step(
        walls=state.walls,
        masks=shapes(config.sight, action.device),
        target=state.target,
        action=action,
        position=state.position,
        action_mask=state.action_mask,
        unshared=state.unshared,
        steps_since_merge=state.steps_since_merge,
        known=state.known,
        missing=state.missing,
        grid=state.map,
        reach=reach,
        hides=config.sight.line_of_sight,
    )
    after = state._replace(
        map=new.map,
        position=new.position,
        unshared=new.unshared,
        steps_since_merge=new.steps_since_merge,
        step_count=state.step_count + 1,
        view=new.view,
        linked=new.linked,
        action_mask=new.action_mask,
        known=new.known,
        missing=new.missing,
    )
    record = StepRecord(
        action=action,
        dangerous=new.dangerous,
        network=new.network,
        discovered=new.discovered,
        received=new.received,
        known=new.known,
        unshared=new.pending,
        missing=new.missing,
        alive=state.alive,
        maps=(state.map, new.map),
        num_cells=config.num_cells,
        max_discovery=most_discoveries(config, action.device),
    )
    return after, record


def carrying(config: ArenaConfig, linked: Tensor, key: Tensor, time: Tensor) -> Tensor:
    """The links that carry maps in a step, bool [*B, N, N].

    Args:
        config: has the loss of messages.
        linked: bool [*B, N, N].
        key: of the episodes' events, int64 [*B, 1].
        time: ``step_count`` before the step, int64 [*B, 1].
    """
    if not config.message_loss:
        return linked
    first, second = pairs(linked.shape[-1], linked.device)
    lost = happens(config.message_loss, key, "message", first, second, time)
    linked = linked.clone()
    linked[..., first, second] &= ~lost
    linked[..., second, first] &= ~lost
    return linked


@lru_cache
def most_discoveries(config: ArenaConfig, device: torch.device) -> int | Tensor:
    """``config.max_discovery``; of robots that differ as int64 [N]."""
    most = config.max_discovery
    return most if isinstance(most, int) else torch.tensor(most, device=device)


class Exchanged(NamedTuple):
    """What merging brought."""

    network: Tensor
    """Pairs in one network, bool [*B, N, N]."""
    received: Tensor
    """Cells new to each map, int64 [*B, N]."""
    received_targets: Tensor
    """Target cells among them, int64 [*B, N]."""


def exchange(
    grid: Tensor, state: WorldState, linked: Tensor, action: Tensor, backend: Backend = "auto"
) -> Exchanged:
    """Merge the maps of robots that communicate, in place.

    Args:
        grid: contiguous maps, int8 [*B, N, H, W].
        state: has obstacles and targets.
        linked: links that carry maps, bool [*B, N, N].
        action: int64 [*B, N].
        backend: as for ``sight.line_of_sight``.
    """
    if in_use("merge", backend, grid.device):
        return Exchanged(*kernel.merge(grid, linked, action == COMMUNICATE, state.target))
    robots, height, width = grid.shape[-3:]
    communicating = (action == COMMUNICATE).reshape(-1, robots)
    result = Exchanged(
        torch.zeros_like(linked), torch.zeros_like(state.known), torch.zeros_like(state.known)
    )
    arenas = _arenas_to_merge(communicating)
    if len(arenas) == 0:
        return result

    network = networks(_rows(linked, arenas, robots, robots), communicating.index_select(0, arenas))
    result.network.view(-1, robots, robots).index_copy_(0, arenas, network)
    rows, group = _members(network)
    if len(rows) == 0:
        return result
    cells = height * width
    arena, number = arenas.index_select(0, rows // robots), rows % robots
    robot = arena * robots + number
    before = known_mask(_rows(grid, robot, cells))
    after = merge(before, group)
    obstacles = _rows(state.obstacles, arena, height, width)
    maps = draw(after.view(-1, 1, height, width), obstacles).squeeze(1)
    grid.view(-1, height, width).index_copy_(0, robot, maps)
    added = after - before
    targets = added * _rows(state.target, arena, cells)
    for whole, new in ((result.received, added), (result.received_targets, targets)):
        whole.view(-1).index_copy_(0, robot, new.sum(-1).long())
    return result


def _members(network: Tensor) -> tuple[Tensor, Tensor]:
    """Robots that merge their maps, numbered over all arenas, and one of the network of each.

    Args:
        network: bool [R, N, N].

    Returns:
        int64 [K], and an index into it, int64 [K]. On the CPU these are the members of networks,
        usually few; on other devices all robots, each other one a group of its own.
    """
    member = network.diagonal(dim1=-2, dim2=-1).flatten()
    number = torch.arange(len(member), device=member.device)
    rows = member.nonzero().squeeze(-1) if member.device.type == "cpu" else number
    robots = network.shape[-1]
    first = leaders(network).flatten() + number // robots * robots
    first = torch.where(member, first, number).index_select(0, rows)
    place = torch.zeros_like(number).index_copy_(0, rows, number[: len(rows)])
    return rows, place.index_select(0, first)


def _rows(part: Tensor, rows: Tensor, *shape: int) -> Tensor:
    """Rows of a part of the state whose entries have this shape, [K, *shape].

    Several times faster than indexing.
    """
    return part.reshape(-1, *shape).index_select(0, rows)


def _arenas_to_merge(communicating: Tensor) -> Tensor:
    """Indices of the arenas in which to merge maps, int64 [R]; ``communicating`` is bool [B, N].

    On the CPU these are the arenas where several robots communicate, usually few. On other devices
    they are all arenas: selecting some would synchronise the device, which takes longer.
    """
    if communicating.device.type == "cpu":
        return (communicating.sum(-1) > 1).nonzero().squeeze(-1)
    return torch.arange(len(communicating), device=communicating.device)


def check_starts(obstacles: Tensor, position: Tensor, walkers: Tensor | None = None) -> None:
    """Raise an error for start cells that are out of bounds, occupied or shared.

    Args:
        obstacles: bool [B, H, W].
        position: of robots, int64 [B, N, 2].
        walkers: int64 [B, W, 2]; None: no walker is given.

    Raises:
        ValueError: naming robot or walker, arena and cell.
    """
    _check_cells("robot", obstacles, position)
    if walkers is not None:
        _check_cells("walker", obstacles, walkers)
        held = (walkers.unsqueeze(-2) == position.unsqueeze(-3)).all(-1).any(-1)
        _refuse("walker", held, walkers, "holds a robot")


def _check_cells(kind: str, obstacles: Tensor, position: Tensor) -> None:
    size = torch.tensor(obstacles.shape[-2:], device=position.device)
    outside = ((position < 0) | (position >= size)).any(-1)
    _refuse(kind, outside, position, f"is outside the arena of {size[0]} x {size[1]} cells")
    batch = torch.arange(len(obstacles), device=position.device).unsqueeze(-1)
    _refuse(kind, obstacles[batch, position[..., 0], position[..., 1]], position, "is an obstacle")
    same = (position.unsqueeze(-2) == position.unsqueeze(-3)).all(-1)
    _refuse(kind, same.sum(-1) > 1, position, f"holds more than one {kind}")


def _refuse(kind: str, wrong: Tensor, position: Tensor, reason: str) -> None:
    if wrong.any():
        arena, robot = wrong.nonzero()[0].tolist()
        cell = tuple(position[arena, robot].tolist())
        raise ValueError(f"start of {kind} {robot} in arena {arena}: cell {cell} {reason}")


def check_maps(obstacles: Tensor, position: Tensor, grid: Tensor, alive: Tensor) -> None:
    """Raise an error for maps of an episode in progress that do not fit its arena.

    Args:
        obstacles: bool [B, H, W].
        position: int64 [B, N, 2].
        grid: int8 [B, N, H, W].
        alive: bool [B, N]; a robot that failed may not even know its own cell.

    Raises:
        ValueError: naming robot, arena and cell.
    """
    wrong = (grid != UNKNOWN) & (grid != obstacles.unsqueeze(-3))
    own = with_robots(torch.zeros_like(grid, dtype=torch.bool), position.unsqueeze(-2))
    blind = own & (grid == UNKNOWN) & alive[..., None, None]
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

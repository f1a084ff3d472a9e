"""What a robot remembers of its team, from its own observations alone.

A robot sees where linked teammates are and which networks it was in, and knows its own map. All
entries are [*B, N, ...], and row i is what robot i remembers.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from marl_explore.config.constants import NOT_SEEN as NOT_SEEN
from marl_explore.config.constants import PATIENCE_STEPS as PATIENCE_STEPS
from marl_explore.config.shapes import Sight
from marl_explore.core.grid import FREE, UNKNOWN, compass, flat_cell
from marl_explore.core.links import linked_others
from marl_explore.core.mapping import known_cells, known_mask
from marl_explore.core.sensing import cells_seen_from, in_view
from marl_explore.core.sight import line_of_sight, shapes


class Sightings(NamedTuple):
    """When and where every robot was last linked to every other one."""

    step: Tensor
    """Step at which i was last linked to j, int64 [*B, N, N]; NOT_SEEN before, and for j = i."""
    cell: Tensor
    """Position of j then, int64 [*B, N, N, 2]."""
    waited: Tensor
    """Whether j is linked and was at the same position one step earlier, bool [*B, N, N]."""


def no_sightings(position: Tensor) -> Sightings:
    """What robots at positions int64 [*B, N, 2] remember before they have seen each other."""
    pairs = (*position.shape[:-1], position.shape[-2])
    return Sightings(
        torch.full(pairs, NOT_SEEN, device=position.device),
        torch.zeros(*pairs, 2, dtype=torch.int64, device=position.device),
        torch.zeros(pairs, dtype=torch.bool, device=position.device),
    )


def update_sightings(before: Sightings, now: Tensor, position: Tensor, linked: Tensor) -> Sightings:
    """Sightings after one more observation.

    Args:
        before: those until now.
        now: step of the episode, int64 [*B, 1].
        position: int64 [*B, N, 2].
        linked: ``links.links``, bool [*B, N, N].
    """
    others, now = linked_others(linked), now.unsqueeze(-1)
    place = position.unsqueeze(-3).expand_as(before.cell)
    still = (before.step == now - 1) & (before.cell == place).all(-1)
    return Sightings(
        torch.where(others, now, before.step),
        torch.where(others.unsqueeze(-1), place, before.cell),
        others & still,
    )


def last_place(seen: Sightings) -> Tensor:
    """Position at which each robot last saw another one, int64 [*B, N, 2]."""
    latest = seen.step.argmax(-1)[..., None, None]
    return seen.cell.gather(-2, latest.expand(*latest.shape[:-1], 2)).squeeze(-2)


def surely_seen(grid: Tensor, position: Tensor, linked: Tensor, sight: Sight) -> Tensor:
    """Cells that linked teammates surely see, as far as each robot knows.

    They are those of the teammate's own shape. Where obstacles end sight, what a robot's map does
    not know may be one: the cells are those that the teammate would see if it were.

    Args:
        grid: maps, int8 [*B, N, H, W].
        position: int64 [*B, N, 2].
        linked: ``links.links``, bool [*B, N, N].
        sight: of the robots.

    Returns:
        bool [*B, N, N, H, W]: whether i is sure that j sees the cell now.
    """
    height, width = grid.shape[-2:]
    others = linked_others(linked)
    if sight.fills_windows:
        views = in_view(position, height, width, sight.radius)
        return others[..., None, None] & views.unsqueeze(-4)
    pair = others.flatten().nonzero()  # [P, 1], numbers of robot and teammate in one
    robot, mate = pair // others.shape[-1], pair % others.shape[-1]
    place = flat_cell(position, width).unsqueeze(-2).expand_as(others)
    own = place.flatten().take(pair)
    cell = cells_seen_from(height, width, sight.radius, grid.device)[own.squeeze(-1)]
    seen = shapes(sight, grid.device)[mate.squeeze(-1) % len(sight.ranges_cells)]
    if sight.line_of_sight:
        wall = (grid != FREE).flatten(-2).view(-1, height * width)[robot, cell]
        wall = wall.masked_fill_(cell == own, False).view_as(seen)  # the teammate stands there
        seen = seen & line_of_sight(wall)
    found = torch.zeros(others.numel(), height * width, dtype=torch.bool, device=grid.device)
    found[pair, torch.where(seen.flatten(-2), cell, own)] = True
    return found.view(*others.shape, height, width)


class TeamMemory(NamedTuple):
    """Everything that each robot remembers."""

    seen: Sightings
    known_by: Tensor
    """Cells that i is sure j knows, bool [*B, N, N, H, W]: of maps they merged, and that j saw."""
    covered: Tensor
    """Cells that i leaves to teammates who have seen them, bool [*B, N, H, W]."""
    stuck: Tensor
    """Steps in a row in which all frontiers that i can reach were covered, int64 [*B, N]."""
    known: Tensor
    """Number of cells that its map knows, int64 [*B, N]."""
    stalled: Tensor
    """Steps since its map last grew, int64 [*B, N]."""
    position: Tensor
    """The robot's own position, int64 [*B, N, 2]."""
    heading: Tensor
    """Direction of its last move, int64 [*B, N]; -1 before the first."""
    goal: Tensor
    """The cell that it last chose to go to, int64 [*B, N, 2]; (-1, -1) for none."""


Memory = TypeVar("Memory", Sightings, TeamMemory)


class Observation(NamedTuple):
    """What the robots of a team observe in a step, as far as they remember it."""

    now: Tensor
    """Step of the episode, int64 [*B, 1]."""
    grid: Tensor
    """Maps, int8 [*B, N, H, W]."""
    position: Tensor
    """int64 [*B, N, 2]."""
    linked: Tensor
    """``links.links``, bool [*B, N, N]."""
    since: Tensor
    """Steps since the last merge with every other robot, int64 [*B, N, N]."""


def blank_memory(grid: Tensor, position: Tensor) -> TeamMemory:
    """The memory of robots that have not observed anything, for maps [*B, N, H, W]."""
    pairs = (*position.shape[:-1], position.shape[-2])
    return TeamMemory(
        seen=no_sightings(position),
        known_by=torch.zeros(*pairs, *grid.shape[-2:], dtype=torch.bool, device=grid.device),
        covered=torch.zeros_like(grid, dtype=torch.bool),
        stuck=torch.zeros_like(position[..., 0]),
        known=torch.zeros_like(position[..., 0]),
        stalled=torch.zeros_like(position[..., 0]),
        position=position,
        heading=torch.full_like(position[..., 0], -1),
        goal=torch.full_like(position, -1),
    )


def remember(
    before: TeamMemory,
    observed: Observation,
    all_covered: Tensor,
    sight: Sight,
    patience_steps: int = PATIENCE_STEPS,
) -> TeamMemory:
    """The memory after one more observation.

    Args:
        before: the memory until now; its ``goal`` is the last one chosen.
        observed: the new observation.
        all_covered: whether a robot could reach frontiers before this step, all of them covered,
            bool [*B, N] (``goals.GoalTable.all_covered``).
        sight: of the robots.
        patience_steps: steps in a row of ``all_covered`` after which covered cells are forgotten.
    """
    grid, linked = observed.grid, observed.linked
    stuck = (before.stuck + 1) * all_covered
    forget = stuck >= patience_steps
    views = surely_seen(grid, observed.position, linked, sight)
    merged = linked_others(observed.since == 0)[..., None, None]
    known = known_cells(known_mask(grid))
    return TeamMemory(
        seen=update_sightings(before.seen, observed.now, observed.position, linked),
        known_by=before.known_by | views | (merged & (grid != UNKNOWN).unsqueeze(-3)),
        covered=(before.covered & ~forget[..., None, None]) | views.any(-3),
        stuck=stuck.masked_fill(forget, 0),
        known=known,
        stalled=(before.stalled + 1).masked_fill_(known > before.known, 0),
        position=observed.position,
        heading=_heading(before, observed.position),
        goal=before.goal,
    )


def where_begun(begun: Tensor, blank: Memory, before: Memory) -> Memory:
    """The memory in which teams whose episode begins, bool [*B], remember nothing.

    Args:
        begun: whether an episode begins.
        blank: what is remembered then.
        before: what was remembered until now, of the same kind.
    """

    def pick(one: Any, other: Any) -> Any:
        if isinstance(one, Sightings):
            return Sightings(*map(pick, one, other))
        rows = begun.view(*begun.shape, *[1] * (one.ndim - begun.ndim))
        return torch.where(rows, one, other)

    return type(before)(*map(pick, blank, before))


def _heading(before: TeamMemory, position: Tensor) -> Tensor:
    """Direction of each robot's last move, or -1, int64 [*B, N]."""
    moved = (position - before.position).unsqueeze(-2) == compass(position.device)
    found, direction = moved.all(-1).max(-1)
    return torch.where(found, direction, before.heading)

"""Links: which pairs of robots can communicate. Only this module and ``radio`` know the range.

Links are computed once per step, are part of the world's state, and are published as
("agents", "linked"), where masks, networks, features, planners and replays read them.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.checks import require
from marl_explore.core.grid import other_robots
from marl_explore.core.radio import most_squared_within, pair_reaches, pairs, walls_near

Radio = Callable[[ArenaConfig, Tensor, Tensor, Tensor], Tensor]
"""From the settings, positions int64 [*B, N, 2], obstacles bool [*B, H, W] and ``radio.reaches`` to
the pairs of robots that can communicate, bool [*B, N, N]: symmetric, True on the diagonal."""


def path_loss(config: ArenaConfig, position: Tensor, obstacles: Tensor, reach: Tensor) -> Tensor:
    """Robots within range of each other; walls and shadowing shorten the range."""
    range_cells = config.communication_cells
    if config.shadowing_db:
        return within_reach(config, position, obstacles, reach)
    if isinstance(range_cells, tuple) or config.wall_loss_db:
        return within_reach(config, position, obstacles, pair_reaches(config, position.device))
    return within_range(position, range_cells)


RADIOS: dict[str, Radio] = {"path-loss": path_loss}
"""A new radio is a function and a row here."""


def require_radio(config: ArenaConfig) -> None:
    """Raise an error unless the radio of the settings is known."""
    allowed = f"it must be one of {sorted(RADIOS)}"
    require(config.radio in RADIOS, "radio", config.radio, allowed)


def links(
    config: ArenaConfig,
    position: Tensor,
    obstacles: Tensor,
    reach: Tensor,
    alive: Tensor | None = None,
) -> Tensor:
    """Pairs of robots that can communicate, bool [*B, N, N].

    Args:
        config: has the radios.
        position: int64 [*B, N, 2].
        obstacles: bool [*B, H, W]; they weaken radio where walls cost.
        reach: ``radio.reaches``.
        alive: bool [*B, N]; robots that failed are not linked. None: all live.

    Returns:
        Symmetric, and True on the diagonal.
    """
    radio = RADIOS[config.radio]
    linked = radio(config, position, obstacles, reach)
    if radio is not path_loss:
        _check_relation(config.radio, linked, (*position.shape[:-1], position.shape[-2]))
    return linked_alive(linked, alive)


def _check_relation(name: str, linked: Tensor, shape: tuple[int, ...]) -> None:
    """Raise an error unless a radio gives a symmetric relation."""
    if linked.dtype != torch.bool or linked.shape != shape:
        raise ValueError(
            f"radio={name!r} must return a bool tensor of shape {tuple(shape)}, got {linked.dtype} "
            f"of shape {tuple(linked.shape)}"
        )
    own = linked.diagonal(dim1=-2, dim2=-1)
    if not (torch.equal(linked, linked.mT) and bool(own.all())):
        raise ValueError(
            f"radio={name!r} must return a symmetric relation that is True on its diagonal"
        )


def linked_alive(linked: Tensor, alive: Tensor | None) -> Tensor:
    """Links [*B, N, N] less those of robots that are not alive [*B, N]; the diagonal stays True."""
    if alive is None:
        return linked
    linked = linked & alive.unsqueeze(-1) & alive.unsqueeze(-2)
    linked.diagonal(dim1=-2, dim2=-1).fill_(True)
    return linked


def within_reach(config: ArenaConfig, position: Tensor, obstacles: Tensor, reach: Tensor) -> Tensor:
    """Pairs of robots that hear each other through the walls between them, bool [*B, N, N].

    Args:
        config: has the loss of a wall.
        position: int64 [*B, N, 2].
        obstacles: bool [*B, H, W].
        reach: ``radio.pair_reaches`` [P, L] or ``radio.reaches`` [*B, P, L].
    """
    robots = position.shape[-2]
    first, second = pairs(robots, position.device)
    start, end = position.index_select(-2, first), position.index_select(-2, second)
    squared = (end - start).square().sum(-1)
    near = squared <= reach.amax(-1)
    if config.wall_loss_db and near.numel():
        number = walls_near(obstacles, start, end, near)
        number = number.clamp_max(reach.shape[-1] - 1).unsqueeze(-1)
        limit = reach.expand(*number.shape[:-1], -1).gather(-1, number).squeeze(-1)
        near = near & (squared <= limit)
    linked = torch.zeros(*near.shape[:-1], robots, robots, dtype=torch.bool, device=near.device)
    linked[..., first, second] = near
    linked[..., second, first] = near
    linked.diagonal(dim1=-2, dim2=-1).fill_(True)
    return linked


def within_range(position: Tensor, range_cells: float) -> Tensor:
    """Pairs of robots at most ``range_cells`` apart, bool [*B, N, N].

    Args:
        position: int64 [*B, N, 2].
        range_cells: communication range (cells; may be infinite).

    Returns:
        Symmetric, and True on the diagonal.
    """
    cells = position.double()
    distance = torch.cdist(cells, cells, compute_mode="donot_use_mm_for_euclid_dist")
    # squared distances are integers, so a limit halfway between two is safe from rounding
    return distance < math.sqrt(most_squared_within(range_cells) + 0.5)


def linked_others(linked: Tensor) -> Tensor:
    """Linked pairs of different robots, bool [*B, N, N], from ``links`` [*B, N, N]."""
    return linked & other_robots(linked.shape[-1], linked.device).bool()


def any_linked(linked: Tensor) -> Tensor:
    """Whether each robot is linked to another one, bool [*B, N], from ``links`` [*B, N, N]."""
    return linked.sum(-1) > 1

"""Links: which pairs of robots can communicate. Only this module knows the range.

Links are computed once per step, are part of the world's state, and are published as
("agents", "linked"), where masks, networks, features, planners and replays read them.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from marl_explore.config.arena import TOLERANCE, ArenaConfig
from marl_explore.core.grid import other_robots
from marl_explore.core.radio import FARTHEST


def links(config: ArenaConfig, position: Tensor, obstacles: Tensor) -> Tensor:
    """Pairs of robots that can communicate, bool [*B, N, N]: those within range of each other.

    Args:
        config: has the communication range.
        position: int64 [*B, N, 2].
        obstacles: bool [*B, H, W]; they do not block communication.

    Returns:
        Symmetric, and True on the diagonal.
    """
    return within_range(position, config.communication_cells)


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
    limit = math.floor(min((range_cells + TOLERANCE) ** 2, FARTHEST))
    return distance < math.sqrt(limit + 0.5)


def linked_others(linked: Tensor) -> Tensor:
    """Linked pairs of different robots, bool [*B, N, N], from ``links`` [*B, N, N]."""
    return linked & other_robots(linked.shape[-1], linked.device).bool()


def any_linked(linked: Tensor) -> Tensor:
    """Whether each robot is linked to another one, bool [*B, N], from ``links`` [*B, N, N]."""
    return linked.sum(-1) > 1

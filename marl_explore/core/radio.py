"""Who can hear whom, and which robots form a network."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from marl_explore.config import TOLERANCE

_FARTHEST = 2.0**50
"""More than the squared distance of any two cells; infinite ranges end here."""


def in_range(position: Tensor, range_cells: float) -> Tensor:
    """Pairs of robots at most ``range_cells`` apart, bool [*B, N, N] with a True diagonal.

    Args:
        position: int64 [*B, N, 2].
        range_cells: communication range (cells; may be infinite).
    """
    cells = position.double()
    distance = torch.cdist(cells, cells, compute_mode="donot_use_mm_for_euclid_dist")
    # squared distances are whole numbers: half-way to the next no rounding decides
    limit = math.floor(min((range_cells + TOLERANCE) ** 2, _FARTHEST))
    return distance < math.sqrt(limit + 0.5)


def has_neighbor(reach: Tensor) -> Tensor:
    """Whether another robot is in range, bool [*B, N], for ``in_range`` pairs [*B, N, N]."""
    return reach.sum(-1) > 1


def networks(reach: Tensor, communicating: Tensor) -> Tensor:
    """Pairs of robots in one network: communicators joined by chains of pairs in range.

    Args:
        reach: bool [*B, N, N], pairs in range.
        communicating: bool [*B, N], robots that chose to communicate.

    Returns:
        bool [*B, N, N], True on the diagonal for members; networks have at least two members.
    """
    robots = communicating.shape[-1]
    pairs = reach & communicating.unsqueeze(-1) & communicating.unsqueeze(-2)
    # the batch comes last, so that every operation runs over whole vectors of arenas
    joined = pairs.reshape(-1, robots, robots).permute(1, 2, 0).to(torch.uint8).contiguous()
    for _ in range((robots - 1).bit_length()):  # each pass doubles the length of the chains
        joined = (joined.unsqueeze(2) & joined).amax(1)
    members = joined.sum(1, keepdim=True) > 1
    return (joined * members).permute(2, 0, 1).contiguous().bool().view(pairs.shape)

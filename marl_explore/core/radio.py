"""Who can hear whom, and which robots form a network."""

from __future__ import annotations

import math

from torch import Tensor

from marl_explore.config import TOLERANCE

_FARTHEST = 2**62
"""More than the squared distance of any two cells; infinite ranges end here (int64)."""


def in_range(position: Tensor, range_cells: float) -> Tensor:
    """Pairs of robots at most ``range_cells`` apart, bool [*B, N, N] with a True diagonal.

    Args:
        position: int64 [*B, N, 2].
        range_cells: communication range (cells; may be infinite).
    """
    row, column = ((x.unsqueeze(-1) - x.unsqueeze(-2)).square() for x in position.unbind(-1))
    # whole squared distances, so that no rounding of square roots decides
    limit = min((range_cells + TOLERANCE) ** 2, float(_FARTHEST))
    return row + column <= math.floor(limit)


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
    joined = (reach & communicating.unsqueeze(-1) & communicating.unsqueeze(-2)).float()
    robots = communicating.shape[-1]
    for _ in range((robots - 1).bit_length()):  # each pass doubles the length of the chains
        joined = (joined @ joined).clamp_max(1)
    members = joined.sum(-1, keepdim=True)
    return (joined > 0) & (members > 1)

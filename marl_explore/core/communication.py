"""Networks: which communicating robots exchange maps with each other."""

from __future__ import annotations

import torch
from torch import Tensor


def networks(linked: Tensor, communicating: Tensor) -> Tensor:
    """Pairs of robots in one network: communicating robots joined by chains of links.

    Args:
        linked: ``links.links``, bool [*B, N, N].
        communicating: bool [*B, N], robots that chose to communicate.

    Returns:
        bool [*B, N, N], True on the diagonal for members; a network has at least two members.
    """
    robots = communicating.shape[-1]
    pairs = linked & communicating.unsqueeze(-1) & communicating.unsqueeze(-2)
    # batch dimension last, so that every operation is vectorised over arenas
    joined = pairs.reshape(-1, robots, robots).permute(1, 2, 0).to(torch.uint8).contiguous()
    for _ in range((robots - 1).bit_length()):  # each pass doubles the length of the chains
        joined = (joined.unsqueeze(2) & joined).amax(1)
    members = joined.sum(1, keepdim=True) > 1
    return (joined * members).permute(2, 0, 1).contiguous().bool().view(pairs.shape)

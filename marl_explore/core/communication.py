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
    if robots > MANY_ROBOTS and pairs.device.type == "cpu":
        return _by_labels(pairs)  # asks for changes, which would synchronise another device
    # batch dimension last, so that every operation is vectorised over arenas
    joined = pairs.reshape(-1, robots, robots).permute(1, 2, 0).to(torch.uint8).contiguous()
    for _ in range((robots - 1).bit_length()):  # each pass doubles the length of the chains
        joined = (joined.unsqueeze(2) & joined).amax(1)
    members = joined.sum(1, keepdim=True) > 1
    return (joined * members).permute(2, 0, 1).contiguous().bool().view(pairs.shape)


MANY_ROBOTS = 16
"""Teams of more robots find networks by labels, which takes N^2 operations instead of N^3."""


def _by_labels(pairs: Tensor) -> Tensor:
    """``networks`` of linked pairs that communicate, bool [*B, N, N].

    Every robot takes the lowest number among its partners and itself, until none changes.
    """
    robots = pairs.shape[-1]
    number = torch.arange(robots, dtype=torch.int16, device=pairs.device)
    none = number.new_tensor(robots)
    label = number.expand(pairs.shape[:-1])
    while True:
        lowest = torch.where(pairs, label.unsqueeze(-2), none).amin(-1)
        lowest = torch.minimum(lowest, label)
        # a label's own label is as good, and shortens long chains
        lowest = lowest.gather(-1, lowest.long())
        if torch.equal(lowest, label):
            break
        label = lowest
    member = pairs.diagonal(dim1=-2, dim2=-1).unsqueeze(-1)
    same = (label.unsqueeze(-1) == label.unsqueeze(-2)) & member
    return same & (same.sum(-1, keepdim=True) > 1)


def leaders(network: Tensor) -> Tensor:
    """The lowest number in each robot's network, int64 [*B, N]; 0 for robots in none.

    Args:
        network: ``networks``, bool [*B, N, N].
    """
    return network.to(torch.uint8).argmax(-1)

"""Actors that do without some of what they could see or do."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from marl_explore.codes import FORBIDDEN_LOGIT
from marl_explore.config import Ability
from marl_explore.core.grid import COMMUNICATE


class Ablated(nn.Module):
    """An actor that does without some of its inputs, which it reads as 0, or never communicates.

    Args:
        actor: the network.
        without: what it does without.
    """

    def __init__(self, actor: nn.Module, without: Sequence[Ability]) -> None:
        super().__init__()
        self.actor = actor
        self.inputs: tuple[str, ...] = actor.inputs  # type: ignore[assignment]
        self.without = frozenset(without)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Logits [*B, 10]."""
        read = (
            torch.zeros_like(entry) if name in self.without else entry
            for name, entry in zip(self.inputs, inputs, strict=True)
        )
        logits = self.actor(*read)
        if "communication" in self.without:
            logits = logits.index_fill(
                -1, torch.tensor(COMMUNICATE, device=logits.device), FORBIDDEN_LOGIT
            )
        return logits
